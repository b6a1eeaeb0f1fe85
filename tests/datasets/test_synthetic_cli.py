from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets.synthetic import make_scene
from datasets.synthetic.__main__ import main

SMALL = ["--images", "2", "--size", "64x48"]


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_a_scene_on_disk_has_photos_and_truth(tmp_path, capsys):
    assert main(["room", "-o", str(tmp_path / "a"), *SMALL]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "a")
    assert list(digests(tmp_path / "a")) == [
        "images/room_0001.jpg", "images/room_0002.jpg",
        "truth/depth/room_0001.npy", "truth/depth/room_0002.npy",
        "truth/normals/room_0001.npy", "truth/normals/room_0002.npy",
        *(f"truth/sparse/0/{name}.bin" for name in ("cameras", "frames", "images", "points3D", "rigs")),
    ]  # fmt: skip
    depth = np.load(tmp_path / "a/truth/depth/room_0001.npy")
    normals = np.load(tmp_path / "a/truth/normals/room_0001.npy")
    assert (depth.shape, depth.dtype) == ((48, 64), np.float32)
    assert (normals.shape, normals.dtype) == ((48, 64, 3), np.float16)
    assert 0.5 < np.nanmedian(depth) < 6
    assert cv2.imread(str(tmp_path / "a/images/room_0001.jpg")).shape == (48, 64, 3)


def test_the_same_arguments_give_the_same_bytes_on_any_number_of_threads(tmp_path):
    for folder, threads in (("a", "1"), ("b", "2")):
        assert main(["facade", "-o", str(tmp_path / folder), *SMALL, "--seed", "3", "--threads", threads]) == 0
    assert main(["facade", "-o", str(tmp_path / "c"), *SMALL, "--seed", "4"]) == 0
    assert digests(tmp_path / "a") == digests(tmp_path / "b")
    assert digests(tmp_path / "a") != digests(tmp_path / "c")


def test_a_rig_writes_a_folder_for_each_camera_in_any_model(tmp_path):
    arguments = ["rig", "-o", str(tmp_path), *SMALL, "--camera-model", "OPENCV_FISHEYE", "--clean", "--no-maps"]
    assert main(arguments) == 0
    names = list(digests(tmp_path))
    assert names[:4] == [f"images/{side}/000{k}.png" for side in ("left", "right") for k in (1, 2)]
    assert not (tmp_path / "truth/depth").exists()


@pytest.mark.parametrize(
    "arguments", [["nowhere"], ["orbit", "--size", "12"], ["orbit", "--images", "0"], ["orbit", "--camera-model", "X"]]
)
def test_wrong_arguments_are_a_usage_error(arguments, tmp_path):
    with pytest.raises(SystemExit) as error:
        main([*arguments, "-o", str(tmp_path)])
    assert error.value.code == 2


def test_the_usual_size_is_that_of_a_real_capture():
    scene = make_scene("orbit")
    assert (scene.views[0].camera.width, scene.views[0].camera.height, len(scene.views)) == (1280, 960, 24)
