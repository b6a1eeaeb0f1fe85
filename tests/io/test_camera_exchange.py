"""Calibrations in the files of other programs: theirs are read, ours are theirs, half a pixel and all."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from sfm.core.cameras import MODELS, Camera
from sfm.core.cameras.conversion import difference
from sfm.core.errors import ConfigError, FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.io.camera_exchange import format_of, read_camera_set, write_camera_set
from sfm.io.camera_files import read_intrinsics
from sfm.io.camera_set import CameraSet

K = [458.654, 457.296, 367.715, 248.875]
BENT = [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
CAMERAS = {
    "PINHOLE": Camera("PINHOLE", 752, 480, np.array(K)),
    "RADIAL": Camera("RADIAL", 752, 480, np.array([458.0, 367, 248, -0.2, 0.03])),
    "OPENCV": Camera("OPENCV", 752, 480, np.array([*K, *BENT])),
    "opencv5": Camera("FULL_OPENCV", 752, 480, np.array([*K, *BENT, 0.01, 0, 0, 0])),
    "FULL_OPENCV": Camera("FULL_OPENCV", 752, 480, np.array([*K, *BENT, 0.01, 0.02, 0.003, 0.001])),
    "THIN": Camera("FULL_OPENCV_THIN_PRISM", 752, 480, np.array([*K, *BENT, 0, 0, 0, 0, 1e-3, 2e-4, -3e-3, 1e-4])),
    "OPENCV_FISHEYE": Camera("OPENCV_FISHEYE", 752, 480, np.array([*K, -0.01, 0.05, -0.045, 0.012])),
    "RADIAL_FISHEYE": Camera("RADIAL_FISHEYE", 752, 480, np.array([300.0, 367, 248, -0.01, 0.005])),
    "EUCM": Camera("EUCM", 752, 480, np.array([*K, 0.6, 1.1])),
    "DOUBLE_SPHERE": Camera("DOUBLE_SPHERE", 752, 480, np.array([*K, -0.2, 0.58])),
}
BROWN, FISHEYE = ("PINHOLE", "RADIAL", "OPENCV", "opencv5", "FULL_OPENCV"), ("OPENCV_FISHEYE", "RADIAL_FISHEYE")
SAID = {
    "opencv": ("c.yml", (*BROWN, "THIN", *FISHEYE)),
    "ros": ("c.yaml", (*BROWN, *FISHEYE)),
    "kalibr": ("c.yaml", ("PINHOLE", "RADIAL", "OPENCV", *FISHEYE, "EUCM", "DOUBLE_SPHERE")),
    "nerfstudio": ("c.json", ("PINHOLE", "RADIAL", "OPENCV", "opencv5", *FISHEYE)),
    "colmap": ("c.txt", (*BROWN, *FISHEYE, "EUCM")),
    "parallax": ("c.toml", tuple(CAMERAS)),
}
POSE = Rigid3.exp(np.array([0.02, -0.3, 0.1, -0.11, 0.004, 0.02]))


def only(camera: Camera) -> CameraSet:
    return CameraSet(("left cam",), (camera,))


@pytest.mark.parametrize(("name", "key"), [(name, key) for name, (_, keys) in SAID.items() for key in keys])
def test_what_a_format_can_say_comes_back(tmp_path: Path, name: str, key: str) -> None:
    path = tmp_path / SAID[name][0]
    (told,) = write_camera_set(path, only(CAMERAS[key]), name)
    assert told.apart.largest_px < 1e-9
    found, again = read_camera_set(path)
    assert found == name
    assert difference(CAMERAS[key], again.cameras[0]).largest_px < 1e-9
    assert again.cameras[0].has_prior_focal_length
    (also,) = read_intrinsics(path).values()
    np.testing.assert_array_equal(also.params, again.cameras[0].params)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(("name", "key"), [(n, k) for n, (_, keys) in SAID.items() for k in CAMERAS if k not in keys])
def test_what_a_format_cannot_say_is_refused_with_the_way_out(tmp_path: Path, name: str, key: str) -> None:
    with pytest.raises(FormatError, match=r"--fit [A-Z_]+"):
        write_camera_set(tmp_path / SAID[name][0], only(CAMERAS[key]), name)
    assert not list(tmp_path.iterdir())


# Each program's own reading


@pytest.mark.parametrize("key", SAID["opencv"][1])
def test_opencv_projects_to_the_same_place_but_for_half_a_pixel(tmp_path: Path, key: str, rng) -> None:
    path, camera = tmp_path / "c.yml", CAMERAS[key]
    write_camera_set(path, only(camera), "opencv")
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix, coefficients = file.getNode("camera_matrix").mat(), file.getNode("distortion_coefficients").mat()
    points = rng.uniform([-0.5, -0.3, 1], [0.5, 0.3, 1.5], (50, 3))
    if camera.model_info.is_fisheye:
        assert file.getNode("fisheye_model").real() == 1
        theirs, _ = cv2.fisheye.projectPoints(points.reshape(1, -1, 3), np.zeros(3), np.zeros(3), matrix, coefficients)
    else:
        theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    np.testing.assert_allclose(theirs.reshape(-1, 2) + 0.5, camera.project(points)[0], atol=1e-9)


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_what_opencv_wrote_is_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"c.{suffix}"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("calibration_time", "Mon 23 Nov: 10 #1 <now>")
    file.write("image_width", 752)
    file.write("image_height", 480)
    file.write("camera_matrix", np.array([[K[0], 0, K[2] - 0.5], [0, K[1], K[3] - 0.5], [0, 0, 1]]))
    file.write("distortion_coefficients", np.array([[*BENT, 0.01]]))
    file.write("grid_points", np.arange(60.0).reshape(20, 3))
    file.release()
    name, found = read_camera_set(path)
    assert name == "opencv"
    assert found.cameras[0].model == "FULL_OPENCV"
    np.testing.assert_allclose(found.cameras[0].params, CAMERAS["opencv5"].params, rtol=1e-14)


def test_a_stereo_pair_of_opencv_s_sample_is_read(tmp_path: Path) -> None:
    path = tmp_path / "intrinsics.yml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for k in (1, 2):
        file.write(f"M{k}", np.array([[500.0 + k, 0, 320], [0, 500, 240], [0, 0, 1]]))
        file.write(f"D{k}", np.array([[-0.2, 0.03, 1e-3, 0, 0, 0, 0, 0.1]]))
    file.write("R", POSE.rotation.matrix)
    file.write("T", POSE.translation.reshape(3, 1))
    file.release()
    with pytest.raises(FormatError, match="--size WIDTHxHEIGHT"):
        read_camera_set(path)
    _, found = read_camera_set(path, (640, 480))
    assert found.names == ("left", "right")
    assert [camera.focal_lengths[0] for camera in found.cameras] == [501, 502]
    assert found.cameras[0].principal_point == (320.5, 240.5)
    assert found.cams_from_rig is not None
    np.testing.assert_allclose(found.cams_from_rig[1].matrix, POSE.matrix, atol=1e-14)


def test_pycolmap_reads_the_cameras_and_its_principal_point_is_ours(tmp_path: Path) -> None:
    write_camera_set(tmp_path / "cameras.txt", CameraSet(("a", "b"), (CAMERAS["OPENCV"], CAMERAS["EUCM"])), "colmap")
    for file in ("images.txt", "points3D.txt"):
        (tmp_path / file).write_text("")
    theirs = pycolmap.Reconstruction()
    theirs.read_text(tmp_path)
    np.testing.assert_array_equal(theirs.cameras[1].params, CAMERAS["OPENCV"].params)
    assert theirs.cameras[2].model_name == "EUCM"


ROS = """image_width: 752
image_height: 480
camera_name: narrow_stereo/left
camera_matrix:
  rows: 3
  cols: 3
  data: [458.654, 0, 367.215, 0, 457.296, 248.375, 0, 0, 1]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: {count}
  data: [{values}]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
MESSAGE = """header:
  seq: 1
  stamp: {secs: 1, nsecs: 2}
height: 480
width: 752
distortion_model: "plumb_bob"
D: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0]
K: [458.654, 0.0, 367.215, 0.0, 457.296, 248.375, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
roi: {x_offset: 0}
---
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - - 0.0
    - -1.0
    - 0.0
    - -0.11
  - [1.0, 0.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.02]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0, 2]
  camera_model: omni
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [0.8, 833.0, 830.0, 373.0, 253.0]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
cam2:
  T_cn_cnm1:
  - [1, 0, 0, 0.5]
  - [0, 1, 0, 0]
  - [0, 0, 1, 0]
  - [0, 0, 0, 1]
  camera_model: ds
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [-0.2, 0.58, 458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
"""
EUROC = """%YAML:1.0
# General sensor definitions.
camera_id: left_cam
T_BS:
  cols: 4
  rows: 4
  data: [0.0, -1.0, 0.0, -0.02,
         1.0, 0.0, 0.0, -0.06,
         0.0, 0.0, 1.0, 0.01,
         0.0, 0.0, 0.0, 1.0]
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
BOOFCV = """# Pinhole camera model with radial and tangential distortion
pinhole:
  fx: 458.654
  fy: 457.296
  cx: 367.215
  cy: 248.375
  width: 752
  height: 480
  skew: 0.0
model: pinhole_radial_tangential
radial_tangential:
  radial:
  - -0.28340811
  - 0.07395907
  t1: 1.9359E-4
  t2: 1.76187114E-5
"""


@pytest.mark.parametrize(
    ("text", "name", "key"),
    [
        (ROS.format(model="plumb_bob", count=5, values="-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0"),
         "ros", "OPENCV"),
        (ROS.format(model="equidistant", count=4, values="-0.01, 0.05, -0.045, 0.012"), "ros", "OPENCV_FISHEYE"),
        (ROS.format(model="plumb_bob", count=5, values="0, 0, 0, 0, 0"), "ros", "PINHOLE"),
        (MESSAGE, "ros", "OPENCV"),
        (EUROC, "kalibr", "OPENCV"),
        (BOOFCV, "boofcv", "OPENCV"),
    ],
)  # fmt: skip
def test_files_of_other_programs_are_read(tmp_path: Path, text: str, name: str, key: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    found, cameras = read_camera_set(tmp_path / "c.yaml")
    assert found == name
    assert cameras.cameras[0].model == CAMERAS[key].model
    np.testing.assert_allclose(cameras.cameras[0].params, CAMERAS[key].params, rtol=1e-12)


def test_a_camchain_is_read_camera_by_camera_and_pose_upon_pose(tmp_path: Path, rng) -> None:
    (tmp_path / "chain.yaml").write_text(KALIBR)
    name, found = read_camera_set(tmp_path / "chain.yaml")
    assert (name, found.names, found.unit) == ("kalibr", ("cam0", "cam1", "cam2"), "m")
    np.testing.assert_allclose(found.cameras[0].params, CAMERAS["OPENCV"].params)
    np.testing.assert_allclose(found.cameras[2].params, CAMERAS["DOUBLE_SPHERE"].params)
    points = rng.uniform(-1, 1, (20, 3)) + [0, 0, 2]
    omni = points[:, :2] / (points[:, 2] + 0.8 * np.linalg.norm(points, axis=1))[:, None] * [833, 830] + [373.5, 253.5]
    np.testing.assert_allclose(found.cameras[1].project(points)[0], omni, atol=1e-9)
    assert found.cams_from_rig is not None
    np.testing.assert_allclose(found.cams_from_rig[1] @ np.array([[1.0, 2, 3]]), [[-2.11, 1, 3.02]])
    np.testing.assert_allclose(found.cams_from_rig[2] @ np.array([[1.0, 2, 3]]), [[-1.61, 1, 3.02]])


def test_the_pose_of_a_euroc_sensor_is_turned_round(tmp_path: Path) -> None:
    (tmp_path / "sensor.yaml").write_text(EUROC)
    _, found = read_camera_set(tmp_path / "sensor.yaml")
    assert found.cams_from_rig is not None
    np.testing.assert_allclose(found.cams_from_rig[0].center, [-0.02, -0.06, 0.01], atol=1e-15)


@pytest.mark.parametrize("name", ["opencv", "kalibr", "parallax"])
def test_rigs_come_back_with_their_poses(tmp_path: Path, name: str) -> None:
    poses = Rigid3.stack([POSE, POSE @ POSE])
    rig = CameraSet(("left", "right"), (CAMERAS["OPENCV"], CAMERAS["PINHOLE"]), poses, "m")
    path = tmp_path / f"rig{'.toml' if name == 'parallax' else '.yaml'}"
    told = write_camera_set(path, rig, name)
    assert max(one.motion for one in told) < 1e-12
    _, again = read_camera_set(path)
    assert again.cams_from_rig is not None
    np.testing.assert_allclose(again.cams_from_rig[1].matrix, POSE.matrix, atol=1e-12)
    assert again.names == ("left", "right")


def test_frames_of_transforms_json_may_have_cameras_of_their_own(tmp_path: Path) -> None:
    frames = [
        {"file_path": f"{k}.png", "fl_x": 500.0 + k % 2, "transform_matrix": np.eye(4).tolist()} for k in range(4)
    ]
    top = {"w": 640, "h": 480, "cx": 320.0, "cy": 240.0, "k1": -0.1}
    (tmp_path / "transforms.json").write_text(json.dumps({**top, "frames": frames}))
    _, found = read_camera_set(tmp_path / "transforms.json")
    assert [camera.focal_lengths for camera in found.cameras] == [(500, 500), (501, 501)]
    assert found.cameras[0].model == "OPENCV"
    assert found.cameras[0].principal_point == (320, 240)


# Refusals


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a: 1", "holds no calibration that is known"),
        ("- 1", "holds no calibration that is known"),
        ("", "holds no calibration that is known"),
        (ROS.format(model="fov", count=1, values="0.9"), "distortion model 'fov'"),
        (ROS.format(model="plumb_bob", count=5, values="1, 2"), "must be 5 numbers"),
        (ROS.format(model="plumb_bob", count=3, values="1, 2, 3"), "4, 5, 8, 12 or 14"),
        (ROS.replace("458.654, 0,", "458.654, 0.3,").format(model="plumb_bob", count=0, values=""), "skew, 0.3"),
        (ROS.replace("458.654", "-1").format(model="plumb_bob", count=0, values=""), "focal lengths are"),
        (ROS.replace("752", "0").format(model="plumb_bob", count=0, values=""), "image size is 0 x 480"),
        (KALIBR.replace("omni", "fancy"), "cam1: has the camera model 'fancy'"),
        (KALIBR.replace("radtan", "fov"), "cam0: pinhole with the distortion 'fov'"),
        (KALIBR.replace("[1.0, 0.0, 0.0, 0.0]", "[1.0, 0.5, 0.0, 0.0]"), "T_cn_cnm1 holds no rotation"),
        (BOOFCV.replace("skew: 0.0", "skew: 0.1"), "has skew"),
        (BOOFCV.replace("pinhole_radial_tangential", "omnidirectional_universal"), "which equals none here"),
        ("image_width: 1\nimage_height: 1\ncamera_matrix: [1, 2]", "camera_matrix must be 3 x 3"),
        ("<opencv_storage><a>1</a>", "is no XML"),
        ("{not json", "is no JSON"),
    ],
)
def test_damaged_files_are_refused_in_words(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(FormatError) as refused:
        read_intrinsics(tmp_path / "c.yaml")
    assert told in str(refused.value)
    assert str(refused.value).startswith(str(tmp_path / "c.yaml"))


def test_a_tilted_sensor_is_refused_and_one_that_is_not_tilted_is_read(tmp_path: Path) -> None:
    values = [*BENT, 0.01, 0.02, 0.003, 0.001, 1e-3, 2e-4, -3e-3, 1e-4, 0.0, 0.0]
    text = ROS.format(model="rational_polynomial", count=14, values=", ".join(map(str, values)))
    (tmp_path / "c.yaml").write_text(text)
    (camera,) = read_intrinsics(tmp_path / "c.yaml").values()
    assert camera.model == "FULL_OPENCV_THIN_PRISM"
    np.testing.assert_allclose(camera.params[4:], values[:12])
    (tmp_path / "c.yaml").write_text(text.replace("0.0, 0.0]", "0.0, 0.01]"))
    with pytest.raises(FormatError, match="tilted"):
        read_intrinsics(tmp_path / "c.yaml")


def test_several_cameras_do_not_fit_where_one_has_its_place(tmp_path: Path) -> None:
    pair = CameraSet(("a", "b"), (CAMERAS["OPENCV"], CAMERAS["OPENCV"]))
    for name, file in (("ros", "c.yaml"), ("nerfstudio", "c.json"), ("parallax", "c.toml")):
        with pytest.raises(FormatError, match="--camera NAME"):
            write_camera_set(tmp_path / file, pair, name)
    mixed = CameraSet(("a", "b"), (CAMERAS["OPENCV"], CAMERAS["OPENCV_FISHEYE"]))
    with pytest.raises(FormatError, match="one camera is a fisheye"):
        write_camera_set(tmp_path / "c.yml", mixed, "opencv")


@pytest.mark.parametrize(
    ("path", "named", "told"),
    [
        ("c.yaml", "", "--to parallax"), ("c.foo", "", "no calibration file"), ("c.txt", "ros", "ends in .yaml"),
        ("c.yaml", "xyz", "no format 'xyz'"),
    ],
)  # fmt: skip
def test_a_format_that_is_open_or_unknown_is_asked_for(path: str, named: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        format_of(path, named)
    assert format_of("c.toml") == "parallax"
    assert format_of("c.yml", "opencv") == "opencv"


def test_every_model_has_a_file_that_takes_it(tmp_path: Path, rng) -> None:
    for model in MODELS:
        params = rng.uniform(0.1, 0.2, len(model.param_names)) * 1e-2
        for k in (*model.focal_indices, *model.principal_point_indices):
            params[k] = 300.0 + k
        camera = Camera(model.name, 640, 480, np.array([640, 480.0]) if model.name == "EQUIRECTANGULAR" else params)
        (told,) = write_camera_set(tmp_path / "c.toml", only(camera), "parallax")
        assert told.apart.largest_px < 1e-9
