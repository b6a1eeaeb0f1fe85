from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sfm.core.cameras import MODELS, Camera
from sfm.core.errors import FormatError, InputError, SfmError
from sfm.io.camera_files import read_intrinsics, write_camera_toml

GOOD = {
    "model": '"OPENCV"',
    "width": "4000",
    "height": "3000",
    "params": "[3200.0, 3201, 2000.0, 1500.0, 0.01, 0.0, 0.0, 1e-4]",
}


def toml(**changes: str | None) -> str:
    lines = {**GOOD, **changes}
    return "[camera]\n" + "".join(f"{key} = {value}\n" for key, value in lines.items() if value is not None)


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_a_camera_reads_back_to_the_last_bit(tmp_path: Path, rng: np.random.Generator, model) -> None:
    params = rng.normal(size=len(model.param_names)) * 10.0 ** rng.integers(-9, 7)
    params[list(model.focal_indices)] = np.abs(params[list(model.focal_indices)])
    camera = Camera(model.name, 4000, 3000, params)
    write_camera_toml(tmp_path / "c.toml", camera, name='left "ö" \\')
    (again,) = read_intrinsics(tmp_path / "c.toml").values()
    assert (again.model, again.width, again.height, again.has_prior_focal_length) == (model.name, 4000, 3000, True)
    np.testing.assert_array_equal(again.params, camera.params)


def test_the_pixel_centre_of_opencv_is_moved_by_half_a_pixel(tmp_path: Path) -> None:
    for center, cx in (("0.0", 2000.5), ("0", 2000.5), ("0.5", 2000.0), (None, 2000.0)):
        (tmp_path / "c.toml").write_text(toml(pixel_center=center))
        camera = read_intrinsics(tmp_path / "c.toml")[1]
        assert camera.principal_point == (cx, cx - 500)
        assert camera.focal_lengths == (3200, 3201)


@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_colmaps_cameras_are_read(tmp_path: Path, suffix: str) -> None:
    model = pycolmap.Reconstruction()
    for camera_id, params in ((3, [500.0, 320, 240]), (9, [600.0, 320, 240])):
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=camera_id, model="SIMPLE_PINHOLE", width=640, height=480, params=params)
        )
    (model.write_text if suffix == "txt" else model.write_binary)(tmp_path)
    cameras = read_intrinsics(tmp_path / f"cameras.{suffix}")
    assert list(cameras) == [3, 9]
    assert cameras[9].params.tolist() == [600, 320, 240]
    assert cameras[9].has_prior_focal_length


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        (toml(widht="3"), "unknown key 'widht'; did you mean 'width'?"),
        (toml(distortion="3"), "unknown key 'distortion'"),
        ("[kamera]\n", "unknown key 'kamera'; did you mean 'camera'?"),
        ("camera = 3\n", "has no table"),
        ("", "has no table"),
        (toml(model=None, width=None), "lacks model, width"),
        (toml(model='"OPEN_CV"'), "unknown model 'OPEN_CV'; did you mean 'OPENCV'?"),
        (toml(model="[1]"), "unknown model"),
        (toml(width="0"), "width must be a positive integer, got 0"),
        (toml(height="3000.0"), "height must be a positive integer"),
        (toml(height="true"), "height must be a positive integer"),
        (toml(params="[1.0, 2.0]"), "params must be 8 finite numbers: fx, fy, cx, cy, k1, k2, p1, p2"),
        (toml(params="[nan, 1, 1, 1, 1, 1, 1, 1]"), "params must be 8 finite"),
        (toml(params='["1", 1, 1, 1, 1, 1, 1, 1]'), "params must be 8 finite"),
        (toml(params="3200.0"), "params must be 8 finite"),
        (toml(pixel_center="0.25"), "pixel_center must be 0.5 or 0.0"),
        (toml(pixel_center='"half"'), "pixel_center must be 0.5 or 0.0"),
        (toml(name="3"), "name must be text"),
        (toml(params="[-3200, 3200, 2000, 1500, 0, 0, 0, 0]"), "focal lengths are [-3200.0, 3200.0], which must be"),
        (toml(params="[0, 0, 2000, 1500, 0, 0, 0, 0]"), "the focal lengths are [0.0, 0.0]"),
        (toml(params="[1e299, 3200, 2000, 1500, 0, 0, 0, 0]"), "must be between 0 and 4e+07 px"),
        (toml(params=f"[1{'0' * 400}, 3200, 2000, 1500, 0, 0, 0, 0]"), "params must be 8 finite"),
        (toml(params="[3200, 3200, -1e9, 1500, 0, 0, 0, 0]"), "the principal point is [-1000000000.0, 1500.0]"),
        (toml(width="4000000"), "the image size is 4000000 x 3000, more than 1000000 px"),
    ],
)
def test_a_mistake_in_a_camera_file_is_bad_input_that_says_what(tmp_path: Path, text: str, cause: str) -> None:
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(FormatError) as error:
        read_intrinsics(tmp_path / "c.toml")
    assert cause in str(error.value)
    assert "c.toml" in str(error.value)


@pytest.mark.parametrize(
    ("name", "data", "kind"),
    [
        ("c.toml", b"[camera\n", FormatError),
        ("c.toml", b"\xff\xfe\x00", FormatError),
        ("cameras.txt", b"# only a comment\n", FormatError),
        ("cameras.txt", b"1 PINHOLE 640 480 1\n", FormatError),
        ("cameras.txt", b"1 SIMPLE_PINHOLE 640 480 nan 1 1\n", FormatError),
        ("cameras.txt", b"1 SIMPLE_PINHOLE 640 0 500 1 1\n", FormatError),
        ("cameras.txt", b"1 SIMPLE_PINHOLE 640 480 -500 1 1\n", FormatError),
        ("cameras.txt", b"1 SIMPLE_PINHOLE 640 480 1e300 1 1\n", FormatError),
        ("c.json", b'{"camera_angle_x": 0, "w": 640, "h": 480}', FormatError),
        ("c.json", b'{"camera_angle_x": 1.0, "camera_angle_y": 7, "w": 640, "h": 480}', FormatError),
        ("c.json", b'{"fl_x": 500, "w": 1e30, "h": 480}', FormatError),
        ("cameras.bin", b"\1", FormatError),
        ("cameras.bin", bytes(8), FormatError),
        ("calibration.yaml", b"", FormatError),
        (None, b"", InputError),
    ],
)
def test_a_file_that_is_no_calibration_is_named(tmp_path: Path, name: str | None, data: bytes, kind: type[SfmError]):
    if name:
        (tmp_path / name).write_bytes(data)
    with pytest.raises(kind, match=name or "missing.toml"):
        read_intrinsics(tmp_path / (name or "missing.toml"))
