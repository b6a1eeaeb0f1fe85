"""Rigs beside COLMAP's cameras: what is written is read again, by us and by pycolmap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import Rig
from sfm.io import colmap_text
from sfm.io.atomic import write_chunks
from sfm.io.camera_exchange import read_camera_set, write_camera_set, write_poses_beside
from sfm.io.camera_set import CameraSet

LEFT = Camera("OPENCV", 640, 480, np.array([534.1, 533.9, 342.2, 235.7, -0.27, -0.04, 0.001, -0.0003]))
RIGHT = Camera("OPENCV_FISHEYE", 800, 600, np.array([301.0, 300.0, 401.0, 299.0, 0.03, -0.01, 0.002, 1e-5]))
FIRST = Rigid3.exp(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]))
BESIDE = Rigid3.exp(np.array([0.01, -0.3, 0.02, -0.12, 0.001, 1 / 3]))
ABOVE = Rigid3.exp(np.array([2.0, -1.3, 0.5, -0.02, 0.4, 0.1]))
SET = CameraSet(("left", "right eye", "top"), (LEFT, RIGHT, LEFT), Rigid3.stack([FIRST, BESIDE @ FIRST, ABOVE @ FIRST]))


@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_poses_read_again_relative_to_the_first_camera(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cameras.{suffix}"
    write_camera_set(path, SET, "colmap")
    rigs, config = write_poses_beside(path, SET, "colmap")
    assert (rigs.name, config.name) == (f"rigs.{suffix}", "rig_config.json")
    _, again = read_camera_set(path)
    assert again.cams_from_rig is not None
    for k, pose in enumerate((Rigid3.identity(), BESIDE, ABOVE)):
        np.testing.assert_allclose(again.cams_from_rig[k].matrix, pose.matrix, atol=1e-14)


def test_pycolmap_reads_the_same_rig_and_configuration(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    path = tmp_path / "cameras.txt"
    write_camera_set(path, SET, "colmap")
    write_poses_beside(path, SET, "colmap")
    for name in ("frames", "images", "points3D"):
        (tmp_path / f"{name}.txt").write_text("")
    rig = pycolmap.Reconstruction(tmp_path).rigs[1]
    assert rig.ref_sensor_id.id == 1
    (config,) = pycolmap.read_rig_config(tmp_path / "rig_config.json")
    assert [one.image_prefix for one in config.cameras] == ["left/", "right eye/", "top/"]
    assert [one.ref_sensor for one in config.cameras] == [True, False, False]
    sensors = {sensor.id: pose for sensor, pose in rig.non_ref_sensors.items()}
    for k, pose in ((2, BESIDE), (3, ABOVE)):
        np.testing.assert_allclose(sensors[k].matrix(), pose.matrix, atol=1e-12)
        np.testing.assert_allclose(config.cameras[k - 1].cam_from_rig.matrix(), pose.matrix, atol=1e-12)
        np.testing.assert_array_equal(config.cameras[k - 1].camera.params, SET.cameras[k - 1].params)


def test_poses_have_a_place_only_beside_a_file_called_cameras(tmp_path: Path) -> None:
    assert write_poses_beside(tmp_path / "rig.txt", SET, "colmap") == ()
    assert write_poses_beside(tmp_path / "cameras.txt", CameraSet(("a", "b"), (LEFT, RIGHT)), "colmap") == ()
    assert write_poses_beside(tmp_path / "cameras.yaml", SET, "kalibr") == ()
    assert not list(tmp_path.iterdir())


def test_rigs_of_other_cameras_are_no_poses_of_these_and_broken_ones_are_told(tmp_path: Path) -> None:
    path = tmp_path / "cameras.txt"
    write_camera_set(path, SET, "colmap")
    for rigs in ([Rig(k, k) for k in (1, 2, 3)], [Rig(1, 1, {2: BESIDE})], [Rig(1, 1, {2: BESIDE, 3: None})]):
        write_chunks(tmp_path / "rigs.txt", colmap_text.rigs_chunks(rigs))
        assert read_camera_set(path)[1].cams_from_rig is None
    (tmp_path / "rigs.txt").write_text("1 2 CAMERA 1 CAMERA\n")
    with pytest.raises(FormatError):
        read_camera_set(path)
