from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datasets.benchmarks import read_bundler, read_imc, read_kitti, read_middlebury, read_strecha
from datasets.benchmarks.__main__ import main
from sfm.core.errors import FormatError, InputError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Reconstruction
from sfm.io.colmap_model import read_model

K = np.array([[700.0, 0, 310], [0, 710, 235], [0, 0, 1]])


def poses(count: int) -> Rigid3:
    rng = np.random.default_rng(0)
    return Rigid3(Rotation3.exp(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))


def write_images(folder: Path, names: list[str], size: tuple[int, int] = (640, 480)) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        Image.new("L", size).save(folder / name)


def words(array: np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in np.ravel(array))


def assert_poses(model: Reconstruction, expected: Rigid3) -> None:
    np.testing.assert_allclose(model.cams_from_world.matrix, expected.matrix, atol=1e-12)


def strecha_folder(folder: Path, expected: Rigid3) -> Path:
    cameras = folder / "gt_dense_cameras"
    cameras.mkdir(parents=True)
    for k in range(len(expected)):
        world_from_cam = expected[k].inverse()
        blocks = [*K, np.zeros(3), *world_from_cam.rotation.matrix, world_from_cam.translation]
        text = "\n".join([words(block) for block in blocks] + ["640 480", ""])
        (cameras / f"{k:04}.jpg.camera").write_text(text)
    return folder


def test_strecha_gives_camera_to_world_rotation_and_centre(tmp_path: Path) -> None:
    expected = poses(3)
    model = read_strecha(strecha_folder(tmp_path, expected))
    assert model.image_names == ("0000.jpg", "0001.jpg", "0002.jpg")
    assert_poses(model, expected)
    assert len(model.cameras) == 1
    camera = model.cameras[1]
    assert (camera.model, camera.width, camera.height) == ("PINHOLE", 640, 480)
    assert camera.params.tolist() == [700, 710, 310, 235]
    assert camera.has_prior_focal_length


def test_pixel_origin_at_the_first_pixels_centre_adds_a_half(tmp_path: Path) -> None:
    model = read_strecha(strecha_folder(tmp_path, poses(1)), pixel_origin="center")
    assert model.cameras[1].params.tolist() == [700, 710, 310.5, 235.5]


def middlebury_file(folder: Path, expected: Rigid3) -> Path:
    names = [f"t{k}.png" for k in range(len(expected))]
    write_images(folder, names)
    lines = [
        f"{name} {words(K)} {words(expected[k].rotation.matrix)} {words(expected[k].translation)}"
        for k, name in enumerate(names)
    ]
    path = folder / "t_par.txt"
    path.write_text("\n".join([str(len(names)), *lines, ""]))
    return path


def test_middlebury_gives_world_to_camera(tmp_path: Path) -> None:
    expected = poses(2)
    model = read_middlebury(middlebury_file(tmp_path, expected))
    assert model.image_names == ("t0.png", "t1.png")
    assert_poses(model, expected)


def test_a_turned_image_sees_the_same_points_at_the_turned_pixels(tmp_path: Path) -> None:
    path = middlebury_file(tmp_path, poses(2))
    straight, turned = read_middlebury(path), read_middlebury(path, turned=["t1.png"])
    assert len(turned.cameras) == 2
    points_in_cam = np.array([[0.1, 0.2, 2.0], [-0.3, 0.05, 1.5]])
    points = straight.cams_from_world[1].inverse() @ points_in_cam
    before, _ = straight.cameras[1].project(straight.cams_from_world[1] @ points)
    after, _ = turned.cameras[2].project(turned.cams_from_world[1] @ points)
    np.testing.assert_allclose(after, [640, 480] - before, atol=1e-9)
    np.testing.assert_allclose(turned.cams_from_world.center, straight.cams_from_world.center, atol=1e-12)
    np.testing.assert_allclose(turned.cams_from_world.matrix[0], straight.cams_from_world.matrix[0])


def test_imc_files_are_matched_to_their_images(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    expected = poses(2)
    write_images(tmp_path / "photos", ["b_2.jpg"], (300, 200))
    write_images(tmp_path / "photos", ["a_1.jpg"], (200, 300))
    (tmp_path / "truth").mkdir()
    for k, stem in enumerate(["a_1", "b_2"]):
        with h5py.File(tmp_path / "truth" / f"calibration_{stem}.h5", "w") as file:
            file["K"], file["R"], file["T"] = K, expected[k].rotation.matrix, expected[k].translation
    model = read_imc(tmp_path / "truth")
    assert model.image_names == ("a_1.jpg", "b_2.jpg")
    assert_poses(model, expected)
    assert [(camera.width, camera.height) for camera in model.cameras.values()] == [(200, 300), (300, 200)]
    (tmp_path / "photos" / "b_2.jpg").unlink()
    with pytest.raises(InputError, match="b_2"):
        read_imc(tmp_path / "truth")


def test_kitti_poses_are_camera_to_world(tmp_path: Path) -> None:
    expected = poses(3)
    write_images(tmp_path / "image_l", ["000000.png", "000001.png", "000002.png"])
    (tmp_path / "poses.txt").write_text("\n".join(words(row) for row in expected.inverse().matrix))
    projection = np.c_[K, [0.0, 0, 0]]
    (tmp_path / "calib.txt").write_text(words(projection) + "\n" + words(projection))
    model = read_kitti(tmp_path)
    assert_poses(model, expected)
    assert model.cameras[1].params.tolist() == [700, 710, 310, 235]
    (tmp_path / "image_l" / "000002.png").unlink()
    with pytest.raises(FormatError, match="3 poses for 2 images"):
        read_kitti(tmp_path)


def test_bundler_projects_as_its_manual_says_and_drops_missing_cameras(tmp_path: Path) -> None:
    in_bundler = poses(3)
    write_images(tmp_path, ["k0.jpg", "k1.jpg", "k2.jpg"])
    (tmp_path / "results").mkdir()
    focal, k1, k2 = 650.0, -0.05, 0.02
    blocks = []
    for k in range(3):
        missing = k == 1
        head = "0 0 0" if missing else f"{focal} {k1} {k2}"
        rows = np.r_[in_bundler[k].rotation.matrix, [in_bundler[k].translation]] * (0 if missing else 1)
        blocks += [head, *(words(row) for row in rows)]
    path = tmp_path / "results" / "bundle.out"
    path.write_text("\n".join(["# Bundle file v0.3", "3 0", *blocks, ""]))
    model = read_bundler(path)
    assert model.image_names == ("k0.jpg", "k2.jpg")

    point_in_cam = np.array([[0.3, -0.2, -2.0]])  # Bundler looks along -z
    point = in_bundler[2].inverse() @ point_in_cam
    p = -point_in_cam[0, :2] / point_in_cam[0, 2]
    squared = p @ p
    x, y = focal * (1 + k1 * squared + k2 * squared**2) * p
    pixel, valid = model.cameras[1].project(model.cams_from_world[1] @ point)
    assert valid.all()
    np.testing.assert_allclose(pixel[0], [320 + x, 240 - y], atol=1e-9)


def test_printed_rotations_become_orthogonal(tmp_path: Path) -> None:
    path = middlebury_file(tmp_path, poses(1))
    words_of_line = path.read_text().split()
    rounded = [f"{float(word):.4f}" for word in words_of_line[2:]]
    path.write_text("\n".join(["1", " ".join([words_of_line[1], *rounded])]))
    matrix = read_middlebury(path).cams_from_world.rotation.matrix[0]
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(matrix, poses(1).rotation.matrix[0], atol=1e-3)


def test_broken_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no \.camera files"):
        read_strecha(tmp_path)
    (tmp_path / "0.camera").write_text("1 2 3")
    with pytest.raises(FormatError, match="expected 26 numbers, got 3"):
        read_strecha(tmp_path)
    with pytest.raises(InputError, match="no such file"):
        read_middlebury(tmp_path / "none_par.txt")
    (tmp_path / "x_par.txt").write_text("2\na.png 1 2 3")
    with pytest.raises(FormatError, match="2 cameras announced, 1 found"):
        read_middlebury(tmp_path / "x_par.txt")
    (tmp_path / "bundle.out").write_text("ply\n")
    with pytest.raises(FormatError, match="not a Bundler file"):
        read_bundler(tmp_path / "bundle.out")
    with pytest.raises(InputError, match="calibration"):
        read_imc(tmp_path)


def test_the_command_writes_a_model_that_reads_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    expected = poses(3)
    source = strecha_folder(tmp_path / "set", expected)
    assert main(["strecha", str(source), str(tmp_path / "out")]) == 0
    assert "3 images, 1 cameras" in capsys.readouterr().out
    assert_poses(read_model(tmp_path / "out"), expected)
    assert main(["strecha", str(tmp_path / "nowhere"), str(tmp_path / "out2")]) == 3
    assert "no .camera files" in capsys.readouterr().err


@pytest.mark.data
def test_real_sets_have_their_numbers_of_cameras(data: Path) -> None:
    sets = data / "sfm"
    assert len(read_strecha(sets / "fountain-P11").image_names) == 11
    assert len(read_middlebury(sets / "middlebury_templeRing" / "templeR_par.txt").image_names) == 47
    assert len(read_imc(sets / "imc_sacre_coeur10" / "ground_truth").image_names) == 10
    assert len(read_kitti(sets / "kitti_odometry_clips" / "KITTI_sequence_1").image_names) == 51
    assert len(read_bundler(sets / "bundler_kermit" / "results.example" / "bundle.out").image_names) == 9
