"""`calib undistort`: the pixels are OpenCV's, the photos stay, and the camera beside them is that of the result."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from calib.cli import main
from sfm.core.cameras import Camera
from sfm.core.errors import ExitCode
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import CameraRig
from sfm.io.camera_files import read_intrinsics, write_camera_toml
from sfm.io.rig_files import RigFile, write_rig_file

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


def test_a_focal_length_that_is_asked_for_is_that_of_the_result(scene: Path) -> None:
    assert run(scene, "--focal", "390") == ExitCode.OK
    (camera,) = read_intrinsics(scene / "out" / "camera.toml").values()
    fx, fy = camera.focal_lengths
    assert fx == pytest.approx(390)
    assert fy / fx == pytest.approx(262 / 260)
    # A longer lens shows less, larger: the middle of the photo at one and a half times its size.
    ours = cv2.imread(str(scene / "out" / "a.png"), 0)
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    image = cv2.imread(str(scene / "photos" / "a.png"), 0)
    theirs = cv2.undistort(
        image, BENT.calibration_matrix - half, BENT.params[4:], newCameraMatrix=camera.calibration_matrix - half
    )
    assert np.abs(ours[2:-2, 2:-2].astype(int) - theirs[2:-2, 2:-2]).max() <= 2


def test_a_focal_length_so_short_that_borders_are_blank_is_masked(scene: Path, capsys) -> None:
    assert run(scene, "--focal", "120", "--masks") == ExitCode.OK
    mask = cv2.imread(str(scene / "out" / "masks" / "a.png.png"), 0)
    assert "% of the pixels are blank" in capsys.readouterr().out
    assert mask[0, 0] == 0
    assert mask[120, 160] == 255


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_a_scale_changes_size_and_focal_length_alike(scene: Path, scale: float) -> None:
    assert run(scene) == ExitCode.OK
    (plain,) = read_intrinsics(scene / "out" / "camera.toml").values()
    assert run(scene, "--scale", str(scale)) == ExitCode.OK
    (scaled,) = read_intrinsics(scene / "out" / "camera.toml").values()
    assert (scaled.width, scaled.height) == (round(scale * plain.width), round(scale * plain.height))
    np.testing.assert_allclose(scaled.params, scale * plain.params, rtol=1e-9)
    image = cv2.imread(str(scene / "out" / "a.png"), 0)
    assert image.shape == (scaled.height, scaled.width)


def test_photos_keep_their_kind_depth_and_colours(scene: Path) -> None:
    grey = cv2.imread(str(scene / "photos" / "a.png"), 0)
    colour = np.dstack([grey, 255 - grey, grey // 2])
    for name in ("c.jpg", "c.tif", "c.webp", "c.bmp"):
        cv2.imwrite(str(scene / "photos" / name), colour)
    cv2.imwrite(str(scene / "photos" / "deep.png"), 257 * grey.astype(np.uint16))
    cv2.imwrite(str(scene / "photos" / "deep.tif"), 257 * colour.astype(np.uint16))
    assert run(scene) == ExitCode.OK
    ours = {path.name: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in (scene / "out").glob("*.*g")}
    ours |= {path.name: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in (scene / "out").glob("*.[tbw]*")}
    assert ours["a.png"].ndim == 2
    for name in ("c.tif", "c.bmp", "c.webp"):
        np.testing.assert_array_equal(ours[name][:, :, 0], ours["a.png"])
    assert np.abs(ours["c.jpg"][:, :, 0].astype(int) - ours["a.png"]).max() <= 12
    assert (ours["deep.png"].dtype, ours["deep.tif"].dtype) == (np.uint16, np.uint16)
    np.testing.assert_allclose(ours["deep.png"] / 257, ours["a.png"], atol=0.51)
    np.testing.assert_array_equal(ours["deep.tif"][:, :, 0], ours["deep.png"])


def test_exif_is_copied_only_if_asked_for(scene: Path) -> None:
    exif = Image.Exif()
    exif[271], exif[274] = "Maker", 6
    with Image.open(scene / "photos" / "a.png") as photo:
        for name in ("b.jpg", "b.tif"):
            photo.save(scene / "photos" / name, exif=exif)
    for words, told in (((), None), (("--keep-exif",), "Maker")):
        assert run(scene, "--crop", "valid", *words) == ExitCode.OK
        (camera,) = read_intrinsics(scene / "out" / "camera.toml").values()
        with Image.open(scene / "out" / "b.jpg") as jpeg:
            assert jpeg.getexif().get(271) == told
            assert jpeg.size == (camera.width, camera.height)
    # A decoder turns a TIFF, and then it is no photo of this camera any more.
    assert not (scene / "out" / "b.tif").exists()


def test_photos_that_cannot_be_used_are_named_with_the_reason(scene: Path, capsys) -> None:
    (scene / "photos" / "torn.png").write_bytes((scene / "photos" / "a.png").read_bytes()[:-60])
    cv2.imwrite(str(scene / "photos" / "small.png"), np.zeros((100, 100), np.uint8))
    (scene / "photos" / "text.jpg").write_text("no photo")
    assert run(scene) == ExitCode.OK
    told = capsys.readouterr().out
    assert "torn.png: is truncated" in told
    assert "small.png: has 100 × 100 px, the camera 320 × 240" in told
    assert "1 of 3 photos in" in told
    assert sorted(path.name for path in (scene / "out").iterdir()) == ["a.png", "camera.toml"]


def test_no_photo_that_can_be_used_is_an_error(scene: Path) -> None:
    cv2.imwrite(str(scene / "photos" / "a.png"), np.zeros((100, 100), np.uint8))
    assert run(scene) == ExitCode.BAD_INPUT


def test_one_camera_of_a_rig_has_to_be_taken_out(scene: Path, capsys) -> None:
    poses = Rigid3.stack([Rigid3.identity(), Rigid3.exp(np.array([0, 0, 0, 0.1, 0, 0]))])
    write_rig_file(scene / "camera.toml", RigFile(CameraRig(("left", "right"), (BENT, BENT), poses, "left")))
    assert run(scene) == ExitCode.BAD_INPUT
    assert "--camera left" in capsys.readouterr().err


@pytest.mark.parametrize("scale", ["100", "inf"])
def test_a_result_beyond_all_memory_is_refused_before_it_is_made(scene: Path, scale: str, capsys) -> None:
    assert run(scene, "--scale", scale) == ExitCode.USAGE
    assert "choose a smaller --scale" in capsys.readouterr().err
    assert not (scene / "out" / "camera.toml").exists()
