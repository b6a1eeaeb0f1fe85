"""`calib undistort`: the pixels are OpenCV's, the photos stay, and the camera beside them is that of the result."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.cli import main
from sfm.core.cameras import Camera
from sfm.core.errors import ExitCode
from sfm.io.camera_files import read_intrinsics, write_camera_toml

BENT = Camera("OPENCV", 320, 240, np.array([260.0, 262, 165, 118, -0.25, 0.05, 1e-3, -1e-3]))


@pytest.fixture
def scene(tmp_path: Path, rng) -> Path:
    (tmp_path / "photos").mkdir()
    noise = rng.integers(0, 256, (240, 320)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "photos" / "a.png"), cv2.GaussianBlur(noise, (0, 0), 4))
    write_camera_toml(tmp_path / "camera.toml", BENT)
    return tmp_path


def run(scene: Path, *words: str) -> int:
    return main(["undistort", str(scene / "camera.toml"), str(scene / "photos"), "-o", str(scene / "out"), *words])


def test_pixels_are_those_of_opencv_but_for_rounding(scene: Path) -> None:
    before = (scene / "photos" / "a.png").read_bytes()
    assert run(scene) == ExitCode.OK
    (camera,) = read_intrinsics(scene / "out" / "camera.toml").values()
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    image = cv2.imread(str(scene / "photos" / "a.png"), 0)
    new = camera.calibration_matrix - half
    theirs = cv2.undistort(image, BENT.calibration_matrix - half, BENT.params[4:], newCameraMatrix=new)
    ours = cv2.imread(str(scene / "out" / "a.png"), 0)
    inside = np.s_[2:-2, 2:-2]
    assert np.abs(ours[inside].astype(int) - theirs[inside]).max() <= 2
    assert (scene / "photos" / "a.png").read_bytes() == before


def test_masks_and_crops_agree_on_what_is_blank(scene: Path) -> None:
    assert run(scene, "--crop", "full", "--masks") == ExitCode.OK
    mask = cv2.imread(str(scene / "out" / "masks" / "a.png.png"), 0)
    assert set(np.unique(mask)) == {0, 255}
    for crop in ("inside", "valid"):
        assert run(scene, "--crop", crop, "--masks") == ExitCode.OK
        mask = cv2.imread(str(scene / "out" / "masks" / "a.png.png"), 0)
        (camera,) = read_intrinsics(scene / "out" / "camera.toml").values()
        assert (mask == 255).all()
        assert mask.shape == (camera.height, camera.width)


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["--max-fov", "190"], ExitCode.USAGE, "less than 180"),
        (["--scale", "0"], ExitCode.USAGE, "--scale must be positive"),
    ],
)
def test_what_cannot_be_is_refused(scene: Path, capsys, words, code, told) -> None:
    assert run(scene, *words) == code
    assert told in capsys.readouterr().err


def test_photos_are_not_written_over(scene: Path, capsys) -> None:
    words = ["undistort", str(scene / "camera.toml"), str(scene / "photos"), "-o", str(scene / "photos")]
    assert main(words) == ExitCode.USAGE
    assert "write over the photos" in capsys.readouterr().err


def test_a_lens_of_more_than_180_degrees_tells_its_limit(scene: Path, capsys) -> None:
    write_camera_toml(
        scene / "camera.toml", Camera("OPENCV_FISHEYE", 320, 240, np.array([90.0, 90, 160, 120, *[0] * 4]))
    )
    assert run(scene, "--crop", "full") == ExitCode.OK
    assert "the lens sees up to" in capsys.readouterr().out
