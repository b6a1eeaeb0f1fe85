"""Which pairs a run compares when there are too many for all."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sfm.core.errors import ConfigError, InputError
from sfm.core.events import ImageCompared, Note, StageFinished, StageStarted
from sfm.io.database import Database
from sfm.pipeline import pair_scores
from sfm.pipeline.config import PipelineConfig
from sfm.retrieval import RetrievalConfig, choice, probe_scores
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
    assert more.work()[1] <= 20  # those of the new photo, and a few that the new vocabulary finds


def test_the_stage_says_how_many_pairs_it_keeps_and_the_ledger_for_which_photo(tmp_path):
    photos = two_walks(tmp_path / "photos")
    told = run(photos, tmp_path / "ws", PipelineConfig(retrieval=FEW))
    (said,) = [event.summary for event in told.events if isinstance(event, StageFinished) and event.stage == "pairs"]
    assert said.endswith("of 45 pairs look promising")
    with Database.open(tmp_path / "ws" / "database.db") as database:
        rows = [row for row in database.ledger() if row.stage == "pairs"]
    assert sorted(row.item for row in rows) == sorted(path.name for path in photos.iterdir())
    assert all(row.value >= 1 for row in rows)


def config_of(method: str, **options) -> PipelineConfig:
    return PipelineConfig(retrieval=dataclasses.replace(FEW, method=method, **options))


def test_the_scores_are_announced_image_by_image_and_the_pairs_with_the_time_they_take(tmp_path):
    told = run(two_walks(tmp_path / "photos"), tmp_path / "ws", PipelineConfig(retrieval=FEW))
    assert [e.name for e in told.events if isinstance(e, ImageCompared)] == [
        f"{w}{k}.png" for w in "ab" for k in range(5)
    ]
    said = [e.message for e in told.events if isinstance(e, Note)]
    assert any("of 45 pairs are compared (vocabulary: " in text and " s if all are new" in text for text in said)


def test_after_a_look_a_new_photo_is_compared_with_the_others_alone(tmp_path, monkeypatch):
    photos, compared = two_walks(tmp_path / "photos"), []

    def counted(probes, config, *, pairs, **options):
        compared.append(len(pairs))
        return probe_scores(probes, config, pairs=pairs, **options)

    monkeypatch.setattr(pair_scores, "probe_scores", counted)
    run(photos, tmp_path / "ws", config_of("look"))
    write_photo(photos / "a9.png", texture(3, (120, 160)))  # in the middle
    run(photos, tmp_path / "ws", config_of("look"))
    run(photos, tmp_path / "fresh", config_of("look"))
    assert compared == [45, 10, 55]
    again, fresh = ({frozenset(pair) for pair in _pairs(tmp_path / folder)[0]} for folder in ("ws", "fresh"))
    assert again == fresh


@pytest.mark.parametrize("method", ["vocabulary", "look", "sequential"])
def test_every_method_finds_what_hangs_together(tmp_path, method):
    photos = two_walks(tmp_path / "photos")
    run(photos, tmp_path / "ws", config_of(method, overlap=1))
    _, verified = _pairs(tmp_path / "ws")
    assert {(f"{walk}{k}.png", f"{walk}{k + 1}.png") for walk in "ab" for k in range(4)} <= verified


@pytest.mark.parametrize("similarity", ["tfidf", "vlad", "fisher"])
def test_vectors_choose_candidates_too(tmp_path, similarity):
    photos = two_walks(tmp_path / "photos")
    run(photos, tmp_path / "ws", config_of("vocabulary", similarity=similarity, candidates=3))
    matched, verified = _pairs(tmp_path / "ws")
    assert len(matched) < 45
    assert {(f"{walk}{k}.png", f"{walk}{k + 1}.png") for walk in "ab" for k in range(4)} <= verified


def place(path: Path, north_m: float | None) -> None:
    """Makes a photo a JPEG, with a position in Munich or so far to the north of it."""
    image = Image.fromarray(np.asarray(Image.open(path)))
    exif = image.getexif()
    if north_m is not None:
        minutes = IFDRational(round(60 * north_m / 111_200 * 1e6), 10**6)
        exif.get_ifd(0x8825).update({1: "N", 2: (48, minutes, 0), 3: "E", 4: (11, 0, 0)})
    image.save(path.with_suffix(".jpg"), exif=exif, quality=95)
    path.unlink()


def test_photos_are_compared_with_those_taken_near_by_and_those_without_a_place_by_what_they_show(tmp_path):
    photos = two_walks(tmp_path / "photos")
    for k in range(5):
        place(photos / f"a{k}.png", 50.0 * k)
        place(photos / f"b{k}.png", None if k == 2 else 10_000 + 50.0 * k)
    run(photos, tmp_path / "ws", config_of("spatial", spatial_partners=2, max_distance_m=60.0, retries=0))
    matched = {(name1[:2], name2[:2]) for name1, name2 in _pairs(tmp_path / "ws")[0]}
    by_place = {(f"a{k}", f"a{k + 1}") for k in range(4)} | {("b0", "b1"), ("b3", "b4")}
    assert by_place <= matched
    assert all("b2" in pair for pair in matched - by_place)
    assert {("b1", "b2"), ("b2", "b3")} <= matched


@pytest.mark.parametrize(("prefixes", "method"), [(["frame"], "sequential"), (["one", "other"], "vocabulary")])
def test_the_run_chooses_by_itself_and_says_why(tmp_path, monkeypatch, prefixes, method):
    monkeypatch.setattr(choice, "_MANY", 8)
    picture = texture(1, (120, 400))
    for k in range(12):
        write_photo(tmp_path / "photos" / f"{prefixes[k % len(prefixes)]}{k}.png", picture[:, 8 * k : 8 * k + 160])
    config = PipelineConfig(retrieval=dataclasses.replace(FEW, overlap=2, loop_partners=0))
    told = run(tmp_path / "photos", tmp_path / "ws", config)
    (said,) = [e.message for e in told.events if isinstance(e, Note) and "are compared" in e.message]
    assert f"({method}: " in said
    matched, _ = _pairs(tmp_path / "ws")
    assert (len(matched) == 11 + 10 + 8) is (method == "sequential")


def test_without_any_place_the_spatial_method_says_so(tmp_path):
    with pytest.raises(ConfigError, match="none of the photos says where it was taken"):
        run(two_walks(tmp_path / "photos", 2), tmp_path / "ws", config_of("spatial"))


def test_a_list_is_what_is_compared_and_nothing_else(tmp_path):
    photos, listed = two_walks(tmp_path / "photos"), tmp_path / "pairs.txt"
    listed.write_text("a0.png a1.png\nb1.png a3.png\n")
    config = config_of("list", pair_list=str(listed))
    told = run(photos, tmp_path / "ws", config)
    assert _pairs(tmp_path / "ws")[0] == {("a0.png", "a1.png"), ("a3.png", "b1.png")}
    assert "pairs" not in [stage for stage, _ in _rounds(told)]
    listed.write_text("a0.png a1.png\n")
    assert run(photos, tmp_path / "ws", config).work() == (0, 0, 0)
    assert _pairs(tmp_path / "ws")[0] == {("a0.png", "a1.png")}


def test_a_list_that_cannot_be_used_ends_the_run_before_the_work_and_is_not_kept(tmp_path):
    photos, listed = two_walks(tmp_path / "photos", 2), tmp_path / "pairs.txt"
    listed.write_text("a0.png a7.png\n")
    with pytest.raises(InputError, match=r"a7\.png"):
        run(photos, tmp_path / "ws", config_of("list", pair_list=str(listed)))
    assert not (tmp_path / "ws" / "sfm.toml").exists()
    with pytest.raises(ConfigError, match="needs a file"):
        run(photos, tmp_path / "ws", config_of("list"))


def test_few_photos_are_compared_exhaustively_without_a_look(tmp_path):
    told = run(two_walks(tmp_path / "photos"), tmp_path / "ws")
    assert "pairs" not in [stage for stage, _ in _rounds(told)]
