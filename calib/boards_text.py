"""Boards as text: one word on the command line, a table in a file.

    chessboard:9x6:25mm                 inner corners, side of a square
    charuco:8x6:30mm:22mm[:DICT_…]      squares, side of a square, of a marker
    aprilgrid:6x6:88mm:26.4mm[:DICT_…]  tags, side of a tag, gap between tags
    circles:8x10:25mm[:15mm]            circles, their distance, their diameter
    acircles:4x11:20mm[:14mm]           circles in a row, rows, distance of the rows, diameter

Lengths have a unit: mm, cm, m or in.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from typing import Any

from calib.boards import KINDS, Board, aprilgrid, asymmetric_circle_grid, charuco, chessboard, circle_grid
from calib.boards_artwork import dictionary_names, marker_dictionary, markers_of
from sfm.core.errors import ConfigError

UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}

_EXAMPLE = "for example chessboard:9x6:25mm (inner corners, side of a square)"
_LENGTHS = {
    "chessboard": ("square_m", ""),
    "charuco": ("square_m", "marker_m"),
    "aprilgrid": ("tag_m", "gap_m"),
    "circles": ("distance_m", "diameter_m"),
    "acircles": ("row_distance_m", "diameter_m"),
}
"""What the two lengths of a kind are called."""
_MAKERS = {
    "chessboard": lambda columns, rows, pitch, detail, dictionary: chessboard(columns, rows, pitch),
    "charuco": charuco,
    "aprilgrid": aprilgrid,
    "circles": lambda columns, rows, pitch, detail, dictionary: circle_grid(columns, rows, pitch, detail),
    "acircles": lambda columns, rows, pitch, detail, dictionary: asymmetric_circle_grid(columns, rows, pitch, detail),
}


def make_board(
    kind: str, columns: int, rows: int, pitch_m: float, detail_m: float = 0.0, dictionary: str = ""
) -> Board:
    """A board of any kind; the meaning of the numbers is that of `Board`.

    Raises:
        ConfigError: the kind is unknown, a number is out of its range, or the set of markers is unknown or too small.
    """
    if kind not in KINDS:
        raise ConfigError(f"unknown kind of board {kind!r}", remedy=f"kinds are {', '.join(KINDS)}")
    if dictionary and not dictionary.startswith("DICT_"):
        dictionary = f"DICT_{dictionary}"
    try:
        board = _MAKERS[kind](columns, rows, pitch_m, detail_m, dictionary)
    except ValueError as error:
        raise ConfigError(f"{kind}: {error}") from error
    _check_markers(board)
    return board


def _check_markers(board: Board) -> None:
    """Raises ConfigError where a board has markers that there are not."""
    needed = markers_of(board)
    if not needed:
        return
    told = f"{board.kind} of {board.columns}x{board.rows} has {needed} markers"
    enough = dictionary_names(needed)
    if not enough:
        raise ConfigError(f"{told}, more than any set of markers", remedy="choose fewer columns and rows")
    try:
        count = len(marker_dictionary(board.dictionary).bytesList)
    except ValueError as error:
        near = difflib.get_close_matches(board.dictionary, enough, n=3)
        raise ConfigError(
            f"{board.kind}: unknown set of markers {board.dictionary!r}",
            remedy=f"{'perhaps' if near else 'known are'} {', '.join(near or enough)}",
        ) from error
    if count < needed:
        family = board.dictionary.rpartition("_")[0]
        like = [name for name in enough if name.rpartition("_")[0] == family] or enough
        raise ConfigError(f"{told}, {board.dictionary} has {count}", remedy=f"{' or '.join(like)} would do")


def parse_length(text: str) -> float:
    """Metres of `25mm`, `2.5cm`, `0.025m` or `1in`.

    Raises:
        ConfigError: it is no length, or has no unit.
    """
    found = re.fullmatch(r"\s*([0-9]*\.?[0-9]+(?:[eE][-+]?[0-9]+)?)\s*(mm|cm|m|in)\s*", text)
    if not found:
        raise ConfigError(
            f"{text!r} is no length", remedy="give a number with its unit, as in 25mm, 2.5cm, 0.025m, 1in"
        )
    return float(found[1]) * UNITS_M[found[2]]


def parse_board(text: str) -> Board:
    """The board that one word describes, e.g. `chessboard:9x6:25mm`.

    Raises:
        ConfigError: it does not describe one.
    """
    kind, *words = text.strip().split(":")
    if kind not in KINDS or not words:
        raise ConfigError(f"{text!r} is no board", remedy=_EXAMPLE)
    size = re.fullmatch(r"(\d+)x(\d+)", words[0].lower())
    if not size:
        raise ConfigError(f"{text!r}: expected COLUMNSxROWS after the kind, got {words[0]!r}", remedy=_EXAMPLE)
    names = [word for word in words[1:] if not word[:1].isdigit() and not word.startswith(".")]
    lengths = [parse_length(word) for word in words[1:] if word not in names]
    needed = 2 if kind in ("charuco", "aprilgrid") else 1
    most = 1 if kind == "chessboard" else 2
    if not needed <= len(lengths) <= most:
        what = " and ".join(filter(None, _LENGTHS[kind]))
        raise ConfigError(f"{text!r}: expected {what.replace('_m', '').replace('_', ' ')}", remedy=_EXAMPLE)
    if len(names) > (kind in ("charuco", "aprilgrid")):
        raise ConfigError(f"{text!r}: {names[-1]!r} has no meaning there", remedy=_EXAMPLE)
    pitch, detail = (lengths + [0.0])[:2]
    return make_board(kind, int(size[1]), int(size[2]), pitch, detail, names[0] if names else "")


def board_toml(board: Board) -> str:
    """The table [board] that `parse_board_toml` reads; every number reads back as it is."""
    pitch, detail = _LENGTHS[board.kind]
    lines = [
        "[board]",
        f'kind = "{board.kind}"',
        f"columns = {board.columns}",
        f"rows = {board.rows}",
        f"{pitch} = {board.pitch_m!r}",
        *([f"{detail} = {board.detail_m!r}"] if detail else []),
        *([f'dictionary = "{board.dictionary}"'] if board.dictionary else []),
    ]
    return "\n".join(lines) + "\n"


def parse_board_toml(text: str) -> Board:
    """The board of a `board.toml`.

    Raises:
        ConfigError: it is no TOML, or a key is unknown, missing or out of its range.
    """
    try:
        table = tomllib.loads(text).get("board")
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"is no TOML: {error}") from error
    if not isinstance(table, dict):
        raise ConfigError("has no table [board]")
    kind = table.get("kind")
    if kind not in KINDS:
        raise ConfigError(f"[board] has the kind {kind!r}", remedy=f"kinds are {', '.join(KINDS)}")
    pitch, detail = _LENGTHS[kind]
    _check_keys(table, {"kind": str, "columns": int, "rows": int, pitch: float} | ({detail: float} if detail else {}))
    return make_board(
        kind, table["columns"], table["rows"], table[pitch], table.get(detail, 0.0), table.get("dictionary", "")
    )


def _check_keys(table: dict[str, Any], required: dict[str, type]) -> None:
    unknown = set(table) - set(required) - {"dictionary"}
    if unknown:
        raise ConfigError(f"[board] has an unknown key {min(unknown)!r}; known are {', '.join(required)}, dictionary")
    for key, kind in required.items():
        fits = type(table.get(key)) in ((int, float) if kind is float else (kind,))
        if not fits:
            raise ConfigError(f"[board] needs {key} ({kind.__name__}), got {table.get(key)!r}")
    if not isinstance(table.get("dictionary", ""), str):
        raise ConfigError(f"[board] dictionary must be text, got {table['dictionary']!r}")
