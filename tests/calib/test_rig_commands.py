"""`calib stereo`, `calib rig` and `calib handeye` as processes, on rendered photos."""

from __future__ import annotations

import dataclasses
import json

import cv2
import numpy as np
import pytest

from calib.boards import chessboard
from calib.cli.rig_options import CommonOptions, known_cameras, named_sources
from calib.cli.robot_poses import read_robot_poses
from datasets.synthetic.boards import DISTORTED, PINHOLE, pose, render
from sfm.core.errors import ConfigError, FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.io.camera_files import write_camera_toml
from sfm.io.rig_files import read_rig_file

BOARD = chessboard(8, 6, 0.025)
SPEC = "chessboard:8x6:25mm"
RIGHT_FROM_LEFT = Rigid3.exp(np.array([0.01, 0.03, -0.01, -0.08, 0.001, 0.002]))
HAND_FROM_CAM = Rigid3.exp(np.array([0.1, -0.2, 1.4, 0.02, -0.05, 0.08]))
BASE_FROM_BOARD = Rigid3.exp(np.array([2.9, 0.2, -0.1, 0.6, 0.1, 0.02]))
TILTS = (
    (30, 0, 5, 0.02), (30, 90, -10, 0), (25, 180, 0, 0.06), (30, 270, 20, 0.08), (20, 45, 0, 0.03), (35, 135, 9, 0.05),
    (28, 225, -15, 0.04),
)  # fmt: skip
"""Of the board: tilt and its axis, roll, degrees; shift, metres."""


@pytest.fixture(scope="module")
def photos(made_once):
    """left/ and right/ with seven photos each; one more that only the left camera took."""

    def make(folder):
        for side in ("left", "right"):
            (folder / side).mkdir(parents=True)
        rows = ["name,x,y,z,qw,qx,qy,qz"]
        for k, (tilt, axis, roll, shift) in enumerate(TILTS):
            left = pose(BOARD, 0.36 + 0.02 * (k % 3), tilt, axis, roll, (shift, 0.01 * (k % 4 - 2)))
            for side, camera, cam in (("left", DISTORTED, left), ("right", PINHOLE, RIGHT_FROM_LEFT @ left)):
                image, _ = render(BOARD, camera, cam, seed=2 * k + (side == "left"))
                cv2.imwrite(str(folder / side / f"{k}.png"), image)
            hand = BASE_FROM_BOARD @ left.inverse() @ HAND_FROM_CAM.inverse()
            rows.append(",".join(map(str, [k, *hand.translation, *hand.rotation.wxyz])))
        cv2.imwrite(str(folder / "left" / "99.png"), np.full((360, 480), 128, np.uint8))
        (folder / "robot.csv").write_text("\n".join(rows) + "\n")
        write_camera_toml(folder / "left.toml", DISTORTED)

    return made_once("rig_photos", make)


def test_a_pair_of_folders_becomes_a_rig(sfm, tmp_path, photos):
    made = sfm("stereo", photos / "left", photos / "right", "--board", SPEC, "-o", "rig.toml", "--model", "opencv",
               "--shape", "flat", "--json", "--no-cache", module="calib")  # fmt: skip
    assert made.returncode == 0, made.stderr
    told = json.loads(made.stdout)
    (pair,) = told["pairs"]
    assert pair["baseline_m"] == pytest.approx(
        np.linalg.norm(RIGHT_FROM_LEFT.translation), abs=4 * pair["sigma_baseline_m"]
    )
    assert told["frames"]["without_partner"]["left"] == ["99.png"]
    assert "no_board" in told["cameras"][0]["rejected"]["99.png"]
    assert told["converged"]
    assert pair["epipolar_rms_px"] < 0.15
    file = read_rig_file(tmp_path / "rig.toml")
    assert file.rig.names == ("left", "right")
    assert file.rms_px == told["rms_px"]
    np.testing.assert_allclose(file.rig.cams_from_rig[1].translation, RIGHT_FROM_LEFT.translation, atol=5e-4)
    assert file.provenance["board"] == SPEC


def test_a_rig_with_a_known_camera_is_told_in_a_table(sfm, tmp_path, photos):
    made = sfm("rig", f"a={photos / 'left'}", f"b={photos / 'right'}", "--board", SPEC, "-o", "rig.toml", "--model",
               "b=pinhole", "--camera", f"a={photos / 'left.toml'}", "--shape", "flat", "--no-cache",
               module="calib")  # fmt: skip
    assert made.returncode == 0, made.stderr
    assert "OPENCV (given)" in made.stdout
    assert "PINHOLE (pinhole)" in made.stdout
    assert "a → b" in made.stdout
    file = read_rig_file(tmp_path / "rig.toml")
    np.testing.assert_array_equal(file.rig.cameras[0].params, DISTORTED.params)
    assert file.sigmas[0].params.max() == 0
    options = CommonOptions(board=SPEC, output=tmp_path / "x.toml", camera=(f"b={tmp_path / 'rig.toml'}",))
    np.testing.assert_array_equal(known_cameras(options, ("a", "b"))["b"].params, file.rig.cameras[1].params)
    with pytest.raises(ConfigError, match="no camera 'c' among a, b"):
        known_cameras(dataclasses.replace(options, camera=(f"c={tmp_path / 'rig.toml'}",)), ("c",))


def test_a_camera_is_found_on_its_robot(sfm, tmp_path, photos):
    made = sfm("handeye", photos / "left", "--poses", photos / "robot.csv", "--board", SPEC, "--camera",
               photos / "left.toml", "-o", "handeye.toml", "--json", "--no-cache", module="calib")  # fmt: skip
    assert made.returncode == 0, made.stderr
    told = json.loads(made.stdout)
    off = np.array(told["hand_from_cam"]["translation"]) - HAND_FROM_CAM.translation
    assert np.all(np.abs(off) < 4 * np.array(told["sigma_position_m"]) + 1e-4)
    assert "[hand_from_cam]" in (tmp_path / "handeye.toml").read_text()


HANDEYE = ["handeye", "left", "--poses", "robot.csv", "--board", SPEC, "--camera", "left.toml"]


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["stereo", "left", "left", "--board", SPEC, "-o", "rig.toml"], 4, "same_photos"),
        (["stereo", "left", "right", "--board", SPEC, "-o", "rig.xml"], 2, "must end in .toml"),
        (["stereo", "left", "right", "--board", SPEC, "-o", "rig.toml", "--pair", "order"], 4, "different_counts"),
        (["stereo", "left", "right", "--board", SPEC, "-o", "rig.toml", "--pair", "odor"], 2, "--pair"),
        (["stereo", "left", "right", "--board", SPEC, "-o", "rig.toml", "--model", "top=opencv"], 2, "no camera 'top'"),
        (["stereo", "left", "right", "--board", SPEC, "-o", "rig.toml", "--camera", "left"], 2, "NAME=FILE"),
        (["stereo", "left*.jpg", "right", "--board", SPEC, "-o", "rig.toml"], 3, "no file is called so"),
        (["rig", "left", "--board", SPEC, "-o", "rig.toml"], 2, "two cameras or more"),
        (["handeye", "left", "--poses", "left.toml", "--board", SPEC, "--camera", "left.toml"], 3, "no column"),
        ([*HANDEYE, "--unit", "ft"], 2, "--unit"),
        ([*HANDEYE, "--unit", "mm"], 4, "other_unit"),
        ([*HANDEYE, "--eye-to-hand"], 4, "inverse_poses"),
        ([*HANDEYE, "--robot-mm", "1"], 2, "belong together"),
    ],
)  # fmt: skip
def test_a_mistake_is_told_in_one_line(sfm, photos, words, code, said):
    result = sfm(*(photos / word if word in ("left", "right", "robot.csv", "left.toml") else word for word in words),
                 module="calib")  # fmt: skip
    assert result.returncode == code, result.stderr
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert said in errors[0]


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["a/cam0", "a/cam1"], ["cam0", "cam1"]),
        (["mav/cam0/data", "mav/cam1/data"], ["cam0", "cam1"]),
        (["p/left*.jpg", "p/right*.jpg"], ["left", "right"]),
        (["top=x/data", "x/side"], ["top", "side"]),
    ],
)
def test_cameras_are_called_by_what_tells_their_paths_apart(words, names):
    assert list(named_sources(words)) == names


def test_two_cameras_of_one_name_are_a_mistake():
    with pytest.raises(ConfigError, match="two cameras are called 'a'"):
        named_sources(["a=x", "a=y"])


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("name,x,y,z,qw,qx,qy\na,1,2,3,1,0,0\n", "no column qz"),
        ("name,x,y,z,qw,qx,qy,qz\na,1,2,3,1,0,0,much\n", "row 2 is not"),
        ("name,x,y,z,qw,qx,qy,qz\na,1,2,3,1,1,0,0\n", "no unit quaternion"),
        ("name,x,y,z,qw,qx,qy,qz\na,1,2,3,1,0,0,0\na,1,2,3,1,0,0,0\n", "a twice"),
        ("name,x,y,z,qw,qx,qy,qz\n", "holds no pose"),
    ],
)
def test_a_mistake_in_the_table_of_poses_is_told(tmp_path, text, cause):
    (tmp_path / "robot.csv").write_text(text)
    with pytest.raises(FormatError, match=cause):
        read_robot_poses(tmp_path / "robot.csv")


def test_columns_of_the_table_may_be_in_any_order(tmp_path):
    (tmp_path / "robot.csv").write_text("# robot 7\nqx,qy,qz,qw,name,speed,x,y,z\n0,0,0,1,a,9,100,200,300\n")
    (found,) = read_robot_poses(tmp_path / "robot.csv", 1e-3).values()
    np.testing.assert_allclose(found.translation, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(found.rotation.wxyz, [1, 0, 0, 0])
