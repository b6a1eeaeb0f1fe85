"""Stages one by one leave what a whole run leaves, and a whole run goes on from them."""

from __future__ import annotations

import dataclasses
import shutil

import pytest

from sfm.core.errors import ConfigError, InputError, WorkspaceLockedError
from sfm.core.events import FeaturesExtracted, Note, PairMatched, PairVerified, StageStarted
from sfm.io.database import Database
from sfm.pipeline.config import PipelineConfig
from sfm.pipeline.lock import locked
from sfm.pipeline.run import reconstruct
from sfm.pipeline.session import remembered_folder
from sfm.pipeline.single_stages import run_features, run_matching, run_pairs, run_verification
from sfm.retrieval import RetrievalConfig
from tests.pictures import texture
from tests.pipeline.conftest import write_photo

MANY = PipelineConfig(retrieval=RetrievalConfig(exhaustive_up_to=2, partners=1, neighbors=0))
"""Settings under which four photos are many, so that pairs are chosen."""


class Told:
    """How much of each kind of work was done, and what was said."""

    def __init__(self) -> None:
        self.events = []

    def __call__(self, event, /) -> None:
        self.events.append(event)

    def work(self) -> tuple[int, int, int]:
        kinds = (FeaturesExtracted, PairMatched, PairVerified)
        return tuple(sum(isinstance(event, kind) for event in self.events) for kind in kinds)  # type: ignore[return-value]

    def notes(self) -> list[str]:
        """But for the announcement of the pairs."""
        messages = [event.message for event in self.events if isinstance(event, Note)]
        return [message for message in messages if "pairs are compared" not in message]

    def stages(self) -> list[str]:
        return [event.stage for event in self.events if isinstance(event, StageStarted)]


def model_bytes(workspace) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((workspace / "sparse" / "0").iterdir())}


@pytest.mark.parametrize("config", [PipelineConfig(), MANY], ids=["few", "many"])
def test_four_stages_and_a_run_do_nothing_twice_and_end_at_the_model_of_one_run(photos, tmp_path, config):
    ws, whole = tmp_path / "ws", Told()
    reconstruct(photos, tmp_path / "whole", config, threads=1, observer=whole)
    tolds = [Told() for _ in range(5)]
    run_features(photos, ws, config, threads=1, observer=tolds[0])
    run_pairs(ws, config, threads=1, observer=tolds[1])
    run_matching(ws, config, threads=1, observer=tolds[2])
    run_verification(ws, config, threads=1, observer=tolds[3])
    reconstruct(photos, ws, config, threads=1, observer=tolds[4])
    assert tolds[0].work() == (4, 0, 0)
    assert tolds[1].work() == (0, 0, 0)
    assert tolds[2].work()[::2] == (0, 0)
    assert tolds[4].work() == (0, 0, 0)
    assert "mapping" in tolds[4].stages()
    assert not any("mapping" in told.stages() for told in tolds[:4])
    done = tuple(sum(counts) for counts in zip(*(told.work() for told in tolds), strict=True))
    assert done == whole.work()
    assert [told.notes() for told in tolds] == [[]] * 5
    assert model_bytes(ws) == model_bytes(tmp_path / "whole")
    assert (ws / "sfm.toml").read_text() == (tmp_path / "whole" / "sfm.toml").read_text()


def test_missing_stages_are_done_first_and_named(photos, tmp_path):
    run_features(photos, tmp_path / "ws", threads=1)
    write_photo(photos / "photo9.png", texture(1, (160, 240))[20:140, 30:190])
    told = Told()
    report = run_verification(tmp_path / "ws", threads=1, observer=told)
    assert told.work() == (1, 10, 10)
    assert told.notes() == [
        f"first completing the {name} that `sfm verify` builds on" for name in ("features", "matching")
    ]
    assert len(report.pairs) == 10


def test_matches_of_a_whole_run_are_kept_by_a_stage_that_comes_before(photos, tmp_path):
    reconstruct(photos, tmp_path / "ws", threads=1)
    for stage in (run_pairs, run_matching, run_verification):
        told = Told()
        stage(tmp_path / "ws", threads=1, observer=told)
        assert told.work() == (0, 0, 0)
    told = Told()
    reconstruct(photos, tmp_path / "ws", threads=1, observer=told)
    assert told.work() == (0, 0, 0)


def test_the_reports_hold_what_is_in_the_database(photos, tmp_path):
    ws = tmp_path / "ws"
    write_photo(photos / "blank.png", texture(0, (120, 160)) * 0 + 128)
    write_photo(photos / "other.png", texture(5, (120, 160)))
    (photos / "notes.txt").write_text("not a photo")
    features = run_features(photos, ws, threads=1)
    pairs = run_pairs(ws, threads=1)
    matches = run_matching(ws, threads=1)
    verified = run_verification(ws, threads=1)
    with Database.open(ws / "database.db", readonly=True) as database:
        names = {row.image_id: row.name for row in database.images()}
        assert features.keypoints == {names[k]: count for k, count in database.feature_counts().items()}
        counts = {(names[i], names[j]): count for (i, j), count in database.match_counts().items()}
        linked = {(names[i], names[j]) for i, j in database.linked_pairs()}
    assert features.refused == {"blank.png": "no features"}
    assert features.skipped == {"notes.txt": "is a text file, not an image"}
    assert len(pairs.pairs) == 10  # of the five photos with features
    assert matches.matches == counts
    assert {(pair.image1, pair.image2) for pair in verified.pairs if pair.kind} == linked
    assert sorted(map(len, verified.groups)) == [1, 1, 4]
    rejected = [pair for pair in verified.pairs if pair.reason]
    assert len(rejected) == 4
    assert all(pair.inliers == 0 and pair.angle_deg is None for pair in rejected)


def test_the_verdicts_say_how_many_and_why(photos, tmp_path):
    ws = tmp_path / "ws"
    write_photo(photos / "other.png", texture(5, (120, 160)))
    assert "5 images, keypoints each" in run_features(photos, ws, threads=1).verdict()
    chosen = run_pairs(ws, MANY, threads=1).verdict()
    assert "of 10 pairs of 5 images: vocabulary: of few images what they show finds all pairs" in chosen
    assert "10 of 10 pairs of 5 images: all with all" in run_pairs(ws, threads=1).verdict()
    matched = run_matching(ws, threads=1).verdict()
    assert "4 pairs with fewer than 15" in matched
    verified = run_verification(ws, threads=1).verdict()
    assert "6 of 10 pairs verified" in verified
    assert "calibrated" in verified
    assert "4 × too few matches" in verified
    assert "images that hang together: 4 of 5" in verified
    assert "images without a verified pair: 1 (other.png)" in verified
    assert f"sfm run {photos} -o {ws}" in verified


def test_a_workspace_remembers_its_photos_also_one_of_before_the_note(photos, tmp_path):
    reconstruct(photos, tmp_path / "ws", threads=1)
    assert remembered_folder(tmp_path / "ws") == photos
    with Database.open(tmp_path / "ws" / "database.db") as database:
        database.set_meta("images_folder", "")
    assert remembered_folder(tmp_path / "ws") == photos
    (tmp_path / "ws" / "manifest.json").unlink()
    with pytest.raises(InputError, match="does not say which photos"):
        remembered_folder(tmp_path / "ws")


def test_photos_that_have_moved_are_named_anew(photos, tmp_path):
    run_features(photos, tmp_path / "ws", threads=1)
    shutil.move(photos, tmp_path / "moved")
    with pytest.raises(InputError, match=r"no such folder.*if they have moved") as refused:
        run_pairs(tmp_path / "ws", threads=1)
    assert refused.value.path == photos
    told = Told()
    run_features(tmp_path / "moved", tmp_path / "ws", threads=1, observer=told)
    assert told.work() == (0, 0, 0)
    assert len(run_pairs(tmp_path / "ws", threads=1).pairs) == 6


def test_what_is_no_workspace_is_refused_and_left_as_it_is(photos, tmp_path):
    with pytest.raises(InputError, match=r"there is no such workspace.*sfm features IMAGES"):
        run_matching(tmp_path / "absent")
    assert not (tmp_path / "absent").exists()
    with pytest.raises(InputError, match="is no workspace"):
        run_matching(photos)
    assert all(path.suffix == ".png" for path in photos.iterdir())
    with pytest.raises(InputError, match="is a file"):
        run_matching(photos / "photo0.png")
    with pytest.raises(ConfigError, match="never written to"):
        run_features(photos, photos / "ws")


def test_a_stage_takes_the_lock(photos, tmp_path):
    run_features(photos, tmp_path / "ws", threads=1)
    with locked(tmp_path / "ws"), pytest.raises(WorkspaceLockedError, match="another run works"):
        run_pairs(tmp_path / "ws", threads=1)
    assert not (tmp_path / "ws" / ".lock").exists()


def test_a_setting_of_a_later_stage_leaves_the_earlier_ones(photos, tmp_path):
    config = PipelineConfig()
    run_features(photos, tmp_path / "ws", config, threads=1)
    run_verification(tmp_path / "ws", config, threads=1)
    stricter = dataclasses.replace(config, verification=dataclasses.replace(config.verification, watermark_border=0.2))
    told = Told()
    run_verification(tmp_path / "ws", stricter, threads=1, observer=told)
    assert told.work() == (0, 0, 6)
