"""Corners followed through a video, from the files to the pairs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.core.errors import ConfigError
from sfm.core.events import SILENT
from sfm.core.scene import DescriptorKind
from sfm.features import FeatureConfig
from sfm.io.database import Database
from sfm.matching import MatchingConfig
from sfm.pipeline.config import CameraConfig, PipelineConfig
from sfm.pipeline.pairs import check_pair_settings, first_pairs
from sfm.pipeline.scene import read_scene
from sfm.pipeline.stages import Run, extract_all, match_all
from sfm.retrieval import RetrievalConfig
from tests.features.rendering import texture
from tests.pipeline.conftest import write_photo

CONFIG = PipelineConfig(features=FeatureConfig(kind="klt"))
PICTURE = texture(3, (200, 420))


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """A camera that slides along a picture by 4 px a frame; names sort by number, not by letter."""
    for k in range(12):
        write_photo(tmp_path / "frames" / f"f{k}.png", PICTURE[:, 4 * k : 4 * k + 300])
    return tmp_path / "frames"


def opened(database: Database, frames: Path, config: PipelineConfig = CONFIG) -> Run:
    scene = read_scene(database, frames, CameraConfig(), threads=1, observer=SILENT)
    return Run(database, config, 2, SILENT, scene.images)


def id_of(run: Run, name: str) -> int:
    return next(k for k, image in run.images.items() if image.name == name)


def test_frames_share_corners_in_the_order_of_their_numbers(frames, tmp_path):
    with Database.open(tmp_path / "d.db") as database:
        run = opened(database, frames)
        keys = extract_all(run)
        ids = [id_of(run, f"f{k}.png") for k in range(12)]
        assert database.read_features(ids[0]).kind == DescriptorKind.FOLLOWED
        pairs = [(ids[2], ids[3]), tuple(sorted((ids[0], ids[9]))), tuple(sorted((ids[9], ids[10])))]
        match_all(run, keys, pairs)
        for i, j in pairs:
            rows = database.read_matches(i, j).indices
            shift = database.read_keypoints(j)[rows[:, 1]] - database.read_keypoints(i)[rows[:, 0]]
            number = [int(run.images[k].name[1:-4]) for k in (i, j)]
            assert len(rows) > 30
            assert np.median(np.abs(shift - [4 * (number[0] - number[1]), 0]).max(axis=1)) < 0.1


def test_large_frames_are_reduced_and_corners_are_in_pixels_of_the_full_image(frames, tmp_path):
    config = PipelineConfig(features=FeatureConfig(kind="klt", max_image_size=150))
    with Database.open(tmp_path / "d.db") as database:
        run = opened(database, frames, config)
        keys = extract_all(run)
        i, j = sorted((id_of(run, "f0.png"), id_of(run, "f2.png")))
        match_all(run, keys, [(i, j)])
        rows = database.read_matches(i, j).indices
        shift = database.read_keypoints(j)[rows[:, 1]] - database.read_keypoints(i)[rows[:, 0]]
        assert database.read_keypoints(i)[:, 0].max() > 200
        assert np.median(np.abs(shift - [-8, 0]).max(axis=1)) < 0.3


def test_a_changed_frame_changes_it_and_those_after_it_only(frames, tmp_path):
    with Database.open(tmp_path / "d.db") as database:
        before = extract_all(opened(database, frames))
        write_photo(frames / "f6.png", PICTURE[:, 25:325])
        run = opened(database, frames)
        after = extract_all(run)
        again = extract_all(run)
    names = {run.images[k].name for k in after if after[k] != before.get(k)}
    assert names == {f"f{k}.png" for k in range(6, 12)}
    assert again == after


def test_results_do_not_depend_on_what_was_there_before(frames, tmp_path):
    def stored(path: Path) -> list[bytes]:
        with Database.open(path) as database:
            run = opened(database, frames)
            extract_all(run)
            found = [database.read_features(id_of(run, f"f{k}.png")) for k in range(12)]
        return [features.points2D.tobytes() + features.descriptors.tobytes() for features in found]

    last = (frames / "f11.png").read_bytes()
    (frames / "f11.png").unlink()
    with Database.open(tmp_path / "grown.db") as database:
        extract_all(opened(database, frames))
    (frames / "f11.png").write_bytes(last)
    assert stored(tmp_path / "grown.db") == stored(tmp_path / "new.db")


def test_pairs_are_neighbours_in_time(frames, tmp_path):
    with Database.open(tmp_path / "d.db") as database:
        short = RetrievalConfig(exhaustive_up_to=5, overlap=2)
        run = opened(database, frames, PipelineConfig(features=FeatureConfig(kind="klt"), retrieval=short))
        choice = first_pairs(run, extract_all(run))
        number = {k: int(image.name[1:-4]) for k, image in run.images.items()}
    assert "followed" in choice.why
    assert {abs(number[i] - number[j]) for i, j in choice.pairs} == {1, 2, 4}


def test_what_needs_descriptors_is_refused(frames, tmp_path):
    with Database.open(tmp_path / "d.db") as database:
        asked = PipelineConfig(features=FeatureConfig(kind="klt"), retrieval=RetrievalConfig(method="vocabulary"))
        with pytest.raises(ConfigError, match="klt have no descriptors"):
            check_pair_settings(opened(database, frames, asked))
    with pytest.raises(ConfigError, match="guided"):
        PipelineConfig(features=FeatureConfig(kind="klt"), matching=MatchingConfig(guided=True))


def test_settings_of_other_detectors_change_nothing(frames, tmp_path):
    with Database.open(tmp_path / "d.db") as database:
        keys = extract_all(opened(database, frames))
        other = PipelineConfig(features=FeatureConfig(kind="klt", max_features=77, contrast_threshold=0.5))
        assert extract_all(opened(database, frames, other)) == keys
        smaller = PipelineConfig(features=FeatureConfig(kind="klt", max_image_size=200))
        assert not set(extract_all(opened(database, frames, smaller)).values()) & set(keys.values())


def test_the_ledger_tells_what_a_mask_hides_from_the_search_for_corners(frames, tmp_path):
    hidden = np.zeros((200, 300), np.uint8)
    hidden[:, 90:] = 255
    write_photo(frames / "masks" / "f3.png", hidden)
    with Database.open(tmp_path / "d.db") as database:
        run = opened(database, frames)
        extract_all(run)
        rows = {f"f{k}.png": database.ledger(f"f{k}.png") for k in range(12)}
        x = database.read_keypoints(id_of(run, "f3.png"))[:, 0]
    masked = {name: [row for row in told if row.gate == "masked_percent"] for name, told in rows.items()}
    assert [name for name in masked if masked[name]] == ["f3.png"]
    (row,) = masked["f3.png"]
    assert row.value == pytest.approx(30.0)
    assert "30% of the pixels (f3.png)" in row.detail
    assert x.min() >= 90
