"""Turns of a board that nothing printed on it tells apart.

A chessboard with an even number of columns and rows together looks the same after half a turn, as do grids of circles;
square ones after a quarter, too. Such a board has no first corner: photos of it may be read from one end or the other.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Int64

from calib.boards import Board
from sfm.core.arrays import Points3D, Value
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BoardTurn(Value):
    """A turn after which the board looks the same: point `rows[k]` comes to lie where point k was.

    Attributes:
        motion: `motion @ points3D[k] == points3D[rows[k]]`.
    """

    rows: Int64[np.ndarray, " P"]
    motion: Rigid3


def board_turns(board: Board) -> tuple[BoardTurn, ...]:
    """The turns of a board that nothing printed on it tells apart; the first is none at all."""
    points = np.asarray(board.points3D)
    quarters = (0,) if board.has_markers else (0, 1, 2, 3)
    if board.kind == "chessboard" and sum(board.grid) % 2:
        quarters = (0,)  # black squares at one end, white ones at the other
    turns = (turn_of(points, quarter) for quarter in quarters)
    return tuple(turn for turn in turns if turn is not None)


def turn_of(points: Points3D, quarters: int) -> BoardTurn | None:
    """So many quarters of a turn about the middle; None where points do not come to lie on points."""
    center = np.append((points[:, :2].min(0) + points[:, :2].max(0)) / 2, 0.0)
    turn = Rotation3.exp(np.array([0.0, 0.0, quarters * np.pi / 2]))
    motion = Rigid3(turn, center - turn @ center)
    apart = np.linalg.norm((motion @ points)[:, None, :2] - points[None, :, :2], axis=2)
    rows = apart.argmin(1)
    fits = apart.min(1).max() < 1e-6 * np.ptp(points[:, :2]) and len(set(rows.tolist())) == len(points)
    return BoardTurn(rows.astype(np.int64), motion) if fits else None
