"""Which pairs a run compares when there are too many for all."""

from __future__ import annotations

from sfm.core.events import StageFinished, StageStarted
from sfm.io.database import Database
from sfm.pipeline.config import PipelineConfig
from sfm.retrieval import RetrievalConfig
from tests.pictures import texture
from tests.pipeline.conftest import write_photo
from tests.pipeline.test_run import Told, run

FEW = RetrievalConfig(exhaustive_up_to=0, partners=1, neighbors=0)


def two_walks(folder, count=5):
    """Cuts of one picture, then of another, each overlapping the next by three quarters."""
    for name, seed in (("a", 1), ("b", 2)):
        picture = texture(seed, (120, 160 + 40 * count))
        for k in range(count):
            write_photo(folder / f"{name}{k}.png", picture[:, 40 * k : 40 * k + 160])
    return folder


def _pairs(workspace) -> tuple[set[tuple[str, str]], set[tuple[str, str]]]:
    """Names of the pairs that were matched, and of those that were verified and not rejected."""
    with Database.open(workspace / "database.db") as database:
        names = {row.image_id: row.name for row in database.images()}
        kept = set(database.verified_pairs()) - set(database.rejected_pairs())
        return tuple({(names[i], names[j]) for i, j in some} for some in (database.matched_pairs(), kept))


def _rounds(told: Told) -> list[tuple[str, int]]:
    return [(event.stage, event.total) for event in told.events if isinstance(event, StageStarted)]


def test_pairs_of_different_places_are_left_out_and_no_others(tmp_path):
    photos = two_walks(tmp_path / "photos")
    run(photos, tmp_path / "all")
    run(photos, tmp_path / "few", PipelineConfig(retrieval=FEW))
    matched, verified = _pairs(tmp_path / "few")
    all_matched, all_verified = _pairs(tmp_path / "all")
    assert len(all_matched) == 45
    assert len(matched) < 45
    assert {(i, j) for i, j in all_verified if int(j[1]) - int(i[1]) <= 2} <= verified <= all_verified


def test_what_the_first_look_misses_is_tried_while_it_helps(tmp_path):
    photos = two_walks(tmp_path / "photos")
    blind = RetrievalConfig(exhaustive_up_to=0, partners=0, neighbors=1, min_votes=10**6, retries=1)
    told = run(photos, tmp_path / "ws", PipelineConfig(retrieval=blind))
    rounds = [total for stage, total in _rounds(told) if stage == "matching"]
    assert rounds[0] == 9
    assert len(rounds) >= 2
    assert all(0 < total <= 10 for total in rounds[1:])
    _, verified = _pairs(tmp_path / "ws")
    for walk in "ab":  # each photo has two links or more, as the chain of neighbours has not
        links = [sum(f"{walk}{k}.png" in pair for pair in verified) for k in range(5)]
        assert min(links) >= 2


def test_a_first_look_that_finds_nothing_is_not_the_end(tmp_path):
    blind = RetrievalConfig(exhaustive_up_to=0, partners=0, neighbors=0, min_votes=10**6)
    run(two_walks(tmp_path / "photos"), tmp_path / "ws", PipelineConfig(retrieval=blind))
    _, verified = _pairs(tmp_path / "ws")
    assert {(f"{walk}{k}.png", f"{walk}{k + 1}.png") for walk in "ab" for k in range(4)} <= verified


def test_fewer_photos_leave_no_stale_ledger_and_a_true_summary(tmp_path):
    photos = two_walks(tmp_path / "photos")
    run(photos, tmp_path / "ws", PipelineConfig(retrieval=RetrievalConfig(exhaustive_up_to=10)))
    told = run(photos, tmp_path / "ws", PipelineConfig(retrieval=FEW))
    said = [e.summary for e in told.events if isinstance(e, StageFinished) and e.stage == "verification"]
    kept, of = (int(word) for word in said[-1].split()[0:3:2])
    assert 0 < kept <= of < 45
    run(photos, tmp_path / "ws", PipelineConfig(retrieval=RetrievalConfig(exhaustive_up_to=10)))
    with Database.open(tmp_path / "ws" / "database.db") as database:
        assert not [row for row in database.ledger() if row.stage == "pairs"]


def test_the_scores_and_the_links_of_a_run_are_not_computed_again(tmp_path):
    photos = two_walks(tmp_path / "photos")
    config = PipelineConfig(retrieval=RetrievalConfig(exhaustive_up_to=0, partners=0, neighbors=1, min_votes=30))
    run(photos, tmp_path / "ws", config)
    again = run(photos, tmp_path / "ws", config)
    assert again.work() == (0, 0, 0)
    assert ("pairs", 0) in _rounds(again)
    write_photo(photos / "b9.png", texture(3, (120, 160)))
    more = run(photos, tmp_path / "ws", config)
    assert ("pairs", 11) in _rounds(more)
    assert more.work()[0] == 1
    assert more.work()[1] <= 12  # neighbours and links of the new photo alone


def test_the_stage_says_how_many_pairs_it_keeps_and_the_ledger_for_which_photo(tmp_path):
    photos = two_walks(tmp_path / "photos")
    told = run(photos, tmp_path / "ws", PipelineConfig(retrieval=FEW))
    (said,) = [event.summary for event in told.events if isinstance(event, StageFinished) and event.stage == "pairs"]
    assert said.endswith("of 45 pairs look promising")
    with Database.open(tmp_path / "ws" / "database.db") as database:
        rows = [row for row in database.ledger() if row.stage == "pairs"]
    assert sorted(row.item for row in rows) == sorted(path.name for path in photos.iterdir())
    assert all(row.value >= 1 for row in rows)


def test_few_photos_are_compared_exhaustively_without_a_look(tmp_path):
    told = run(two_walks(tmp_path / "photos"), tmp_path / "ws")
    assert "pairs" not in [stage for stage, _ in _rounds(told)]
