from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import CameraRig
from sfm.io.camera_files import camera_names, read_camera_file, read_intrinsics, write_camera_toml
from sfm.io.rig_files import MountedSigmas, RigFile, read_rig_file, write_rig_file

LEFT = Camera("OPENCV", 640, 480, np.array([534.1, 533.9, 342.2, 235.7, -0.27, -0.04, 0.001, -0.0003]))
RIGHT = Camera("OPENCV_FISHEYE", 800, 600, np.array([301.0, 300.0, 401.0, 299.0, 0.03, -0.01, 0.002, 1e-5]))
POSES = Rigid3.stack([Rigid3.identity(), Rigid3.exp(np.array([0.01, -0.3, 0.02, -0.12, 0.001, 1 / 3]))])
RIG = CameraRig(("left", 'right "ö"'), (LEFT, RIGHT), POSES, "left")


def written(tmp_path: Path, file: RigFile) -> Path:
    write_rig_file(tmp_path / "rig.toml", file)
    return tmp_path / "rig.toml"


def test_a_rig_reads_back_to_the_last_bit(tmp_path: Path, rng: np.random.Generator) -> None:
    sigmas = tuple(MountedSigmas(rng.random(8), rng.random(3), rng.random(3)) for _ in RIG.names)
    facts = {"command": "calib stereo", "frames": 13, "spread": 0.1, "free": True, "a key": "ü"}
    again = read_rig_file(written(tmp_path, RigFile(RIG, 1 / 3, sigmas, facts)))
    assert (again.rig.names, again.rig.reference, again.rig.unit) == (RIG.names, "left", "m")
    assert again.rms_px == 1 / 3
    assert dict(again.provenance) == facts
    for k, camera in enumerate(again.rig.cameras):
        assert (camera.model, camera.width, camera.has_prior_focal_length) == (
            RIG.cameras[k].model, RIG.cameras[k].width, True,
        )  # fmt: skip
        np.testing.assert_array_equal(camera.params, RIG.cameras[k].params)
        np.testing.assert_array_equal(again.sigmas[k].translation, sigmas[k].translation)
    np.testing.assert_array_equal(again.rig.cams_from_rig.matrix, POSES.matrix)


def test_what_is_not_known_need_not_be_there(tmp_path: Path) -> None:
    again = read_rig_file(written(tmp_path, RigFile(RIG)))
    assert math.isnan(again.rms_px)
    assert (again.sigmas, dict(again.provenance)) == ((), {})


def test_the_motion_between_two_cameras_composes() -> None:
    there, back = RIG.cam2_from_cam1('right "ö"', "left"), RIG.cam2_from_cam1("left", 'right "ö"')
    np.testing.assert_allclose((there @ back).matrix, np.eye(3, 4), atol=1e-15)
    with pytest.raises(ValueError, match="no camera 'middle'"):
        RIG.cam2_from_cam1("middle", "left")


@pytest.mark.parametrize(
    ("old", "new", "cause"),
    [
        ('reference = "left"', 'reference = "middle"', "none of left"),
        ('reference = "left"', 'referrence = "left"', "unknown key 'referrence'"),
        ('unit = "m"', "unit = 3", "needs unit"),
        ("rotation = [1.0, 0.0, 0.0, 0.0]", "rotation = [2.0, 0.0, 0.0, 0.0]", "unit quaternion"),
        ("rotation = [1.0, 0.0, 0.0, 0.0]", "rotation = [0.0, 1.0, 0.0, 0.0]", "must have the identity"),
        ("translation = [0.0, 0.0, 0.0]", "translation = [0.0, 0.0]", "3 finite numbers"),
        ('name = "left"', "", "lacks a name"),
        ('name = "left"', 'name = "right \\"ö\\""', "one name"),
        ("width = 640", "width = 640.0", "positive integer"),
        ("width = 640", "width = 640\nsigma_params = [1.0]", "8 finite numbers"),
        ("width = 640", "width = 640\ncolour = 1", "unknown key 'colour'"),
    ],
)
def test_a_mistake_in_a_rig_file_is_told(tmp_path: Path, old: str, new: str, cause: str) -> None:
    path = written(tmp_path, RigFile(RIG))
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(FormatError, match=cause):
        read_rig_file(path)


def test_what_is_no_rig_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text("[rig")
    with pytest.raises(FormatError, match="no TOML"):
        read_rig_file(tmp_path / "rig.toml")
    (tmp_path / "rig.toml").write_text("[rig]\nreference = 'a'\n")
    with pytest.raises(FormatError, match=r"no \[\[camera\]\]"):
        read_rig_file(tmp_path / "rig.toml")


def test_a_rig_of_nobody_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="identity"):
        CameraRig(("a", "b"), (LEFT, RIGHT), POSES, "b")
    with pytest.raises(ValueError, match="poses are"):
        CameraRig(("a",), (LEFT, RIGHT), POSES, "a")


def test_a_rig_serves_as_intrinsics_with_the_names_of_its_cameras(tmp_path: Path) -> None:
    path = written(tmp_path, RigFile(RIG))
    cameras = read_intrinsics(path)
    assert camera_names(path) == dict(enumerate(RIG.names, 1))
    for k, camera in enumerate(RIG.cameras, 1):
        np.testing.assert_array_equal(cameras[k].params, camera.params)
        assert cameras[k].has_prior_focal_length
    write_camera_toml(tmp_path / "one.toml", LEFT, name="left")
    assert camera_names(tmp_path / "one.toml") == {}


def test_where_one_camera_is_needed_a_rig_says_how_to_take_one_out(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="is the file of a rig") as caught:
        read_camera_file(written(tmp_path, RigFile(RIG)))
    assert "--camera NAME" in str(caught.value)
