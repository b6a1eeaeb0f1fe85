from __future__ import annotations

import pickle
import re
import xml.etree.ElementTree as ElementTree
import zlib

import numpy as np
import pytest

from calib.boards import aprilgrid, asymmetric_circle_grid, charuco, chessboard, circle_grid
from calib.boards_artwork import artwork
from calib.boards_print import FOOTER_M, PAGE_MARGIN_M, board_pdf, board_svg, lay_out
from calib.boards_text import board_toml, parse_board, parse_board_toml, parse_length
from sfm.core.errors import ConfigError

BOARDS = [
    chessboard(9, 6, 0.025),
    charuco(8, 6, 0.03, 0.022),
    charuco(5, 7, 0.03, 0.02, "DICT_4X4_50"),
    aprilgrid(6, 5, 0.02, 0.006),
    circle_grid(8, 10, 0.02, 0.012),
    asymmetric_circle_grid(4, 11, 0.02),
]
every_board = pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.spec)


def fields(board):
    return board.kind, board.columns, board.rows, board.pitch_m, board.detail_m, board.dictionary


@every_board
def test_a_board_reads_back_from_its_word_and_its_file(board):
    assert fields(parse_board_toml(board_toml(board))) == fields(board)
    word = parse_board(board.spec)
    assert fields(word)[:3] == fields(board)[:3]
    np.testing.assert_allclose(word.points3D, board.points3D, atol=1e-12)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(board)).points3D, board.points3D)


def test_corners_lie_where_the_conventions_say():
    np.testing.assert_allclose(chessboard(9, 6, 0.025).points3D[[1, 9]], [[0.025, 0, 0], [0, 0.025, 0]])
    np.testing.assert_allclose(aprilgrid(6, 6, 0.088, 0.0264).points3D[6 * 4 + 2], [0.088, 0.2024, 0])  # a Kalibr board
    np.testing.assert_allclose(asymmetric_circle_grid(4, 11, 0.02).points3D[[1, 4]], [[0.04, 0, 0], [0.02, 0.02, 0]])


@pytest.mark.parametrize(
    "word",
    ["chessboard", "chessboard:9x6", "chessboard:9x6:25", "chess:9x6:25mm", "chessboard:9x6:25mm:3mm",
     "chessboard:2x6:1mm",
     "charuco:8x6:30mm", "charuco:8x6:30mm:31mm", "circles:8x10:25mm:26mm", "chessboard:9x6:25mm:DICT_4X4_50",
     "a:b:c"],
)  # fmt: skip
def test_a_word_that_is_no_board_is_an_error_of_configuration(word):
    with pytest.raises(ConfigError):
        parse_board(word)


@pytest.mark.parametrize(
    "text",
    ["x = ", "[plank]", "[board]\nkind = 'x'", "[board]\nkind = 'chessboard'\ncolumns = 9\nrows = 6",
     "[board]\nkind = 'chessboard'\ncolumns = 9\nrows = 6\nsquare_m = 0.02\ncolour = 1"],
)  # fmt: skip
def test_a_file_that_is_no_board_is_an_error_of_configuration(text):
    with pytest.raises(ConfigError):
        parse_board_toml(text)


@pytest.mark.parametrize(
    ("word", "cause", "remedy"),
    [
        ("charuco:8x6:30mm:22mm:DICT_5X5_10", "unknown set of markers 'DICT_5X5_10'", "DICT_5X5_100"),
        ("charuco:8x6:30mm:22mm:FOO", "unknown set of markers 'DICT_FOO'", "DICT_4X4_100"),
        ("charuco:12x10:30mm:22mm:DICT_4X4_50", "has 60 markers, DICT_4X4_50 has 50",
         "DICT_4X4_100 or DICT_4X4_1000 or DICT_4X4_250 would do"),
        ("aprilgrid:7x6:30mm:9mm:DICT_APRILTAG_16h5", "has 42 markers, DICT_APRILTAG_16h5 has 30",
         "DICT_APRILTAG_36h10 or DICT_APRILTAG_36h11 would do"),
        ("charuco:80x60:30mm:22mm", "more than any set", "fewer columns and rows"),
    ],
)  # fmt: skip
def test_markers_that_there_are_not_are_told_with_those_that_would_do(word, cause, remedy):
    with pytest.raises(ConfigError) as error:
        parse_board(word)
    assert cause in error.value.cause
    assert remedy in error.value.remedy


def test_the_last_marker_of_a_set_may_be_used():
    assert parse_board("charuco:10x10:30mm:22mm:DICT_4X4_50").dictionary == "DICT_4X4_50"
    assert parse_board("aprilgrid:6x5:30mm:9mm:DICT_APRILTAG_16H5").dictionary == "DICT_APRILTAG_16H5"


def test_lengths_need_a_unit():
    assert [parse_length(text) for text in ("25mm", "2.5 cm", ".025m", "1in")] == [0.025, 0.025, 0.025, 0.0254]
    with pytest.raises(ConfigError, match="unit"):
        parse_length("25")


def test_the_usual_chessboard_fits_on_a4():
    page = lay_out(chessboard(9, 6, 0.025))
    assert (page.width_m, page.height_m) == (0.297, 0.210)


def test_a_board_that_is_too_large_for_the_paper_is_refused():
    with pytest.raises(ValueError, match="more than a4"):
        lay_out(chessboard(20, 20, 0.025), "a4")


def pdf_rectangles(document: bytes) -> tuple[np.ndarray, np.ndarray, str]:
    """Rectangles in points from the lower left of the paper with their grey, read like a viewer; and the media box."""
    start = document.index(b"stream\n") + 7
    length = int(re.search(rb"/Length (\d+)", document)[1])
    box = np.array(re.search(rb"/MediaBox \[([^]]+)\]", document)[1].split(), float)
    content = zlib.decompress(document[start : start + length]).decode("latin-1")
    matrix, stack, grey, found = np.eye(3), [], 0.0, []
    for line in content.splitlines():
        words = line.split()
        match words[-1]:
            case "cm":
                a, b, c, d, e, f = map(float, words[:6])
                matrix = np.array([[a, b, 0], [c, d, 0], [e, f, 1]]) @ matrix
            case "q":
                stack.append(matrix)
            case "Q":
                matrix = stack.pop()
            case "g":
                grey = float(words[0])
            case "f" if words[4] == "re":
                x, y, w, h = map(float, words[:4])
                (left, bottom, _), (right, top, _) = np.array([[x, y + h, 1], [x + w, y, 1]]) @ matrix
                found.append((left, bottom, right, top, grey))
    return np.array(found).reshape(-1, 5), box, content


@every_board
def test_the_pdf_has_the_artwork_at_true_scale(board):
    page, drawn = lay_out(board), artwork(board)
    document = board_pdf(board, page)
    found, box, content = pdf_rectangles(document)
    per_m = 72 / 0.0254
    np.testing.assert_allclose(box, [0, 0, page.width_m * per_m, page.height_m * per_m], rtol=1e-8)
    count = len(drawn.black) + len(drawn.white)
    x, y, w, h = np.concatenate([drawn.black, drawn.white]).T
    left, top = page.left_m + x, page.height_m - page.top_m - y
    expected = np.column_stack([left, top - h, left + w, top]) * per_m
    np.testing.assert_allclose(found[:count, :4], expected, atol=1e-4)
    np.testing.assert_array_equal(found[:count, 4], [0] * len(drawn.black) + [1] * len(drawn.white))
    assert content.count(" c ") == 4 * len(drawn.circles)
    assert b"/PrintScaling /None" in document
    for number, place in enumerate(re.findall(rb"(\d{10}) 00000 n", document), 1):
        assert document[int(place) :].startswith(b"%d 0 obj" % number)


def test_the_ruler_of_the_pdf_is_as_long_as_it_says():
    board = chessboard(9, 6, 0.025)
    page = lay_out(board)
    found, _, content = pdf_rectangles(board_pdf(board, page))
    ruler = found[len(artwork(board).black) :, :4] * 0.0254 / 72
    said = float(re.search(r"this ruler is (\d+) mm", content)[1]) / 1000
    assert said == page.ruler_m == 0.2
    np.testing.assert_allclose(ruler[0, 2] - ruler[0, 0], said, atol=1e-7)
    ticks = (ruler[1:, 0] + ruler[1:, 2]) / 2
    np.testing.assert_allclose(np.diff(ticks), 1e-3, atol=1e-7)


@every_board
def test_the_svg_has_the_artwork_in_millimetres(board):
    page, drawn = lay_out(board), artwork(board)
    root = ElementTree.fromstring(board_svg(board, page))
    assert root.get("width") == f"{1000 * page.width_m:g}mm"
    space = "{http://www.w3.org/2000/svg}"
    group = next(g for g in root.iter(f"{space}g") if g.get("id") == "board")
    boxes = [[float(r.get(key)) for key in ("x", "y", "width", "height")] for r in group.iter(f"{space}rect")]
    expected = 1000 * np.concatenate([drawn.black, drawn.white])
    np.testing.assert_allclose(np.reshape(boxes, (-1, 4)), expected, atol=1e-6)
    circles = [[float(c.get(key)) for key in ("cx", "cy", "r")] for c in group.iter(f"{space}circle")]
    np.testing.assert_allclose(np.reshape(circles, (-1, 3)), 1000 * drawn.circles, atol=1e-6)


@every_board
def test_corners_of_the_artwork_are_the_boards_up_to_its_frame(board):
    drawn = artwork(board)
    y = -1 if board.kind == "aprilgrid" else 1
    np.testing.assert_allclose(drawn.corners - drawn.corners[0], board.points3D[:, :2] * [1, y], atol=1e-12)
    page = lay_out(board)
    assert page.left_m >= PAGE_MARGIN_M - 1e-9
    assert page.top_m + drawn.height_m <= page.height_m - PAGE_MARGIN_M - FOOTER_M + 1e-9


def test_lengths_that_are_left_to_the_board_are_written_as_a_person_would(tmp_path):
    text = board_toml(asymmetric_circle_grid(4, 11, 0.02))
    assert "diameter_m = 0.014\n" in text
