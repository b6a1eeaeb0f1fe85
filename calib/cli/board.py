"""`calib board`: a board to print."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from calib.cli.parsing import parsed
from sfm.core.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from calib.boards import Board

EXAMPLES = (
    "calib board chessboard --cols 9 --rows 6 --square 25mm -o board.pdf",
    "calib board charuco --cols 8 --rows 6 --square 30mm --marker 22mm -o board.pdf --paper a3",
    "calib board aprilgrid --cols 6 --rows 6 --tag 25mm --gap 7.5mm -o board.svg",
    "calib board acircles:4x11:20mm -o board.pdf",
)

_PITCH = {
    "chessboard": "square",
    "charuco": "square",
    "aprilgrid": "tag",
    "circles": "distance",
    "acircles": "distance",
}
_DETAIL = {"chessboard": "", "charuco": "marker", "aprilgrid": "gap", "circles": "diameter", "acircles": "diameter"}
_NEEDED = ("charuco", "aprilgrid")

Length = Annotated[str, tyro.conf.arg(metavar="LENGTH", help_behavior_hint="")]


@dataclasses.dataclass(frozen=True, kw_only=True)
class BoardOptions:
    """Draws a board at true scale, with a ruler to check the print by, and writes its description beside it as .toml.

    Print at 100 %, glue it to something flat, measure the ruler. If it is off by a factor, correct the lengths in the
    .toml: calibration believes them.
    """

    kind: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="KIND|BOARD", help_behavior_hint="")]
    """chessboard, charuco, aprilgrid, circles (rectangular grid) or acircles (rows shifted by half); or the whole board
    in one word such as chessboard:9x6:25mm."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """board.pdf or board.svg."""

    cols: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="")] = 0
    """Inner corners in a row of a chessboard, squares of a charuco, tags of an aprilgrid, circles in a row."""

    rows: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="")] = 0
    """The same down the page."""

    square: Length = ""
    """Side of a square of a chessboard or charuco, with its unit: 25mm, 2.5cm, 1in."""

    marker: Length = ""
    """Side of the markers of a charuco, less than the square."""

    tag: Length = ""
    """Side of the tags of an aprilgrid."""

    gap: Length = ""
    """Gap between the tags of an aprilgrid; Kalibr's boards have 0.3 of the tag."""

    distance: Length = ""
    """From circle to circle; of acircles from row to row, which is half of that within a row."""

    diameter: Length = ""
    """Of the circles; half of the distance unless given, 0.7 of it for acircles."""

    dictionary: Annotated[str, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = ""
    """OpenCV's name of the set of markers; DICT_5X5_1000 for charuco, DICT_APRILTAG_36h11 for aprilgrid."""

    paper: Annotated[str, tyro.conf.arg(metavar="NAME", help_behavior_hint="(default: the smallest that does)")] = ""
    """a4, a3, a2, a1, a0 or letter, upright or across."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(BoardOptions, "board", words, EXAMPLES)
    suffix = options.output.suffix.lower()
    if suffix not in (".pdf", ".svg"):
        raise ConfigError(f"-o must end in .pdf or .svg, got {options.output}")
    from calib.boards_print import board_pdf, board_svg, lay_out
    from calib.boards_text import board_toml
    from sfm.io.atomic import write_bytes, write_text

    board = _board(options)
    try:
        page = lay_out(board, options.paper)
        drawn = board_pdf(board, page) if suffix == ".pdf" else board_svg(board, page).encode()
    except ValueError as error:
        raise ConfigError(str(error), remedy="choose a larger --paper, or a smaller board") from error
    description = options.output.with_suffix(".toml")
    write_bytes(options.output, drawn)
    write_text(description, board_toml(board))
    print(f"{options.output}: {board.spec} on {1000 * page.width_m:.0f} × {1000 * page.height_m:.0f} mm")
    print(f"{description}: its description, for --board")
    return ExitCode.OK


def _board(options: BoardOptions) -> Board:
    """From one word or from the options."""
    from calib.boards_text import make_board, parse_board, parse_length

    given = {name for name in {*_PITCH.values(), *_DETAIL.values()} - {""} if getattr(options, name)}
    if ":" in options.kind:
        if given or options.cols or options.rows or options.dictionary:
            raise ConfigError(f"{options.kind} says it all: other options of the board have no meaning beside it")
        return parse_board(options.kind)
    if options.kind not in _PITCH:
        raise ConfigError(f"unknown kind of board {options.kind!r}", remedy=f"kinds are {', '.join(_PITCH)}")
    pitch, detail = _PITCH[options.kind], _DETAIL[options.kind]
    if foreign := given - {pitch, detail}:
        raise ConfigError(f"--{min(foreign)} has no meaning for {options.kind}")
    missing = [f"--{name}" for name in ("cols", "rows", pitch) if not getattr(options, name)]
    missing += [f"--{detail}"] if options.kind in _NEEDED and detail not in given else []
    if missing:
        raise ConfigError(f"{options.kind} needs {', '.join(missing)}", remedy=f"for example: {EXAMPLES[0]}")
    detail_m = parse_length(getattr(options, detail)) if detail in given else 0.0
    return make_board(
        options.kind,
        options.cols,
        options.rows,
        parse_length(getattr(options, pitch)),
        detail_m,
        options.dictionary,
    )
