"""`calib camera` and `calib check` as commands, on rendered boards and on corners."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.boards import Board, charuco, chessboard
from calib.cli.photos import detection_json
from calib.detect import Detection
from datasets.synthetic.boards import DISTORTED, pose, render
from sfm.core.cameras import Camera
from sfm.io.camera_files import read_camera_file
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen

BOARD = chessboard(9, 6, 0.03)
NAMED = "chessboard:9x6:30mm"


def write_corners(path: Path, camera: Camera, poses, rng, board: Board = BOARD) -> None:
    """What `calib detect -o` writes of photos with noise of 0.1 px."""
    centred = board.points3D - board.points3D.mean(axis=0)
    images = {}
    for view in seen(camera, centred, poses, rng):
        covariances = np.tile(0.01 * np.eye(2), (len(view.corner_ids), 1, 1))
        detection = Detection(view.name, view.width, view.height, view.corner_ids, view.points2D, covariances)
        images[view.name] = detection_json(detection)
    document = {"board": board.spec, "points3D": board.points3D.tolist(), "pixel_center": 0.5, "images": images}
    path.write_text(json.dumps(document))


@pytest.fixture
def corners(tmp_path, rng):
    """Ten photos as corners, and other ten."""
    poses = poses_before(LENS, 20, rng)
    write_corners(tmp_path / "corners.json", LENS, poses[:10], rng)
    write_corners(tmp_path / "other.json", LENS, poses[10:], rng)
    return tmp_path / "corners.json"


@pytest.fixture
def photos(made_once, tmp_path):
    """Photos of a ChArUco board, partly cut by the border; one of nothing, one cut off, one of another size."""
    board = charuco(6, 5, 0.03, 0.022)

    def make(folder: Path) -> None:
        rng = np.random.default_rng(8)
        for k in range(7):
            held = pose(board, 0.2, rng.uniform(15, 40), rng.uniform(0, 360), shift=rng.uniform(-0.03, 0.03, 2))
            image, _ = render(board, DISTORTED, held, seed=k, texels_per_m=2000)
            cv2.imwrite(str(folder / f"p{k}.png"), image.astype(np.uint16) * 257 if k == 1 else image)
        cv2.imwrite(str(folder / "smaller.png"), cv2.resize(image, (240, 180), interpolation=cv2.INTER_AREA))
        cv2.imwrite(str(folder / "empty.png"), np.full((360, 480), 90, np.uint8))
        (folder / "torn.png").write_bytes((folder / "p0.png").read_bytes()[:400])
        (folder / "text.jpg").write_text("no photo")

    shutil.copytree(made_once("charuco-photos", make), tmp_path / "photos")
    return "charuco:6x5:30mm:22mm"


def test_photos_become_a_camera_that_is_told_in_full(sfm, photos, tmp_path):
    made = sfm("camera", "photos", "--board", photos, "--model", "opencv", "-o", "c.toml", "--json", "--no-cache",
               "--name", "left", "--suggest", "next.svg", module="calib")  # fmt: skip
    assert made.returncode == 0, made.stderr
    told = json.loads(made.stdout)
    assert (told["model"], told["width"], told["height"], told["pixel_center"]) == ("OPENCV", 480, 360, 0.5)
    assert told["converged"]
    sigma = np.array([told["sigma"][name] for name in told["param_names"]])
    assert np.all(np.abs(np.array(told["params"]) - DISTORTED.params) < 5 * sigma)
    assert 0 < told["rms_px"] < told["holdout_rms_px"] < 0.1
    assert told["photos"]["count"] == 11
    assert {view["name"] for view in told["views"]} == {f"p{k}.png" for k in range(7)}
    reasons = {view["name"]: view["reason"] for view in told["rejected"]}
    assert reasons["torn.png"] == reasons["text.jpg"] == "unreadable"
    assert reasons["smaller.png"] == "other_size"
    assert reasons["empty.png"] in ("no_board", "too_few_corners")
    camera, record = read_camera_file(tmp_path / "c.toml")
    assert camera.params.tolist() == told["params"]
    assert record.uncertainty is not None
    assert record.uncertainty.sigma.tolist() == pytest.approx(sigma.tolist())
    assert record.facts["photos_digest"] == told["photos"]["digest"]
    assert str(record.facts["command"]).startswith("calib camera photos --board charuco:6x5")
    assert (tmp_path / "next.svg").read_text().count("<polyline") == 3 * (5 + 4)
    assert len(told["suggestions"]) == 3


def test_the_same_corners_give_the_same_file_but_for_its_date(sfm, corners, tmp_path):
    for name, threads in (("a.toml", 1), ("b.toml", 2)):
        assert sfm("camera", "corners.json", "-o", name, "--threads", threads, module="calib").returncode == 0
    a, b = (
        [line for line in (tmp_path / name).read_text().splitlines() if not line.startswith(("date", "command"))]
        for name in ("a.toml", "b.toml")
    )
    assert a == b


def test_auto_takes_a_model_that_predicts_photos_and_names_the_others(sfm, corners):
    made = sfm("camera", "corners.json", "-o", "c.toml", module="calib")
    assert made.returncode == 0, made.stderr
    assert "lens model opencv4, chosen by held-out photos" in made.stdout
    assert "  pinhole " in made.stdout
    assert "board, taken for flat, chosen by held-out photos" in made.stdout
    assert "differs by px" in made.stdout


def test_photos_of_the_same_camera_pass_and_of_another_fail(sfm, corners, tmp_path, rng):
    made = sfm("camera", "corners.json", "--model", "opencv", "-o", "c.toml", module="calib")
    assert made.returncode == 0, made.stderr
    passed = sfm("check", "c.toml", "other.json", "--json", module="calib")
    assert passed.returncode == 0, passed.stderr
    told = json.loads(passed.stdout)
    assert (told["verdict"], told["same_photos"]) == ("passed", False)
    assert told["rms_px"] == pytest.approx(told["calibration"]["holdout_rms_px"], rel=0.2)
    again = sfm("check", "c.toml", "corners.json", module="calib")
    assert "the very photos" in again.stdout
    poses = poses_before(LENS, 8, rng)
    for changes, cause in (
        (np.array([1.02, 1.02, 1, 1, 1, 1, 1, 1]), "focal_length_differs: 2 % longer"),
        (np.array([1, 1, 1.02, 1, 1, 1, 1, 1]), "principal_point_differs: cx +1"),
        (np.array([1, 1, 1, 1, 0.5, 0, 1, 1]), "lens_or_board_differs"),
    ):
        write_corners(tmp_path / "new.json", LENS.with_params(LENS.params * changes), poses, rng)
        failed = sfm("check", "c.toml", "new.json", module="calib")
        assert failed.returncode == 5, failed.stdout
        assert cause in failed.stdout
        assert failed.stdout.startswith("FAILED: ")


def test_an_error_that_opencv_s_file_states_far_above_ours_is_a_cause(sfm, corners, tmp_path):
    k1, k2, p1, p2 = LENS.params[4:]
    fx, fy, cx, cy = LENS.params[:4]
    (tmp_path / "c.yml").write_text(
        "%YAML:1.0\n---\nimage_width: 1280\nimage_height: 960\n"
        f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        f"   data: [ {fx}, 0., {cx - 0.5}, 0., {fy}, {cy - 0.5}, 0., 0., 1. ]\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n"
        f"   data: [ {k1}, {k2}, {p1}, {p2} ]\n"
        "avg_reprojection_error: 0.41\n"
    )
    result = sfm("check", "c.yml", "other.json", "--json", module="calib")
    assert result.returncode == 0, result.stdout + result.stderr
    told = json.loads(result.stdout)
    assert told["calibration"]["rms_px"] == 0.41
    assert told["limit_px"] == 0.82
    assert "worse_corners" in [finding["cause"] for finding in told["findings"]]


def test_a_shape_that_would_bring_more_is_told_in_one_sentence(sfm, tmp_path, rng):
    """Corners that lie 0.2 mm off their design, in too few photos to say where."""
    off = flat_board() + rng.normal(0, 2e-4, (54, 3))
    images = {}
    for view in seen(LENS, off, poses_before(LENS, 14, rng), rng):
        ones = np.tile(np.eye(2), (len(view.corner_ids), 1, 1))
        images[view.name] = detection_json(
            Detection(view.name, view.width, view.height, view.corner_ids, view.points2D, ones)
        )
    document = {"board": BOARD.spec, "points3D": BOARD.points3D.tolist(), "pixel_center": 0.5, "images": images}
    (tmp_path / "corners.json").write_text(json.dumps(document))
    words = ("camera", "corners.json", "--model", "opencv", "-o", "c.toml")
    told = json.loads(sfm(*words, "--json", module="calib").stdout)
    assert told["board"]["shape"] != "free"
    assert told["holdout_rms_px"] < 1.05 * told["rms_px"]
    (sentence,) = told["would_bring"]
    assert sentence.startswith("a free board shape would bring the error of photos held out from")
    assert sentence.endswith("photos like these, or --shape free")
    assert sentence in sfm(*words, module="calib").stdout
    assert sfm("report", "c.toml", "corners.json", "-o", "c.html", module="calib").returncode == 0
    assert sentence[1:] in (tmp_path / "c.html").read_text()


def test_resized_photos_are_checked_by_the_resized_camera(sfm, corners, tmp_path, rng):
    assert sfm("camera", "corners.json", "--model", "opencv", "-o", "c.toml", module="calib").returncode == 0
    half = LENS.scaled(640, 480)
    write_corners(tmp_path / "half.json", half, poses_before(half, 6, rng), rng)
    result = sfm("check", "c.toml", "half.json", module="calib")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "640 × 480 px" in result.stdout


def test_the_shape_of_the_board_is_kept_for_the_check(sfm, tmp_path, rng):
    """Corners 0.5 mm off their design would be 1 px to a camera that takes the board for flat."""
    off = rng.normal(0, 5e-4, BOARD.points3D.shape)
    poses = poses_before(LENS, 24, rng)
    for name, some in (("corners.json", poses[:16]), ("other.json", poses[16:])):
        document = {"board": BOARD.spec, "points3D": BOARD.points3D.tolist(), "pixel_center": 0.5, "images": {}}
        centred = BOARD.points3D - BOARD.points3D.mean(axis=0) + off
        for view in seen(LENS, centred, some, rng):
            ones = np.tile(np.eye(2), (len(view.corner_ids), 1, 1))
            detection = Detection(view.name, view.width, view.height, view.corner_ids, view.points2D, ones)
            document["images"][view.name] = detection_json(detection)
        (tmp_path / name).write_text(json.dumps(document))
    for shape in ("free", "flat"):
        made = sfm("camera", "corners.json", "--model", "opencv", "--shape", shape, "-o", f"{shape}.toml",
                   module="calib")  # fmt: skip
        assert made.returncode == 0, made.stderr
    errors = [
        json.loads(sfm("check", f"{shape}.toml", "other.json", "--json", module="calib").stdout)["rms_px"]
        for shape in ("free", "flat")
    ]
    assert errors[0] < 0.2 < 0.7 < errors[1]


def test_boards_that_say_nothing_of_the_focal_length_give_no_camera(sfm, tmp_path, rng):
    facing = poses_before(LENS, 6, rng, tilt=0.0, reach=0.0)
    write_corners(tmp_path / "facing.json", LENS, facing, rng)
    result = sfm("camera", "facing.json", "--model", "opencv", "-o", "c.toml", module="calib")
    assert result.returncode == 4
    assert "undetermined_focal" in result.stderr
    assert "tilt" in result.stderr
    assert not (tmp_path / "c.toml").exists()


def test_a_board_that_is_nearly_the_one_named_is_named(sfm, photos):
    result = sfm("camera", "photos", "--board", "charuco:5x6:30mm:22mm", "-o", "c.toml", "--no-cache", module="calib")
    assert result.returncode in (3, 4)
    assert "the photos show 6x5 squares, you named 5x6" in result.stderr
    assert f"try --board {photos}" in result.stderr


def csv_of(path: Path, poses, rng, header: str) -> None:
    board = flat_board(4, 4, 0.03)
    lines = [header]
    for view in seen(LENS, board, poses, rng):
        for corner, (x, y) in zip(view.corner_ids.tolist(), view.points2D - 0.5, strict=True):
            place = ",".join(f"{value:.6f}" for value in board[corner])
            lines.append(f"{view.name},{corner // 4},{corner % 4},{x:.6f},{y:.6f},{place}")
    path.write_text("\n".join(lines) + "\n")


def test_corners_of_another_program_calibrate(sfm, tmp_path, rng):
    poses = poses_before(LENS, 12, rng)
    csv_of(tmp_path / "c.csv", poses, rng, "#ts,tag_id,corner_idx,kp_x,kp_y,p_x,p_y,p_z")
    made = sfm("camera", "c.csv", "--size", "1280x960", "--model", "opencv", "-o", "c.toml", "--json", module="calib")
    assert made.returncode == 0, made.stderr
    told = json.loads(made.stdout)
    sigma = np.array([told["sigma"][name] for name in told["param_names"]])
    assert np.all(np.abs(np.array(told["params"]) - LENS.params) < 5 * sigma)


def test_a_table_of_mrcal_is_read_with_its_holes(sfm, tmp_path, rng):
    lines = ["# filename x y level"]
    for view in seen(LENS, BOARD.points3D - BOARD.points3D.mean(axis=0), poses_before(LENS, 8, rng), rng):
        at = dict(zip(view.corner_ids.tolist(), (view.points2D - 0.5).tolist(), strict=True))
        lines += [
            f"{view.name}.jpg {at[k][0]} {at[k][1]} 0" if k in at else f"{view.name}.jpg - - -" for k in range(54)
        ]
    lines.append("nothing.jpg - - -")
    (tmp_path / "c.vnl").write_text("\n".join(lines))
    made = sfm("camera", "c.vnl", "--board", NAMED, "--size", "1280x960", "--model", "opencv", "-o", "c.toml", "--json",
               module="calib")  # fmt: skip
    assert made.returncode == 0, made.stderr
    told = json.loads(made.stdout)
    assert told["params"][2] == pytest.approx(LENS.params[2], abs=5 * told["sigma"]["cx"])
    assert told["rejected"] == [{"name": "nothing.jpg", "reason": "no_board", "detail": "no corners"}]


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["camera", "nowhere", "--board", NAMED, "-o", "c.toml"], 3, "no such folder"),
        (["camera", "corners.json", "-o", "c.yaml"], 2, "must end in .toml"),
        (["camera", "corners.json", "-o", "c.toml", "--model", "opnecv"], 2, "unknown lens model 'opnecv'"),
        (["camera", "corners.json", "-o", "c.toml", "--shape", "round"], 2, "unknown --shape 'round'"),
        (["camera", "corners.json", "-o", "c.toml", "--board", "chessboard:8x6:30mm"], 3, "leave --board out"),
        (["camera", ".", "-o", "c.toml"], 2, "no board is named"),
        (["camera", "-o", "c.toml"], 2, "no photos are named"),
        (["camera", "bad.csv", "-o", "c.toml", "--size", "9x9"], 3, "is no table of corners"),
        (["camera", "bad.csv", "-o", "c.toml"], 2, "need --size"),
        (["check", "none.toml", "corners.json"], 3, "none.toml"),
        (["check", "bad.toml", "corners.json"], 3, "[calibration] unknown key 'rsm_px'"),
    ],
)
def test_a_mistake_is_told_in_one_line(sfm, corners, tmp_path, words, code, said):
    (tmp_path / "bad.csv").write_text("a,b\n1,2\n")
    (tmp_path / "bad.toml").write_text(
        '[camera]\nmodel = "PINHOLE"\nwidth = 9\nheight = 9\nparams = [1, 1, 1, 1]\n[calibration]\nrsm_px = 1.0\n'
    )
    result = sfm(*words, module="calib")
    assert result.returncode == code, result.stderr
    assert said in result.stderr
    assert [line for line in result.stderr.splitlines() if "error:" in line] == [result.stderr.splitlines()[-1]]


def test_a_bug_is_one_line_and_a_log(capsys, monkeypatch):
    from calib import cli

    def broken(words):
        raise RuntimeError("with\nlines")

    monkeypatch.setattr("calib.cli.board.main", broken)
    assert cli.main(["board", "x"]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first == "error: this is a bug in Parallax: RuntimeError: with lines"
    assert "RuntimeError" in Path(second.removeprefix("log: ")).read_text()
