"""What calibration is given: corners of a board, and where each photo shows them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from sfm.core.arrays import BoolArray, FloatArray, Value, readonly


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BoardView(Value):
    """One photo of a board.

    Attributes:
        width, height: of the photo, px.
        corner_ids: (k,) rows of the board's points.
        points2D: (k, 2) px, the first pixel's centre at (½, ½).
        covariances: (k, 2, 2) px², or None where all corners are equally certain. Only their ratios count for what is
            estimated; the noise is measured.

    Raises:
        ValueError: shapes disagree, a corner is there twice, or something is not finite or not positive definite.
    """

    name: str
    width: int
    height: int
    corner_ids: Int64[np.ndarray, " k"]
    points2D: Float64[np.ndarray, "k 2"]
    covariances: Float64[np.ndarray, "k 2 2"] | None = None

    def __post_init__(self) -> None:
        count = len(self.corner_ids)
        object.__setattr__(self, "corner_ids", readonly(self.corner_ids, (count,), np.int64))
        object.__setattr__(self, "points2D", readonly(self.points2D, (count, 2)))
        if len(set(self.corner_ids.tolist())) < count:
            raise ValueError(f"{self.name}: a corner is there twice")
        if not np.all(np.isfinite(self.points2D)):
            raise ValueError(f"{self.name}: corners must be finite")
        if self.covariances is not None:
            covariances = readonly(self.covariances, (count, 2, 2))
            a, b, d = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
            if not np.all((a > 0) & (d > 0) & (a * d > b * b) & np.isfinite(a * d)):
                raise ValueError(f"{self.name}: covariances must be positive definite")
            object.__setattr__(self, "covariances", covariances)


@dataclasses.dataclass(frozen=True, slots=True)
class RejectedView:
    """A view that is left out, and why."""

    name: str
    reason: str
    detail: str = ""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Observations(Value):
    """Views in flat columns: the corners of view v are rows `offsets[v]:offsets[v + 1]`.

    Attributes:
        board: (P, 3) points of the board, z = 0 before its shape is estimated.
        rows: (n,) board point of each corner.
        points2D: (n, 2) px.
        roots: (n, 3) a, b, c such that (a du + b dv, c dv) is a residual in units of the typical standard deviation of
            a corner, by which all are divided; (1, 0, 1) for equally certain corners.
    """

    names: tuple[str, ...]
    width: int
    height: int
    board: Float64[np.ndarray, "P 3"]
    offsets: Int64[np.ndarray, " V1"]
    rows: Int64[np.ndarray, " n"]
    points2D: Float64[np.ndarray, "n 2"]
    roots: Float64[np.ndarray, "n 3"]

    def __len__(self) -> int:
        """Number of views."""
        return len(self.names)

    @property
    def view_of(self) -> Int64[np.ndarray, " n"]:
        """The view of each corner."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))

    @property
    def shown(self) -> Int64[np.ndarray, " P"]:
        """How many views show each point of the board."""
        return np.bincount(self.rows, minlength=len(self.board))

    def of_views(self, views: Sequence[int]) -> Observations:
        """Only these views, in this order."""
        parts = [np.arange(self.offsets[v], self.offsets[v + 1]) for v in views]
        lengths = [len(part) for part in parts]
        at = np.concatenate([np.zeros(0, np.int64), *parts])
        return dataclasses.replace(
            self,
            names=tuple(self.names[v] for v in views),
            offsets=np.cumsum([0, *lengths], dtype=np.int64),
            rows=self.rows[at],
            points2D=self.points2D[at],
            roots=self.roots[at],
        )

    def of_corners(self, kept: BoolArray) -> Observations:
        """Only the corners (n,) that are kept; views stay, even where nothing is left of them."""
        counts = np.add.reduceat(np.append(kept, False), self.offsets[:-1]) if len(self) else np.zeros(0, np.int64)
        return dataclasses.replace(
            self,
            offsets=np.concatenate([[0], np.cumsum(counts, dtype=np.int64)]),
            rows=self.rows[kept],
            points2D=self.points2D[kept],
            roots=self.roots[kept],
        )


def gather(board: FloatArray, views: Sequence[BoardView]) -> Observations:
    """Views of one image size in flat columns.

    Args:
        board: (P, 3) points of the board.
    Raises:
        ValueError: sizes differ, or a corner is not of the board.
    """
    if len({(view.width, view.height) for view in views}) > 1:
        raise ValueError("views of different sizes")
    points2D = np.concatenate([np.zeros((0, 2)), *(view.points2D for view in views)])
    rows = np.concatenate([np.zeros(0, np.int64), *(view.corner_ids for view in views)])
    if len(rows) and not (rows.min() >= 0 and rows.max() < len(board)):
        raise ValueError(f"corners {rows.min()}..{rows.max()} of a board of {len(board)}")
    return Observations(
        names=tuple(view.name for view in views),
        width=views[0].width if views else 0,
        height=views[0].height if views else 0,
        board=readonly(board, (None, 3)),
        offsets=np.cumsum([0, *(len(view.points2D) for view in views)], dtype=np.int64),
        rows=rows,
        points2D=points2D,
        roots=_roots(views, len(rows)),
    )


def _roots(views: Sequence[BoardView], count: int) -> FloatArray:
    """Upper triangular roots of the inverse covariances, over the root of their median variance."""
    roots = np.zeros((count, 3))
    roots[:, 0] = roots[:, 2] = 1.0
    if all(view.covariances is None for view in views):
        return roots
    unit = [np.tile(np.eye(2), (len(v.points2D), 1, 1)) if v.covariances is None else v.covariances for v in views]
    covariances = np.concatenate(unit)
    a, b, d = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    typical = np.median((a + d) / 2)
    # Information = [[A B] [B D]] = UᵀU with U = [[√A, B/√A] [0, √(D − B²/A)]]; D − B²/A = 1 / d.
    det = a * d - b * b
    roots[:, 0] = np.sqrt(d / det)
    roots[:, 1] = -b / det / roots[:, 0]
    roots[:, 2] = 1 / np.sqrt(d)
    return roots * np.sqrt(typical)
