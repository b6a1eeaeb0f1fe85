from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.core.errors import ConfigError, ImageError, InputError, ReconstructionError
from sfm.core.events import FeaturesExtracted, Note, PairMatched, PairVerified, StageStarted
from sfm.features import FeatureConfig
from sfm.io.colmap_model import read_model
from sfm.io.database import Database
from sfm.matching import MatchingConfig
from sfm.pipeline import image_features, stages
from sfm.pipeline.config import CameraConfig, PipelineConfig
from sfm.pipeline.run import reconstruct


def texture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return cv2.resize(rng.integers(0, 256, (60, 80), dtype=np.uint8), (160, 120), interpolation=cv2.INTER_CUBIC)


class Told:
    """Everything that was told, as an observer."""

    def __init__(self) -> None:
        self.events = []

    def __call__(self, event, /) -> None:
        self.events.append(event)

    def count(self, kind: type) -> int:
        return sum(isinstance(event, kind) for event in self.events)

    def work(self) -> tuple[int, int, int]:
        return self.count(FeaturesExtracted), self.count(PairMatched), self.count(PairVerified)


def model_bytes(workspace: Path) -> dict[str, bytes]:
    files = sorted((workspace / "sparse").rglob("*.bin"))
    assert files
    return {path.relative_to(workspace).as_posix(): path.read_bytes() for path in files}


def run(photos: Path, workspace: Path, config: PipelineConfig | None = None, **options) -> Told:
    told = Told()
    reconstruct(photos, workspace, config or PipelineConfig(), threads=options.pop("threads", 1), observer=told)
    return told


def test_a_run_leaves_database_models_settings_manifest_and_logs(photos, tmp_path):
    report = reconstruct(photos, tmp_path / "ws", threads=1)
    assert (report.images, report.models[0].images) == (4, 2)
    model = read_model(tmp_path / "ws" / "sparse" / "0")
    assert report.models[0].points == len(model.tracks) > 30
    assert report.models[0].mean_track_length == 2
    assert report.models[0].mean_error_px == pytest.approx(0.5)
    manifest = json.loads((tmp_path / "ws" / "manifest.json").read_text())
    assert manifest["settings"]["features.max_image_size"] == 3200
    assert set(manifest["stages"]) == {"images", "features", "matching", "verification", "mapping"}
    assert "[features]" in (tmp_path / "ws" / "sfm.toml").read_text()
    assert len(list((tmp_path / "ws" / "logs").glob("*.log"))) == 1
    lines = next((tmp_path / "ws" / "logs").glob("*.jsonl")).read_text().splitlines()
    assert {"ts", "level", "event", "stage", "done", "total"} <= set(json.loads(lines[-1]))
    assert not (tmp_path / "ws" / ".lock").exists()


def test_the_photos_are_not_touched(photos, tmp_path):
    before = {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in photos.iterdir()}
    run(photos, tmp_path / "ws")
    assert {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in photos.iterdir()} == before


def test_the_verdict_names_what_a_person_wants_to_know(photos, tmp_path):
    verdict = reconstruct(photos, tmp_path / "ws", threads=1).verdict()
    assert "2 of 4 images registered (missing: photo" in verdict
    assert str(tmp_path / "ws" / "sparse" / "0") in verdict
    assert "0.500 px" in verdict


def test_points_take_the_colours_of_the_photos(photos, tmp_path):
    run(photos, tmp_path / "ws")
    model = read_model(tmp_path / "ws" / "sparse" / "0")
    image_id, feature = model.tracks.image_ids[0], model.tracks.feature_ids[0]
    row = int(np.searchsorted(model.image_ids, image_id))
    x, y = model.keypoints[model.keypoint_offsets[row] + feature]
    photo = cv2.imread(str(photos / model.image_names[row]))[..., ::-1]
    expected = photo[int(y), int(x)].astype(int)
    assert np.abs(model.colors[0].astype(int) - expected).max() <= 8  # the mean of two cuts of the same picture


@pytest.mark.parametrize("threads", [2, 5])
def test_the_number_of_threads_does_not_change_a_byte(photos, tmp_path, threads):
    run(photos, tmp_path / "one", threads=1)
    run(photos, tmp_path / "many", threads=threads)
    assert model_bytes(tmp_path / "one") == model_bytes(tmp_path / "many")


def test_a_second_run_does_nothing_again(photos, tmp_path):
    assert run(photos, tmp_path / "ws").work() == (4, 6, 6)
    before = model_bytes(tmp_path / "ws")
    again = run(photos, tmp_path / "ws")
    assert again.work() == (0, 0, 0)
    assert [e.total for e in again.events if isinstance(e, StageStarted) and e.stage == "mapping"] == [0]
    assert model_bytes(tmp_path / "ws") == before


def test_a_new_photo_does_not_redo_the_others(photos, tmp_path):
    last = photos / "photo3.png"
    shutil.move(last, tmp_path / "photo3.png")
    run(photos, tmp_path / "ws")
    shutil.move(tmp_path / "photo3.png", last)
    assert run(photos, tmp_path / "ws").work() == (1, 3, 3)
    run(photos, tmp_path / "fresh")
    assert model_bytes(tmp_path / "ws") == model_bytes(tmp_path / "fresh")


def test_a_photo_that_is_gone_is_forgotten(photos, tmp_path):
    run(photos, tmp_path / "ws")
    (photos / "photo1.png").unlink()
    assert run(photos, tmp_path / "ws").work() == (0, 0, 0)
    with Database.open(tmp_path / "ws" / "database.db", readonly=True) as database:
        assert [row.name for row in database.images()] == ["photo0.png", "photo2.png", "photo3.png"]
        assert len(database.matched_pairs()) == len(database.verified_pairs()) == 3
        assert len(database.stage_keys("matching")) == 3


def test_a_changed_photo_is_computed_again_and_a_touched_one_is_not(photos, tmp_path):
    run(photos, tmp_path / "ws")
    os.utime(photos / "photo0.png", (1, 1))
    assert run(photos, tmp_path / "ws").work() == (0, 0, 0)
    cv2.imwrite(str(photos / "photo0.png"), texture(9))
    assert run(photos, tmp_path / "ws").work() == (1, 3, 3)


def test_a_setting_makes_stale_what_depends_on_it_and_no_more(photos, tmp_path):
    run(photos, tmp_path / "ws")
    assert run(photos, tmp_path / "ws", PipelineConfig(seed=1)).work() == (0, 0, 6)
    assert run(photos, tmp_path / "ws", PipelineConfig(seed=1, matching=MatchingConfig(max_ratio=0.7))).work() == (
        0,
        6,
        6,
    )
    assert run(photos, tmp_path / "ws", PipelineConfig(features=FeatureConfig(max_features=300))).work() == (4, 6, 6)
    camera = PipelineConfig(features=FeatureConfig(max_features=300), cameras=CameraConfig(model="PINHOLE"))
    assert run(photos, tmp_path / "ws", camera).work() == (0, 0, 6)


def test_results_that_were_deleted_are_computed_again(photos, tmp_path):
    run(photos, tmp_path / "ws")
    before = model_bytes(tmp_path / "ws")
    with Database.open(tmp_path / "ws" / "database.db") as database:
        image_ids = [row.image_id for row in database.images()]
        database.clear_features(image_ids[0])
        database.clear_matches((image_ids[1], image_ids[2]))
    (tmp_path / "ws" / "sparse" / "0" / "points3D.bin").unlink()
    assert run(photos, tmp_path / "ws").work() == (1, 1, 0)
    assert model_bytes(tmp_path / "ws") == before


@pytest.mark.parametrize(("sharing", "cameras"), [("auto", 1), ("single", 1), ("folder", 2), ("image", 4)])
def test_photos_share_cameras_as_asked(photos, tmp_path, sharing, cameras):
    (photos / "left").mkdir()
    shutil.move(photos / "photo0.png", photos / "left" / "photo0.png")
    run(photos, tmp_path / "ws", PipelineConfig(cameras=CameraConfig(sharing=sharing)))
    with Database.open(tmp_path / "ws" / "database.db", readonly=True) as database:
        assert len(database.cameras()) == cameras
        assert {row.camera_id for row in database.images()} == set(database.cameras())


def test_sharing_can_change_between_runs(photos, tmp_path):
    for sharing in ("auto", "image", "folder", "image"):
        config = PipelineConfig(cameras=CameraConfig(sharing=sharing))
        run(photos, tmp_path / "ws", config)
        run(photos, tmp_path / sharing, config)
        with Database.open(tmp_path / "ws" / "database.db", readonly=True) as database:
            assert len(database.cameras()) == (4 if sharing == "image" else 1)
            assert {row.camera_id for row in database.images()} == set(database.cameras())


def test_photos_of_other_sizes_have_other_cameras_and_a_warning_if_one_was_asked_for(photos, tmp_path):
    cv2.imwrite(str(photos / "small.png"), texture(3)[:80])
    told = run(photos, tmp_path / "ws", PipelineConfig(cameras=CameraConfig(sharing="single")))
    assert any(isinstance(event, Note) and "differ in size" in event.message for event in told.events)
    with Database.open(tmp_path / "ws" / "database.db", readonly=True) as database:
        assert {(c.width, c.height) for c in database.cameras().values()} == {(160, 120), (160, 80)}


def test_given_intrinsics_are_used_scaled_and_held(photos, tmp_path, monkeypatch):
    seen = {}

    def mapper(graph, keypoints, cameras, *args, refine_intrinsics, **kwargs):
        seen.update(cameras=cameras, refine=refine_intrinsics)
        return []

    monkeypatch.setattr("sfm.pipeline.models.map_incrementally", mapper)
    file = tmp_path / "cameras.txt"
    file.write_text("1 PINHOLE 320 240 300 310 161 119\n")
    for refine in (False, True):
        config = PipelineConfig(cameras=CameraConfig(intrinsics=str(file), refine_intrinsics=refine))
        with pytest.raises(ReconstructionError):
            run(photos, tmp_path / "ws", config)
        (camera,) = seen["cameras"].values()
        assert camera.params.tolist() == [150, 155, 80.5, 59.5]
        assert camera.has_prior_focal_length
        assert seen["refine"] is refine


def test_intrinsics_of_another_shape_are_refused(photos, tmp_path):
    file = tmp_path / "cameras.txt"
    file.write_text("1 PINHOLE 300 300 300 310 161 119\n")
    with pytest.raises(ConfigError, match=r"300×300 px, but photo0.png has 160×120"):
        run(photos, tmp_path / "ws", PipelineConfig(cameras=CameraConfig(intrinsics=str(file))))


def test_unusable_files_are_skipped_with_a_reason(photos, tmp_path):
    (photos / "notes.txt").write_text("not a photo")
    (photos / "empty.jpg").write_bytes(b"")
    (photos / "broken.png").write_bytes((photos / "photo0.png").read_bytes()[:2000])
    report = reconstruct(photos, tmp_path / "ws", threads=1)
    assert report.images == 4
    assert set(report.skipped) == {"notes.txt", "empty.jpg", "broken.png"}
    assert "truncated" in report.skipped["broken.png"]
    with Database.open(tmp_path / "ws" / "database.db", readonly=True) as database:
        assert {row.item for row in database.ledger(stage="images")} == set(report.skipped)


def test_a_photo_that_fails_while_it_is_read_does_not_end_the_run(photos, tmp_path, monkeypatch):
    def failing(path, **options):
        if path.name == "photo1.png":
            raise ImageError("is broken inside", path=path)
        return original(path, **options)

    original = image_features.read_image
    monkeypatch.setattr(image_features, "read_image", failing)
    run(photos, tmp_path / "ws")
    with Database.open(tmp_path / "ws" / "database.db", readonly=True) as database:
        (decision,) = database.ledger("photo1.png", stage="features")
        assert (decision.verdict, decision.detail) == ("unreadable", "is broken inside")
        assert len(database.matched_pairs()) == 3


def test_a_folder_without_photos_is_refused(tmp_path):
    (tmp_path / "photos").mkdir()
    with pytest.raises(InputError, match="no photos in this folder"):
        run(tmp_path / "photos", tmp_path / "ws")
    (tmp_path / "photos" / "notes.txt").write_text("text")
    with pytest.raises(InputError, match=r"none of 1 files is a usable photo \(notes.txt: is a text file"):
        run(tmp_path / "photos", tmp_path / "ws")
    with pytest.raises(InputError, match="no such folder"):
        run(tmp_path / "absent", tmp_path / "ws")


def test_a_workspace_within_the_photos_is_refused(photos):
    for workspace in (photos, photos / "ws"):
        with pytest.raises(ConfigError, match="never written to"):
            run(photos, workspace)
    assert sorted(path.name for path in photos.iterdir()) == [f"photo{k}.png" for k in range(4)]


def test_photos_of_different_things_are_told_apart(tmp_path):
    (tmp_path / "photos").mkdir()
    for k in (1, 2):
        cv2.imwrite(str(tmp_path / "photos" / f"{k}.png"), texture(k))
    with pytest.raises(ReconstructionError, match=r"no two of 2 photos show the same scene.*1.png and 2.png"):
        run(tmp_path / "photos", tmp_path / "ws")


def test_models_that_no_longer_hold_go_with_the_manifest(photos, tmp_path, monkeypatch):
    run(photos, tmp_path / "ws")
    (tmp_path / "ws" / "sparse" / "1").mkdir()
    monkeypatch.setattr("sfm.pipeline.models.map_incrementally", lambda *arguments, **options: [])
    with pytest.raises(ReconstructionError):
        run(photos, tmp_path / "ws", PipelineConfig(seed=1))
    assert list((tmp_path / "ws" / "sparse").iterdir()) == []
    assert not (tmp_path / "ws" / "manifest.json").exists()


def test_one_photo_is_not_enough(tmp_path):
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / "photos" / "only.png"), texture(1))
    with pytest.raises(ReconstructionError, match="one photo is not enough"):
        run(tmp_path / "photos", tmp_path / "ws")


def test_photos_without_texture_are_named_as_such(tmp_path):
    (tmp_path / "photos").mkdir()
    for k in (1, 2):
        cv2.imwrite(str(tmp_path / "photos" / f"{k}.png"), np.full((100, 100), 90 * k, np.uint8))
    with pytest.raises(ReconstructionError, match="texture"):
        run(tmp_path / "photos", tmp_path / "ws")


def test_an_exception_leaves_finished_items_and_a_log(photos, tmp_path, monkeypatch):
    calls = []

    def failing(*arguments):
        calls.append(1)
        if len(calls) > 3:
            raise RuntimeError("planted")
        return original(*arguments)

    original = stages.match_features
    monkeypatch.setattr(stages, "match_features", failing)
    monkeypatch.setattr(stages, "_COMMIT_EVERY_S", 0.0)
    with pytest.raises(RuntimeError, match="planted") as caught:
        run(photos, tmp_path / "ws")
    log = Path(caught.value.__notes__[0].removeprefix("log: "))
    assert "planted" in log.read_text()
    monkeypatch.setattr(stages, "match_features", original)
    assert run(photos, tmp_path / "ws").work() == (0, 3, 6)
    run(photos, tmp_path / "fresh")
    assert model_bytes(tmp_path / "ws") == model_bytes(tmp_path / "fresh")


def _slow_run(photos: Path, workspace: Path) -> None:
    """In a process of its own: a run whose items take a while."""

    def slow(event, /) -> None:
        time.sleep(0.02)

    stages._COMMIT_EVERY_S = 0.03
    reconstruct(photos, workspace, threads=2, observer=slow)


@pytest.mark.skipif(os.name == "nt", reason="fork and SIGKILL are POSIX")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("delay_s", [0.08, 0.25, 0.4])
def test_a_killed_run_continues_to_the_same_bytes(photos, tmp_path, delay_s):
    run(photos, tmp_path / "uninterrupted")
    process = multiprocessing.get_context("fork").Process(target=_slow_run, args=(photos, tmp_path / "ws"))
    process.start()
    time.sleep(delay_s)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    run(photos, tmp_path / "ws")
    assert model_bytes(tmp_path / "ws") == model_bytes(tmp_path / "uninterrupted")
