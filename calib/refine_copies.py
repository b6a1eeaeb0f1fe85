"""Views that say the same twice: the same photo, or one of nothing that has moved.

A copy counts as another photo and makes the camera look certain. One that was saved anew has other pixels, but nearly
the same corners: of photos of six sets nine of ten corners are within 0.08 px at a JPEG quality of 30, and within 0.17
after a reduction by half and back. Of photos of a board that lies still before a camera that stands still the same is
true, and they say as little. The most alike of all photos of eleven sets, of a video at 20 a second, differ by 2.6 px.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from calib.board_turns import BoardTurn
from calib.refine_views import BoardView, RejectedView
from sfm.core.arrays import FloatArray

_NEAR_PX, _MOSTLY = 0.2, 0.9
"""So many of the corners that either view shows are not farther apart."""
_CELL_PX = 1.0
_ASKED = 3


class SeenBefore:
    """Views by where their corners lie.

    Args:
        turns: of the board that nothing printed on it tells apart: a copy may be read from the other end.
    """

    def __init__(self, turns: Sequence[BoardTurn] = ()) -> None:
        self._rows = [turn.rows for turn in turns if np.any(turn.rows != np.arange(len(turn.rows)))]
        self._views: list[BoardView] = []
        self._in_cell: dict[tuple[int, int, int], list[int]] = {}

    def add(self, view: BoardView) -> None:
        """A view that others are compared with."""
        for corner, (x, y) in zip(view.corner_ids.tolist(), _cells(view.points2D), strict=True):
            self._in_cell.setdefault((corner, x, y), []).append(len(self._views))
        self._views.append(view)

    def same(self, view: BoardView) -> tuple[BoardView, float] | None:
        """The first view with nearly the same corners, and by how many px they differ: nine of ten by no more."""
        for ids in [view.corner_ids, *(rows[view.corner_ids] for rows in self._rows if len(view.corner_ids))]:
            for k in self._perhaps(ids, view.points2D):
                other = self._views[k]
                if (view.width, view.height) != (other.width, other.height):
                    continue
                apart = _apart(ids, view.points2D, other)
                if apart <= _NEAR_PX:
                    return other, apart
        return None

    def _perhaps(self, ids: np.ndarray, points2D: FloatArray) -> Iterator[int]:
        """Views that have one of some corners near the same place."""
        found: set[int] = set()
        asked = np.unique(np.linspace(0, len(ids) - 1, _ASKED).astype(int)) if len(ids) else []
        for n in asked:
            ((x, y),) = _cells(points2D[n : n + 1])
            for cell in ((x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)):
                found.update(self._in_cell.get((int(ids[n]), *cell), ()))
        return iter(sorted(found))


def without_copies(views: Sequence[BoardView]) -> tuple[list[BoardView], list[RejectedView]]:
    """The first of views whose corners agree to the last bit, and the others, `copy_of` it."""
    first = dict[bytes, str]()
    kept: list[BoardView] = []
    copies: list[RejectedView] = []
    for view in views:
        key = view.corner_ids.tobytes() + view.points2D.tobytes()
        if key in first:
            copies.append(RejectedView(view.name, f"copy_of {first[key]}"))
        else:
            first[key] = view.name
            kept.append(view)
    return kept, copies


def without_near_copies(
    views: Sequence[BoardView], turns: Sequence[BoardTurn] = ()
) -> tuple[list[BoardView], list[RejectedView]]:
    """The first of photos with the same corners, and the others.

    These are `copy_of` it, where corners agree to the last bit, or `nearly_same_as` it.
    """
    before, first = SeenBefore(turns), dict[bytes, str]()
    kept: list[BoardView] = []
    left_out: list[RejectedView] = []
    for view in views:
        key = view.corner_ids.tobytes() + view.points2D.tobytes()
        same = None if key in first else before.same(view)
        if key in first:
            left_out.append(RejectedView(view.name, f"copy_of {first[key]}"))
        elif same is not None:
            detail = f"nearly the same corners, {same[1]:.2f} px apart: saved anew, or nothing has moved"
            left_out.append(RejectedView(view.name, f"nearly_same_as {same[0].name}", detail))
        else:
            before.add(view)
            kept.append(view)
        first.setdefault(key, view.name if same is None else same[0].name)
    return kept, left_out


def _cells(points2D: FloatArray) -> list[tuple[int, int]]:
    return [(x, y) for x, y in np.floor(points2D / _CELL_PX).astype(int).tolist()]


def _apart(ids: np.ndarray, points2D: FloatArray, other: BoardView) -> float:
    """Distance in px that nine of ten corners keep that either view shows; inf where others are too many."""
    _, mine, theirs = np.intersect1d(ids, other.corner_ids, assume_unique=True, return_indices=True)
    distances = np.sort(np.linalg.norm(points2D[mine] - other.points2D[theirs], axis=1))
    needed = int(np.ceil(_MOSTLY * (len(ids) + len(other.corner_ids) - len(mine))))
    return float(distances[needed - 1]) if 0 < needed <= len(distances) else np.inf
