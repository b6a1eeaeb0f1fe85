"""Files of corners: what they say wrongly is told with the file and the row, before anything is calibrated."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest

from calib.boards import chessboard
from calib.boards_text import board_toml, parse_board_toml
from calib.cli import corner_tables
from calib.cli.corner_files import corner_files, read_corners
from calib.cli.photos import detection_json
from calib.detect import Detection
from sfm.core.errors import FormatError, InputError, SfmError

BOARD = chessboard(3, 3, 0.03)
SIZE = (640, 480)
PIXELS = 100 + 1000 * BOARD.points3D[:, :2]
HEADER = "image,id,x,y,board_x,board_y,board_z"


def document_of(board=BOARD):
    """What `calib detect -o` writes of one photo."""
    seen = Detection("a.png", *SIZE, np.arange(9), PIXELS, np.tile(np.eye(2), (9, 1, 1)))
    return {"board": board.spec, "points3D": board.points3D.tolist(), "pixel_center": 0.5,
            "images": {"a.png": detection_json(seen)}}  # fmt: skip


def read_json(folder, document, board=None):
    (folder / "c.json").write_text(json.dumps(document))
    return read_corners({"c.json": folder / "c.json"}, board, None)


def table_of(*images):
    """Rows of some photos, one corner of each after the other."""
    rows = [HEADER]
    for corner, ((x, y), place) in enumerate(zip(PIXELS.tolist(), BOARD.points3D.tolist(), strict=True)):
        rows += [f"{image},{corner},{x},{y},{place[0]},{place[1]},{place[2]}" for image in images]
    return rows


def read_csv(folder, rows, board=None):
    (folder / "c.csv").write_text("\n".join(rows))
    return read_corners({"c.csv": folder / "c.csv"}, board, SIZE)


@pytest.mark.parametrize("length", ["0.017779999999999997", "0.03333333333333333"])
def test_a_board_that_differs_in_the_last_digit_only_is_the_same(tmp_path, length):
    board = parse_board_toml(f"[board]\nkind = 'chessboard'\ncolumns = 3\nrows = 3\nsquare_m = {length}\n")
    assert parse_board_toml(board_toml(board)).spec == board.spec
    _, points3D, views, _ = read_json(tmp_path, document_of(board), board)
    np.testing.assert_array_equal(points3D, board.points3D)
    assert len(views) == 1


def test_a_board_that_is_larger_by_a_millionth_is_another(tmp_path):
    with pytest.raises(InputError, match="its corners are of"):
        read_json(tmp_path, document_of(), chessboard(3, 3, 0.03 * (1 + 1e-6)))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"width": 0}, "a.png: width must be a whole number of px, got 0"),
        ({"height": -480}, "a.png: height must be"),
        ({"width": "1280"}, "a.png: width must be a whole number of px, got '1280'"),
        ({"width": 1280.5}, "a.png: width must be a whole number of px, got 1280.5"),
        ({"width": 120}, "corners of a.png lie outside of 120x480"),
        ({"corner_ids": [0, 1, 2, 3, 4, 5, 6, 7, 9]}, "a.png: 9 is no corner of a board of 9"),
        ({"corner_ids": [0.5, 1, 2, 3, 4, 5, 6, 7, 8]}, "a.png: 0.5 is no corner"),
        ({"points2D": [[float("nan"), 3]] + PIXELS[1:].tolist()}, "a.png: corners must be finite"),
        ({"points2D": [[1, 2]]}, "is not what `calib detect -o` writes"),
    ],
    ids=str,
)  # fmt: skip
def test_a_photo_that_cannot_be_is_refused_by_its_name(tmp_path, change, told):
    document = document_of()
    document["images"]["a.png"] |= change
    with pytest.raises(InputError) as error:
        read_json(tmp_path, document)
    assert told in str(error.value)
    assert "c.json" in str(error.value)


@pytest.mark.parametrize("point", [[0.0, 0.0, 0.001], [float("nan"), 0.0, 0.0], [0.0, float("inf"), 0.0]], ids=str)
def test_points_that_are_not_of_a_flat_board_are_refused_by_their_number(tmp_path, point):
    document = copy.deepcopy(document_of())
    document["points3D"][4] = point
    with pytest.raises(FormatError, match=r"c\.json.*points3D: 4 must be"):
        read_json(tmp_path, document)


@pytest.mark.parametrize("board", ["foo:1x2", "charuco:8x6:30mm:22mm:DICT_FOO"])
def test_a_file_of_a_board_that_is_none_is_named(tmp_path, board):
    with pytest.raises(FormatError, match=r"c\.json.*names no board"):
        read_json(tmp_path, document_of() | {"board": board})


@pytest.mark.parametrize(
    ("row", "told"),
    [
        ("a,4,130,130,0.03,0.03,0.01", "row 3: board_z must be 0, got 0.01"),
        ("a,4,130,130,nan,0.03,0", "row 3: board_x must be finite, got nan"),
        ("a,4,inf,130,0.03,0.03,0", "row 3: x must be finite"),
        ("a,-1,130,130,0.03,0.03,0", "row 3: corner -1"),
        ("a,1000000000,130,130,0.03,0.03,0", "row 3: corner 1000000000"),
        ("a,4.5,130,130,0.03,0.03,0", "row 3: invalid literal"),
        ("a,4,130,130", "row 3: 4 cells for 7 columns"),
        ("b,0,130,130,0.03,0.03,0", "row 2: corner 0 lies at (0 0 0) mm"),
        ("a,4,700,130,0.03,0.03,0", "corners of a lie outside of 640x480"),
    ],
)
def test_a_row_that_cannot_be_is_told_by_its_number(tmp_path, row, told):
    with pytest.raises(InputError) as error:
        read_csv(tmp_path, [HEADER, "a,0,100,100,0,0,0", row])
    assert told in str(error.value)
    assert "c.csv" in str(error.value)


def test_a_row_of_a_table_of_mrcal_that_is_no_corner_is_told_by_its_number(tmp_path):
    lines = ["# filename x y level", *(f"a.png {x} {y} 0" for x, y in PIXELS)]
    for wrong in ("a.png nan 3 0", "a.png 7"):
        (tmp_path / "c.vnl").write_text("\n".join([*lines[:5], wrong, *lines[6:]]))
        with pytest.raises(FormatError, match="row 6"):
            read_corners({"c.vnl": tmp_path / "c.vnl"}, BOARD, SIZE)


def test_a_mistake_is_told_of_the_file_that_has_it(tmp_path):
    (tmp_path / "1.csv").write_text("id,x,y\n0,1,1\n1,9,9\n")
    (tmp_path / "2.csv").write_text("id,x,y\n0,1,1\n20,9,9\n")
    with pytest.raises(InputError, match=r"2\.csv.*row 3: corner 20 of a board of 9"):
        read_corners(corner_files([tmp_path]), BOARD, SIZE)


def test_files_of_one_name_from_two_folders_are_refused(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "1.csv").write_text("id,x,y\n0,1,1\n")
    with pytest.raises(InputError, match=r"1\.csv is there twice"):
        corner_files([tmp_path / "a", tmp_path / "b"])


def test_rows_are_looked_at_a_few_times_however_many_photos_there_are(tmp_path, monkeypatch):
    looked = []

    class Watched(corner_tables.Row):
        def __getattribute__(self, name):
            if name == "image":
                looked.append(name)
            return super().__getattribute__(name)

    monkeypatch.setattr(corner_tables, "Row", Watched)
    images = [f"{k}.png" for k in range(40)]
    _, points3D, views, _ = read_csv(tmp_path, table_of(*images))
    assert [view.name for view in views] == images
    assert all(np.array_equal(view.points2D, PIXELS + 0.5) for view in views)
    np.testing.assert_array_equal(points3D, BOARD.points3D)
    assert len(looked) <= 2 * 9 * 40


def test_every_mistake_is_one_of_the_file(tmp_path):
    for text in ("", "[1]", "{}", '{"board": 5}', '{"board": "chessboard:3x3:30mm", "points3D": 7, "images": {}}'):
        (tmp_path / "c.json").write_text(text)
        with pytest.raises(SfmError, match=r"c\.json"):
            read_corners({"c.json": tmp_path / "c.json"}, None, None)
