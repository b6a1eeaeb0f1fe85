from __future__ import annotations

import cv2
import numpy as np
import pytest

from sfm.core.cameras import MODELS, Camera
from sfm.core.errors import ConfigError
from sfm.core.events import SILENT
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import CameraRig
from sfm.io.database import Database
from sfm.io.rig_files import RigFile, write_rig_file
from sfm.pipeline.config import CameraConfig
from sfm.pipeline.intrinsics import assigned_cameras, resized_camera
from sfm.pipeline.scene import read_scene


def camera(width: int = 640, height: int = 480, f: float = 500.0) -> Camera:
    return Camera("SIMPLE_RADIAL", width, height, np.array([f, 321.0, 239.0, -0.1]))


@pytest.mark.parametrize("model", [m for m in MODELS if m.name != "EQUIRECTANGULAR"], ids=lambda m: m.name)
def test_projection_of_a_resized_camera_is_the_resized_projection(model):
    values = {"f": 500.0, "fx": 500.0, "fy": 510.0, "cx": 321.0, "cy": 239.0, "alpha": 0.5, "beta": 1.1}
    full = Camera(model.name, 640, 480, np.array([values.get(name, 0.01) for name in model.param_names]))
    half = resized_camera(full, 320, 240)
    assert half is not None
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3)) + np.array([0, 0, 1.0])
    assert half.project(points)[0] == pytest.approx(full.project(points)[0] / 2, abs=1e-9)


def test_a_panorama_is_resized_too():
    full = Camera("EQUIRECTANGULAR", 2000, 1000, np.array([2000.0, 1000.0]))
    half = resized_camera(full, 1000, 500)
    assert half is not None
    assert half.params.tolist() == [1000, 500]


@pytest.mark.parametrize(("width", "height"), [(320, 240), (1280, 960), (213, 160), (333, 250), (1001, 751)])
def test_sizes_that_rounding_explains_are_multiples(width, height):
    assert resized_camera(camera(), width, height) is not None


@pytest.mark.parametrize(("width", "height"), [(640, 479 - 8), (480, 640), (320, 320), (640, 360), (1280, 970)])
def test_crops_and_turned_images_are_not(width, height):
    assert resized_camera(camera(), width, height) is None


def test_the_same_size_gives_the_same_camera():
    one = camera()
    assert resized_camera(one, 640, 480) is one


def test_one_camera_serves_all_images_at_their_sizes():
    found = assigned_cameras({5: camera()}, [("a", 640, 480), ("b", 320, 240)], "file")
    assert [found[name][0] for name in "ab"] == [5, 5]
    assert [found[name][1].params[0] for name in "ab"] == [500, 250]


def test_several_cameras_serve_by_size():
    cameras = {1: camera(), 2: camera(480, 640, 700.0)}
    found = assigned_cameras(cameras, [("a", 480, 640), ("b", 640, 480), ("c", 640, 480)], "file")
    assert [found[name][0] for name in "abc"] == [2, 1, 1]


def test_an_exact_size_comes_before_a_multiple():
    cameras = {1: camera(1280, 960, 999.0), 2: camera()}
    assert [entry[0] for entry in assigned_cameras(cameras, [(n, 640, 480) for n in "abc"], "f").values()] == [2] * 3


def test_as_many_cameras_as_images_are_taken_in_order():
    cameras = {9: camera(f=900.0), 3: camera(f=300.0)}
    found = assigned_cameras(cameras, [("a", 640, 480), ("b", 640, 480)], "file")
    assert [found[name][1].params[0] for name in "ab"] == [300, 900]


def test_cameras_that_fit_alike_are_refused():
    cameras = {1: camera(), 2: camera(f=300.0)}
    with pytest.raises(ConfigError, match="2 of its 2 cameras fit a of 640×480"):
        assigned_cameras(cameras, [(name, 640, 480) for name in "abc"], "file")


def test_images_of_another_shape_are_refused():
    with pytest.raises(ConfigError, match=r"for 640×480 px, but b has 640×427 px"):
        assigned_cameras({1: camera()}, [("a", 640, 480), ("b", 640, 427)], "file")


RIG = {1: camera(f=100.0), 2: camera(f=200.0), 3: camera(800, 600, 300.0)}
NAMES = {1: "cam1", 2: "cam10", 3: "Top"}


@pytest.mark.parametrize(
    ("image", "taken"),
    [
        ("cam1/07.png", 1), ("day/CAM10/07.png", 2), ("cam10/cam1_07.png", 2), ("cam1_07.png", 1), ("cam10-7.png", 2),
        ("top7.png", 3),
    ],
)  # fmt: skip
def test_cameras_with_names_serve_the_photos_that_are_called_so(image, taken):
    size = (RIG[taken].width, RIG[taken].height)
    other = ("cam1/other.png", 640, 480)
    assert assigned_cameras(RIG, [(image, *size), other], "rig.toml", NAMES)[image] == (taken, RIG[taken])


def test_photos_that_no_name_fits_go_by_size_and_are_refused_where_that_leaves_a_choice():
    rig = {1: camera(), 2: camera(800, 600)}
    names = {1: "left", 2: "right"}
    images = [("left/a.png", 640, 480), ("b.png", 800, 600)]
    assert [entry[0] for entry in assigned_cameras(rig, images, "rig.toml", names).values()] == [1, 2]
    for unnamed in ("b.png", "lefty.png", "left/right/b.png"):
        with pytest.raises(ConfigError, match="2 of its 3 cameras fit") as caught:
            assigned_cameras({**rig, 3: camera(f=7.0)}, [images[0], (unnamed, 640, 480)], "rig.toml", names)
        assert "a folder of its name: left, right" in str(caught.value)


def test_a_photo_of_another_shape_than_its_camera_is_refused():
    with pytest.raises(ConfigError, match=r"for 640×480 px, but cam1/a has 800×500 px"):
        assigned_cameras(RIG, [("cam1/a", 800, 500)], "rig.toml", NAMES)


def test_photos_of_a_rig_get_the_cameras_of_their_folders(tmp_path):
    beside = Rigid3.stack([Rigid3.identity(), Rigid3.exp(np.array([0, 0, 0, -0.1, 0, 0]))])
    rig = CameraRig(("left", "right"), (camera(f=500.0), camera(f=510.0)), beside, "left")
    write_rig_file(tmp_path / "rig.toml", RigFile(rig))
    for name in ("left/0.png", "left/1.png", "right/0.png"):
        (tmp_path / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / "photos" / name), np.full((480, 640), 90, np.uint8))
    with Database.open(tmp_path / "database.db") as database:
        config = CameraConfig(intrinsics=str(tmp_path / "rig.toml"))
        scene = read_scene(database, tmp_path / "photos", config, threads=1, observer=SILENT)
    taken = {image.name: image.camera.params[0] for image in scene.images.values()}
    assert taken == {"left/0.png": 500, "left/1.png": 500, "right/0.png": 510}
    assert len({image.camera_id for image in scene.images.values()}) == 2
