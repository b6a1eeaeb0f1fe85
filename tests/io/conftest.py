from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sfm.core.cameras import COLMAP_MODELS, Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import Reconstruction, Tracks

NAMES = ("a.jpg", "sub/with space.jpg", "Straße/фото №1.jpg", "img2.png", "img10.png")


@pytest.fixture
def make_reconstruction() -> Callable[..., Reconstruction]:
    """A random model in which ids have gaps, every camera model occurs and some keypoints have no point."""

    def make(points: int = 40, *, images: int = 5, seed: int = 0) -> Reconstruction:
        rng = np.random.default_rng(seed)
        cameras = {
            3 * k + 2: Camera(model.name, 640 + k, 480, rng.uniform(0.1, 300, len(model.param_names)))
            for k, model in enumerate(COLMAP_MODELS)
        }
        image_ids = np.sort(rng.choice(1000, images, replace=False)) + 1
        counts = rng.integers(points, points + 9, images) if points else np.zeros(images, np.int64)
        seen = [
            np.sort(rng.choice(images, rng.integers(min(2, images), images + 1), replace=False)) for _ in range(points)
        ]
        rows = np.concatenate([np.zeros(0, np.int64), *seen])
        # Point p is seen at a keypoint of its own in each image, in an order of the image's own.
        shuffles = [rng.permutation(int(count)) for count in counts]
        feature_ids = [shuffles[row][p] for p, group in enumerate(seen) for row in group]
        return Reconstruction(
            cameras=cameras,
            image_ids=image_ids.astype(np.int32),
            image_names=tuple((NAMES[k] if k < len(NAMES) else f"{k}.jpg") for k in range(images)),
            image_camera_ids=rng.choice(list(cameras), images).astype(np.int32),
            cams_from_world=Rigid3.exp(rng.normal(size=(images, 6))),
            keypoint_offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
            keypoints=rng.uniform(0, 640, (int(counts.sum()), 2)),
            points3D=rng.normal(size=(points, 3)),
            point_ids=rng.choice(2**40, points, replace=False),
            colors=rng.integers(0, 256, (points, 3), np.uint8),
            errors=rng.uniform(0, 2, points),
            tracks=Tracks(
                np.concatenate([[0], np.cumsum([len(g) for g in seen])]).astype(np.int64),
                image_ids[rows].astype(np.int32),
                np.array(feature_ids, np.int32),
            ),
        )

    return make


@pytest.fixture
def assert_same_model() -> Callable[[Reconstruction, Reconstruction], None]:
    """Equal to the last bit."""

    def check(actual: Reconstruction, expected: Reconstruction) -> None:
        assert list(actual.cameras) == list(expected.cameras)
        for camera_id, camera in expected.cameras.items():
            other = actual.cameras[camera_id]
            assert (other.model, other.width, other.height) == (camera.model, camera.width, camera.height)
            np.testing.assert_array_equal(other.params, camera.params)
        assert actual.image_names == expected.image_names
        np.testing.assert_array_equal(actual.cams_from_world.rotation.wxyz, expected.cams_from_world.rotation.wxyz)
        np.testing.assert_array_equal(actual.cams_from_world.translation, expected.cams_from_world.translation)
        for field in dataclasses.fields(Reconstruction):
            column = getattr(expected, field.name)
            if isinstance(column, np.ndarray):
                np.testing.assert_array_equal(getattr(actual, field.name), column, err_msg=field.name)
        for field in dataclasses.fields(Tracks):
            np.testing.assert_array_equal(getattr(actual.tracks, field.name), getattr(expected.tracks, field.name))

    return check


@pytest.fixture(scope="session")
def rig_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `bin/` and `txt/` of one model that pycolmap made: two rigs of two cameras, three frames each."""
    import pycolmap

    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 2, 3, 30
    model = pycolmap.synthesize_dataset(options)
    folder = tmp_path_factory.mktemp("rigs")
    for name in ("bin", "txt"):
        (folder / name).mkdir()
    model.write_binary(folder / "bin")
    model.write_text(folder / "txt")
    return folder
