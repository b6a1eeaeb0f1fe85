"""From corners of a board by `calib camera` to a reconstruction by `sfm run`."""

from __future__ import annotations

import json

import numpy as np
import pytest

from calib.boards import chessboard
from calib.cli.photos import detection_json
from calib.detect import Detection
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.io.camera_files import read_camera_file
from sfm.io.colmap_model import read_model
from tests.end_to_end.conftest import true_model
from tests.end_to_end.poses import pose_errors

pytestmark = pytest.mark.slow
BOARD = chessboard(9, 6, 0.03)


def corners_json(camera, path) -> None:
    """What `calib detect -o` writes of ten photos of a board before `camera`, with noise of 0.1 px."""
    rng, images = np.random.default_rng(4), {}
    while len(images) < 10:
        turn = Rotation3.exp(np.append(rng.uniform(-0.6, 0.6, 2), rng.uniform(-1, 1)))
        middle = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.3, 0.45)])
        pose = Rigid3(turn, middle - turn @ BOARD.points3D.mean(axis=0))
        pixels, valid = camera.project(pose @ BOARD.points3D)
        seen = np.flatnonzero(valid & np.all((pixels > 0) & (pixels < [camera.width, camera.height]), axis=1))
        name = f"{len(images)}.jpg"
        noisy = pixels[seen] + rng.normal(0, 0.1, (len(seen), 2))
        covariances = np.tile(0.01 * np.eye(2), (len(seen), 1, 1))
        images[name] = detection_json(Detection(name, camera.width, camera.height, seen, noisy, covariances))
    document = {"board": BOARD.spec, "points3D": BOARD.points3D.tolist(), "pixel_center": 0.5, "images": images}
    path.write_text(json.dumps(document))


def test_a_reconstruction_takes_the_calibrated_camera_as_it_is(sfm, rendered, tmp_path):
    scene = rendered("orbit")
    truth = true_model(scene)
    corners_json(truth.cameras[1], tmp_path / "corners.json")
    made = sfm("camera", "corners.json", "--model", "simple_radial", "-o", "camera.toml", "--json", module="calib")
    assert made.returncode == 0, made.stderr
    ran = sfm("run", scene / "images", "-o", "scene", "--intrinsics", "camera.toml", "--threads", 2)
    assert ran.returncode == 0, ran.stderr
    camera, record = read_camera_file(tmp_path / "camera.toml")
    model = read_model(tmp_path / "scene" / "sparse" / "0")
    (used,) = model.cameras.values()
    assert (used.model, record.facts["views"]) == ("SIMPLE_RADIAL", 10)
    assert used.params.tolist() == camera.params.tolist() == json.loads(made.stdout)["params"]
    assert used.params.tolist() != truth.cameras[1].params.tolist()
    assert sorted(model.image_names) == sorted(truth.image_names)
    assert pose_errors(model, truth).rotation_deg < 0.1
