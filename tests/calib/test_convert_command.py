"""`calib convert`: what it prints and how it ends."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calib.cli import main
from sfm.core.cameras import Camera
from sfm.core.errors import ExitCode
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import CameraRig
from sfm.io.camera_files import read_camera_file, read_intrinsics, write_camera_toml
from sfm.io.camera_records import BoardRecord, CameraRecord, ParameterCovariance
from sfm.io.rig_files import MountedSigmas, RigFile, read_rig_file, write_rig_file

BENT = Camera("FULL_OPENCV", 640, 480, np.array([536.0, 536, 342.8, 236, -0.27, 0.04, 1e-3, 0, -0.03, 0, 0, 0]))


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    write_camera_toml(tmp_path / "camera.toml", BENT, name="left")
    return tmp_path / "camera.toml"


def test_an_export_tells_how_far_it_is_off(camera: Path, capsys) -> None:
    target = camera.with_name("info.yaml")
    assert main(["convert", str(camera), "-o", str(target), "--to", "ros"]) == ExitCode.OK
    told = capsys.readouterr().out
    assert "left FULL_OPENCV 640x480" in told
    assert "read again" in told
    assert "largest difference" in told
    assert "camera_name: left" in target.read_text()
    np.testing.assert_allclose(read_intrinsics(target)[1].params, BENT.params)


def test_a_fit_tells_how_far_it_is_off_and_without_one_a_lens_is_refused(camera: Path, capsys) -> None:
    words = ["convert", str(camera), "-o", str(camera.with_name("chain.yaml")), "--to", "kalibr"]
    assert main(words) == ExitCode.BAD_INPUT
    assert "no place for k3 = -0.03" in capsys.readouterr().err
    assert main([*words, "--fit", "opencv"]) == ExitCode.OK
    assert "left as OPENCV: off by up to" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (["-o", "x.yaml"], ExitCode.USAGE, "--to parallax|colmap"),
        (["-o", "x.toml", "--fit", "OPENCVV"], ExitCode.USAGE, "there is no such model"),
        (["-o", "x.toml", "--camera", "right"], ExitCode.USAGE, "there are left"),
        (["-o", "x.toml", "--size", "640"], ExitCode.USAGE, "WIDTHxHEIGHT"),
        (["-o", "camera.toml"], ExitCode.USAGE, "both source and target"),
    ],
)
def test_what_cannot_be_done_is_said_in_a_line(camera: Path, capsys, monkeypatch, words, code, told) -> None:
    monkeypatch.chdir(camera.parent)
    before = camera.read_bytes()
    assert main(["convert", "camera.toml", *words]) == code
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert camera.read_bytes() == before


def test_the_poses_of_a_rig_go_beside_the_cameras_or_are_said_to_be_left_out(tmp_path: Path, capsys) -> None:
    beside = Rigid3.stack([Rigid3.identity(), Rigid3.exp(np.array([0.01, -0.3, 0.02, -0.12, 0.001, 0.002]))])
    write_rig_file(tmp_path / "rig.toml", RigFile(CameraRig(("left", "right"), (BENT, BENT), beside, "left")))
    assert main(["convert", str(tmp_path / "rig.toml"), "-o", str(tmp_path / "cameras.txt")]) == ExitCode.OK
    told = capsys.readouterr().out
    assert "rigs.txt" in told
    assert "note" not in told
    assert main(["convert", str(tmp_path / "cameras.txt"), "-o", str(tmp_path / "again.toml")]) == ExitCode.OK
    again = read_rig_file(tmp_path / "again.toml").rig
    np.testing.assert_allclose(again.cams_from_rig.matrix, beside.matrix, atol=1e-14)
    capsys.readouterr()
    assert main(["convert", str(tmp_path / "rig.toml"), "-o", str(tmp_path / "two.txt")]) == ExitCode.OK
    assert "the poses of the rig are not in it" in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "rig.toml"), "-o", str(tmp_path / "cameras.txt"), "--camera", "left"]) == 0
    assert "rigs.txt was there before" in capsys.readouterr().out


@pytest.fixture
def calibrated(tmp_path: Path) -> Path:
    """A camera file that says all that it can."""
    moved = np.zeros((54, 3))
    moved[7] = [1e-5, 0, 3e-4]
    record = CameraRecord(
        {"command": "calib camera photos", "rms_px": 0.17, "holdout_rms_px": 0.19, "views": 12, "converged": True},
        ParameterCovariance(("fx", "fy"), np.array([[0.16, 0.01], [0.01, 0.25]]), np.array([0.9, 0.8])),
        BoardRecord("chessboard:9x6:25mm", "free", moved),
        (("few_tilts", "only 2 of 12 boards are tilted", "tilt the board"),),
    )
    write_camera_toml(tmp_path / "camera.toml", BENT, name="left", record=record)
    return tmp_path / "camera.toml"


def test_a_camera_that_is_only_copied_keeps_how_it_was_calibrated(calibrated: Path, capsys) -> None:
    target = calibrated.with_name("again.toml")
    assert main(["convert", str(calibrated), "-o", str(target), "--camera", "left"]) == ExitCode.OK
    assert target.read_bytes() == calibrated.read_bytes()
    assert "note" not in capsys.readouterr().out


@pytest.mark.parametrize("words", [["-o", "other.toml", "--fit", "OPENCV"], ["-o", "cameras.txt"]], ids=str)
def test_what_is_not_taken_over_of_the_calibration_is_told(calibrated: Path, capsys, monkeypatch, words) -> None:
    monkeypatch.chdir(calibrated.parent)
    assert main(["convert", "camera.toml", *words]) == ExitCode.OK
    told = capsys.readouterr().out.splitlines()[-1]
    assert told == "note: [calibration], [uncertainty], [board], [[finding]] of camera.toml are not in it"
    if words[1].endswith(".toml"):
        assert not read_camera_file(Path(words[1]))[1].facts


def test_a_rig_that_is_only_copied_keeps_its_deviations_and_one_camera_of_it_says_what_it_leaves(
    tmp_path: Path, capsys
) -> None:
    beside = Rigid3.stack([Rigid3.exp(np.array([0.01, -0.3, 0.02, -0.12, 0.001, 0.002])), Rigid3.identity()])
    sigma = MountedSigmas(np.full(12, 0.1), np.full(3, 1e-4), np.full(3, 1e-5))
    rig = CameraRig(("left", "right"), (BENT, BENT), beside, "right")
    write_rig_file(tmp_path / "rig.toml", RigFile(rig, 0.18, (sigma, sigma), {"command": "calib stereo l r"}))
    assert main(["convert", str(tmp_path / "rig.toml"), "-o", str(tmp_path / "again.toml")]) == ExitCode.OK
    assert (tmp_path / "again.toml").read_bytes() == (tmp_path / "rig.toml").read_bytes()
    assert "note" not in capsys.readouterr().out
    assert main(["convert", str(tmp_path / "rig.toml"), "-o", str(tmp_path / "one.toml"), "--camera", "left"]) == 0
    assert "note: [rig.provenance], standard deviations of" in capsys.readouterr().out
