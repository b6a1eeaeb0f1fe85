"""Why photos do not give a camera, in words that help."""

from __future__ import annotations

import dataclasses
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from calib.board_extent import size_that_is_shown
from calib.cli.other_boards import board_that_is_shown
from calib.cli.photos import find_photos, photos_of
from calib.cli.sightings import Sightings
from calib.diagnose import Finding
from sfm.core.errors import InputError, ReconstructionError, Rejected, SfmError

_NAMED = 3
_LOOKED_AT = 8
"""Photos in which the board's size is made sure of."""
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
    """What is to be said if the photos show a chessboard of another size than the one that was found in them.

    Raises:
        InputError: that is certain.
    """
    if seen.board is None or seen.board.kind != "chessboard" or seen.kind != "photos":
        return None
    some = seen.views[:: max(1, -(-len(seen.views) // _LOOKED_AT))]
    photos, views = photos_of(sources, [view.name for view in some], gray=True), {view.name: view for view in some}
    shown = size_that_is_shown(seen.board, [(photo, views[name]) for name, photo in photos.items()])
    if shown is None:
        return None
    named = f"{seen.board.columns}x{seen.board.rows}"
    told = (
        f"{shown.count} of {shown.total} photos show a board of {shown.columns}x{shown.rows} inner corners, not {named}"
    )
    other = dataclasses.replace(seen.board, columns=shown.columns, rows=shown.rows)
    if shown.is_certain:
        raise InputError(told, path=sources[0] if len(sources) == 1 else None, remedy=f"try --board {other.spec}")
    return Finding(
        "other_board", told, f"look at the corners with `calib detect --overlays`, or try --board {other.spec}"
    )


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
        other = board_that_is_shown(find_photos(sources), seen.board)
        if other is not None:
            own, named = (f"{board.columns}x{board.rows}" for board in (other, seen.board))
            counted = COUNTED[other.kind]
            return f"the photos show {own} {counted}, you named {named}: try --board {other.spec}"
    return "check --board, and look at what is seen with `calib detect --overlays`"
