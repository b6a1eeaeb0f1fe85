"""Why photos do not give a camera, in words that help."""

from __future__ import annotations

import dataclasses
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from calib.board_extent import size_that_is_shown
from calib.boards import Board
from calib.cli.marker_refusals import marker_words, shown_marker_size, unseen_line
from calib.cli.other_boards import board_that_is_shown
from calib.cli.photos import find_photos, photos_of
from calib.cli.sightings import Sightings
from calib.diagnose import Finding
from calib.refine_views import BoardView
from sfm.core.arrays import ImageU8
from sfm.core.errors import InputError, ReconstructionError, Rejected, SfmError

_NAMED = 3
_LOOKED_AT, _FEWEST_LOOKED_AT = 8, 3
"""Photos in which the board's size is made sure of, and of each of several cameras."""
COUNTED = {
    "chessboard": "inner corners", "charuco": "squares", "aprilgrid": "tags", "circles": "circles",
    "acircles": "circles",
}  # fmt: skip
"""What columns and rows of a board count."""
_WRONG_BOARD = ("no_board", "too_few_corners", "not_this_board")
_REMEDIES = {
    "too_few_views": "take 15 to 30 photos of the board, tilted by 15° to 45° about both axes",
    "undetermined_focal": "add photos of the board tilted by 15° to 45° about both axes, or give --focal",
    "no_solution": "look at the corners with `calib detect --overlays`, and try another --model",
    "no_lens": "look at the corners with `calib detect --overlays`",
}


def no_camera(seen: Sightings, why: Rejected, sources: Sequence[Path]) -> SfmError:
    """The error for photos that give no camera."""
    path = sources[0] if len(sources) == 1 else None
    if not seen.views:
        return no_board(seen, sources)
    told = f"no camera from {len(seen.views)} views: {why.reason}: {why.detail}"
    if seen.left_out:
        told += f"; {len(seen.left_out)} of {seen.count} {seen.kind} show no board ({_counted(seen)})"
    reason = why.detail.split(":")[0] if why.reason == "no_lens" else why.reason
    remedy = _REMEDIES.get(reason, _REMEDIES["no_lens"])
    if "not_this_board" in why.detail or sum(view.reason in _WRONG_BOARD for view in seen.left_out) > len(seen.views):
        remedy = _check_the_board(seen, sources)
    return ReconstructionError(told, path=path, remedy=remedy)


def no_board(seen: Sightings, sources: Sequence[Path]) -> SfmError:
    """The error for photos that show no board."""
    path = sources[0] if len(sources) == 1 else None
    spec = seen.board.spec if seen.board is not None else "the board"
    return InputError(
        f"none of {seen.count} {seen.kind} shows {spec} ({_counted(seen)})",
        path=path,
        remedy=_check_the_board(seen, sources),
    )


def shown_size(seen: Sightings, sources: Sequence[Path]) -> Finding | None:
    """What is to be said if the photos show a board of another size than the one that was found in them.

    Raises:
        InputError: that is certain.
    """
    return shown_size_of_all({"": seen}, {"": sources})


def shown_size_of_all(seen: Mapping[str, Sightings], sources: Mapping[str, Sequence[Path]]) -> Finding | None:
    """The same of several cameras, which see the same board.

    Raises:
        InputError: that is certain.
    """
    board = next((one.board for one in seen.values()), None)
    if board is None or any(one.kind != "photos" for one in seen.values()):
        return None
    each = max(_FEWEST_LOOKED_AT, _LOOKED_AT // len(seen))
    looked_at = [pair for name, one in seen.items() for pair in _some_photos(one, sources[name], each)]
    if board.has_markers:
        return _other_markers(board, looked_at) or _unseen_line(board, [v for one in seen.values() for v in one.views])
    shown = size_that_is_shown(board, looked_at)
    if shown is None:
        return None
    counted, named = COUNTED[board.kind], f"{board.columns}x{board.rows}"
    told = f"{shown.count} of {shown.total} photos show a board of {shown.columns}x{shown.rows} {counted}, not {named}"
    other = dataclasses.replace(board, columns=shown.columns, rows=shown.rows)
    if shown.is_certain:
        folders = [path for paths in sources.values() for path in paths]
        raise InputError(told, path=folders[0] if len(folders) == 1 else None, remedy=f"try --board {other.spec}")
    return Finding(
        "other_board", told, f"look at the corners with `calib detect --overlays`, or try --board {other.spec}"
    )


def _other_markers(board: Board, photos: Sequence[tuple[ImageU8, BoardView]]) -> Finding | None:
    side = shown_marker_size(board, photos)
    if side is None:
        return None
    length, count = side
    other = dataclasses.replace(board, detail_m=round(length, 4))
    return Finding(
        "other_board",
        f"{count} photos show markers of {1000 * length:.1f} mm, you named {1000 * board.detail_m:g} mm: corners are "
        "lost by it",
        f"measure them by the squares of {1000 * board.pitch_m:g} mm, and try --board {other.spec}",
    )


def _unseen_line(board: Board, views: Sequence[BoardView]) -> Finding | None:
    other = unseen_line(board, views)
    if other is None:
        return None
    line = "row" if other.rows < board.rows else "column"
    return Finding(
        "other_board",
        f"no photo shows a corner of the last {line} of squares, though most show those next to it",
        f"count the squares ({board.columns}x{board.rows} were named), and try --board {other.spec}",
    )


def _some_photos(seen: Sightings, sources: Sequence[Path], count: int) -> list[tuple[ImageU8, BoardView]]:
    some = seen.views[:: max(1, -(-len(seen.views) // count))]
    photos = photos_of(sources, [view.name for view in some], gray=True)
    return [(photos[view.name], view) for view in some if view.name in photos]


def no_check(seen: Sightings, why: Rejected, sources: Sequence[Path]) -> SfmError:
    """The error for photos that say nothing of a camera."""
    if not seen.views:
        return no_board(seen, sources)
    path = sources[0] if len(sources) == 1 else None
    remedy = "check that the photos come from this camera, uncropped, and show this board"
    return InputError(f"says nothing of the camera: {why.reason}: {why.detail}", path=path, remedy=remedy)


def _counted(seen: Sightings) -> str:
    counted = Counter(view.reason for view in seen.left_out)
    if len(seen.left_out) <= _NAMED:
        return ", ".join(f"{view.name}: {view.reason}" for view in seen.left_out)
    return ", ".join(f"{count} {reason}" for reason, count in counted.items())


def _check_the_board(seen: Sightings, sources: Sequence[Path]) -> str:
    """What the photos show, if it is nearly what was named."""
    if seen.board is not None and seen.kind == "photos":
        print("looking whether the photos show another board", file=sys.stderr)
        photos = find_photos(sources)
        if seen.board.has_markers and (told := marker_words(list(photos.values()), seen.board)):
            return told
        other = board_that_is_shown(photos, seen.board)
        if other is not None:
            own, named = (f"{board.columns}x{board.rows}" for board in (other, seen.board))
            counted = COUNTED[other.kind]
            return f"the photos show {own} {counted}, you named {named}: try --board {other.spec}"
    return "check --board, and look at what is seen with `calib detect --overlays`"
