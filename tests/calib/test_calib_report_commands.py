"""`calib report` and `calib view` as commands, from corners that were found before."""

from __future__ import annotations

import json

import numpy as np
import pytest

from calib.boards import aprilgrid
from calib.cli import main
from calib.cli.again import calibrated_again
from calib.cli.scenes import board_lines, camera_scene
from sfm.core.errors import ConfigError, ExitCode
from sfm.core.events import SILENT, Note
from sfm.io.camera_files import read_camera_file, write_camera_toml
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen
from tests.calib.test_calib_camera import BOARD, NAMED, write_corners


@pytest.fixture
def calibrated(sfm, tmp_path, rng):
    """Two files of corners, and the camera file of the first."""
    poses = poses_before(LENS, 20, rng)
    write_corners(tmp_path / "corners.json", LENS, poses[:10], rng)
    write_corners(tmp_path / "other.json", LENS, poses[10:], rng)
    made = sfm("camera", "corners.json", "--model", "opencv", "-o", "c.toml", module="calib")
    assert made.returncode == 0, made.stderr
    return tmp_path


def test_a_report_is_made_from_the_camera_file_and_its_photos(sfm, calibrated):
    made = sfm("report", "c.toml", "corners.json", "-o", "r.html", "--range", "0.5", module="calib")
    assert (made.returncode, made.stdout.strip()) == (0, "r.html"), made.stderr
    assert "another camera" not in made.stderr
    page = (calibrated / "r.html").read_text()
    assert "0.5 m away" in page
    assert page.count("<svg") == 9


def test_other_photos_are_noted(calibrated):
    notes = []
    made, _ = calibrated_again(
        calibrated / "c.toml", [calibrated / "other.json"], NAMED, threads=1,
        observer=lambda event: notes.append(event.message) if isinstance(event, Note) else None,
    )  # fmt: skip
    assert len(notes) == 1
    assert "another camera" in notes[0]
    assert len(made.found.observations) == 10


def test_a_file_without_a_board_asks_for_one(tmp_path):
    write_camera_toml(tmp_path / "bare.toml", LENS)
    with pytest.raises(ConfigError, match="names no board"):
        calibrated_again(tmp_path / "bare.toml", [tmp_path], "", threads=1, observer=SILENT)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("report", "c.toml", "-o", "r.html"), "no photos"),
        (("report", "c.toml", "corners.json", "-o", "r.pdf"), "must end in .html"),
        (("report", "c.toml", "corners.json", "-o", "r.html", "--range", "-1"), "must be positive"),
        (("view", "c.toml"), "no photos"),
        (("view", "c.toml", "corners.json", "--web", "--save", "b.rrd"), "exclude each other"),
    ],
)
def test_wrong_words_are_told_before_any_work(sfm, words, told):
    made = sfm(*words, module="calib")
    assert made.returncode == 2
    assert told in made.stderr


def test_a_view_keeps_its_scene(sfm, calibrated):
    pytest.importorskip("rerun")
    made = sfm("view", "c.toml", "corners.json", "--save", "b.rrd", module="calib")
    assert (made.returncode, made.stdout.strip()) == (0, "b.rrd"), made.stderr
    assert (calibrated / "b.rrd").stat().st_size > 5000


def test_the_scene_has_the_boards_where_the_calibration_has_them(calibrated):
    made, sightings = calibrated_again(
        calibrated / "c.toml", [calibrated / "corners.json"], "", threads=1, observer=SILENT
    )  # fmt: skip
    scene = camera_scene("left", made, sightings.board)
    found = made.found
    for v, (photo,) in enumerate(scene.photos):
        corners = scene.worlds_from_board[v] @ scene.points3D
        rows = found.observations.rows[found.observations.view_of == v]
        projected, _ = found.camera.project(corners[rows])
        np.testing.assert_allclose(projected - photo.points2D, photo.residuals, atol=1e-9)
    lengths = np.linalg.norm(np.diff(BOARD.points3D[scene.lines], axis=1), axis=2)
    np.testing.assert_allclose(lengths, 0.03)


def test_tags_are_drawn_as_squares():
    board = aprilgrid(3, 2, 0.08, 0.02)
    lines = board_lines(board)
    lengths = np.linalg.norm(np.diff(board.points3D[lines], axis=1), axis=2)
    assert len(lines) == 4 * 6
    np.testing.assert_allclose(lengths, 0.08)


@pytest.fixture
def tables(tmp_path, rng, monkeypatch):
    """Tables of corners of a bent board that has no name, and the camera file of the first."""
    poses = poses_before(LENS, 20, rng)
    board = flat_board(8, 6, 0.03)
    bent = board + np.column_stack([np.zeros((48, 2)), 0.02 * np.square(board[:, 0] / 0.1)])
    for name, some in (("one.csv", poses[:12]), ("two.csv", poses[12:])):
        rows = ["image,id,x,y,board_x,board_y"]
        for view in seen(LENS, bent, some, rng):
            places = zip(view.corner_ids.tolist(), (view.points2D - 0.5).tolist(), strict=True)
            rows += [f"{view.name},{k},{x},{y},{board[k, 0]:.6f},{board[k, 1]:.6f}" for k, (x, y) in places]
        (tmp_path / name).write_text("\n".join(rows))
    monkeypatch.chdir(tmp_path)
    made = ["camera", "one.csv", "--size", "1280x960", "--model", "opencv", "--shape", "free", "-o", "c.toml"]
    assert main(made) == 0
    return tmp_path


def test_corners_of_another_program_need_neither_size_nor_board_to_be_shown_and_checked(tables, capsys):
    assert 'spec = "a board of 48 points"' in (tables / "c.toml").read_text()
    made, sightings = calibrated_again(tables / "c.toml", [tables / "one.csv"], "", threads=1, observer=SILENT)
    assert sightings.board is None
    np.testing.assert_allclose(made.found.camera.params, read_camera_file(tables / "c.toml")[0].params, rtol=1e-6)
    assert camera_scene("c", made, sightings.board).lines.shape == (0, 2)
    assert main(["report", "c.toml", "one.csv", "-o", "r.html"]) == 0
    capsys.readouterr()
    # Of this board, which the camera file knows to be bent by 2 cm; taken for flat it would fail by far.
    assert main(["check", "c.toml", "two.csv", "--size", "1280x960", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rms_px"] < 0.25


def test_photos_need_a_board_where_the_file_knows_only_how_many_points_it_has(tables, capsys):
    (tables / "photos").mkdir()
    (tables / "photos" / "a.png").write_bytes(b"")
    assert main(["check", "c.toml", "photos"]) == ExitCode.USAGE
    assert "no board is named" in capsys.readouterr().err
