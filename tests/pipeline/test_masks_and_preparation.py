from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.core.errors import ConfigError, ImageError, InputError, ReconstructionError
from sfm.core.events import Note
from sfm.features import FeatureConfig
from sfm.io.database import Database
from sfm.matching import MatchingConfig
from sfm.pipeline import stages
from sfm.pipeline.config import PipelineConfig
from sfm.pipeline.run import reconstruct
from sfm.prepare import PrepareConfig
from tests.features.onnx_files import constant_network
from tests.pipeline.conftest import write_photo

LEFT_HIDDEN = np.repeat(np.where(np.arange(160) < 60, 0, 255)[None], 120, axis=0).astype(np.uint8)


def run(photos: Path, workspace: Path, config: PipelineConfig = PipelineConfig()) -> tuple[Database, list]:
    events: list = []
    reconstruct(photos, workspace, config, threads=1, observer=events.append)
    return Database.open(workspace / "database.db", readonly=True), events


def names(database: Database) -> list[str]:
    return [row.name for row in database.images()]


@pytest.mark.parametrize("where", ["within", "beside", "named"])
def test_nothing_is_found_in_what_a_mask_hides(photos, tmp_path, where):
    folder = {"within": photos / "masks", "beside": tmp_path / "masks", "named": tmp_path / "my masks"}[where]
    write_photo(folder / "photo1.png.png", LEFT_HIDDEN)
    setting = str(folder) if where == "named" else ""
    database, events = run(photos, tmp_path / "ws", PipelineConfig(masks=setting))
    with database:
        assert names(database) == [f"photo{k}.png" for k in range(4)]
        x = [database.read_keypoints(k)[:, 0] for k in (1, 2)]
        (row,) = [d for d in database.ledger("photo1.png") if d.gate == "masked_percent"]
        assert not [d for d in database.ledger("photo0.png") if d.gate == "masked_percent"]
    assert x[0].min() < 60 <= x[1].min()
    assert 20 < row.value < 60
    assert "38% of the pixels" in row.detail
    notes = [event.message for event in events if isinstance(event, Note)]
    assert any("masks from" in note and "without one: photo0.png, photo2.png, photo3.png" in note for note in notes)


def test_another_mask_is_another_result_and_no_mask_the_first_again(photos, tmp_path):
    def keypoints(config: PipelineConfig = PipelineConfig()) -> int:
        with run(photos, tmp_path / "ws", config)[0] as database:
            return database.feature_counts()[2]

    everything = keypoints()
    write_photo(tmp_path / "masks" / "photo1_mask.png", LEFT_HIDDEN)
    fewer = keypoints()
    write_photo(tmp_path / "masks" / "photo1_mask.png", LEFT_HIDDEN[:, ::-1].copy())
    assert len({everything, fewer, keypoints()}) == 3
    assert keypoints(PipelineConfig(masks="none")) == everything


def test_masks_that_do_not_fit_end_the_run_before_it_begins(photos, tmp_path):
    write_photo(tmp_path / "masks" / "other.png", LEFT_HIDDEN)
    with pytest.raises(InputError, match=r"photo0\.png\.png"):
        run(photos, tmp_path / "ws", PipelineConfig(masks=str(tmp_path / "masks")))
    run(photos, tmp_path / "ws")[0].close()  # nobody has named the folder: it may belong to other photos
    write_photo(tmp_path / "masks" / "photo0.png", LEFT_HIDDEN[:50])
    with pytest.raises(ImageError, match=r"160×50 px, its photo photo0\.png has 160×120 px"):
        run(photos, tmp_path / "ws")


def test_preparation_is_recorded_and_finds_more_in_flat_photos(photos, tmp_path):
    for path in photos.iterdir():
        image = cv2.imread(str(path))
        write_photo(path, (110 + 0.08 * image).astype(np.uint8))
    plain = features_without_preparation(photos, tmp_path / "off")
    with run(
        photos,
        tmp_path / "auto",
        PipelineConfig(prepare=PrepareConfig(mode="auto"), features=FeatureConfig(min_features=0)),
    )[0] as database:
        prepared = database.feature_counts()[1]
        (row,) = [d for d in database.ledger("photo0.png") if d.gate == "preparation"]
    assert row.verdict == "stretch"
    assert "noise" in row.detail
    assert prepared > 3 * plain
    lowered = PipelineConfig(features=FeatureConfig(min_features=200))
    with run(photos, tmp_path / "low", lowered)[0] as database:
        assert database.feature_counts()[1] > 3 * plain
        (row,) = [d for d in database.ledger("photo0.png") if d.gate == "contrast_threshold"]
    assert row.value < row.threshold == 0.02


def features_without_preparation(photos: Path, workspace: Path) -> int:
    """Number of features of the first photo, whether or not that suffices for a model."""
    with contextlib.suppress(ReconstructionError):
        run(photos, workspace, PipelineConfig(features=FeatureConfig(min_features=0)))[0].close()
    with Database.open(workspace / "database.db", readonly=True) as database:
        return database.feature_counts()[1]


def test_binary_features_go_through_the_pipeline(photos, tmp_path):
    config = PipelineConfig(features=FeatureConfig(kind="orb"))
    database, _ = run(photos, tmp_path / "ws", config)
    with database:
        features = database.read_features(1)
        assert features.descriptors.shape[1] == 32
        assert len(database.read_view_graph()) == 6
    again = dataclasses.replace(config, features=FeatureConfig(kind="shi_tomasi"))
    with run(photos, tmp_path / "ws", again)[0] as database:
        assert len(database.read_view_graph()) == 6


def test_a_network_without_its_file_is_a_mistake_in_words(photos, tmp_path):
    for options in ({"kind": "aliked"}, {"kind": "disk", "model": str(tmp_path / "none.onnx")}):
        with pytest.raises(ConfigError, match=r"needs the file|no such file"):
            run(photos, tmp_path / "ws", PipelineConfig(features=FeatureConfig(**options)))


def test_guided_matching_adds_what_agrees_with_a_verified_pair(photos, tmp_path, monkeypatch):
    plausible = stages.verify_pair

    def along_rows(*inputs, rng, **distinct):
        geometry = plausible(*inputs, rng=rng, **distinct)
        shift = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the photos are cuts side by side
        return dataclasses.replace(geometry, F=shift) if geometry else geometry

    monkeypatch.setattr(stages, "verify_pair", along_rows)
    strict = MatchingConfig(max_ratio=0.3)

    def inliers(name: str, matching: MatchingConfig) -> int:
        with run(photos, tmp_path / name, PipelineConfig(matching=matching))[0] as database:
            return sum(len(geometry) for geometry in database.read_view_graph().pairs.values())

    assert inliers("guided", dataclasses.replace(strict, guided=True)) > inliers("plain", strict)


def test_features_and_matches_of_networks_go_through_the_pipeline(photos, tmp_path):
    """Networks that answer the same whatever they see: features on a grid, each matched with its like."""
    x, y = np.meshgrid(np.arange(10, 150, 8), np.arange(10, 110, 8))
    points = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32)
    count = len(points)
    descriptors = np.random.default_rng(0).normal(size=(count, 64)).astype(np.float32)
    answers = {"keypoints": points, "scores": np.ones(count, np.float32), "descriptors": descriptors}
    (tmp_path / "aliked.onnx").write_bytes(constant_network(answers))
    pairs = np.stack([np.arange(count, dtype=np.float32)] * 2, axis=1)[::2]
    inputs = {"kpts0": 3, "kpts1": 3, "desc0": 3, "desc1": 3}
    answers = {"matches0": pairs, "mscores0": np.ones(len(pairs), np.float32)}
    (tmp_path / "lightglue.onnx").write_bytes(constant_network(answers, inputs))
    features = FeatureConfig(kind="aliked", model=str(tmp_path / "aliked.onnx"))
    for matching, expected in ((MatchingConfig(), count), (with_lightglue(tmp_path), len(pairs))):
        with run(photos, tmp_path / "ws", PipelineConfig(features=features, matching=matching))[0] as database:
            assert set(database.match_counts().values()) == {expected}
    with pytest.raises(ConfigError, match="needs features of a network"):
        run(photos, tmp_path / "ws", PipelineConfig(matching=with_lightglue(tmp_path)))


def with_lightglue(folder: Path) -> MatchingConfig:
    return MatchingConfig(lightglue=str(folder / "lightglue.onnx"))
