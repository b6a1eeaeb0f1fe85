"""From which end each view reads a board that looks the same after a turn.

To a flat board it does not matter. A board of any other shape is another one when it is read from the other end: with
some views read that way its shape averages out, and the rest of it bends the camera. So the views are compared before
a shape is estimated. First what turns leave alone of the shape is fitted, which is the same however views are read;
then the choice of turns is sought by what each view says of the camera and of the shape (`refine_ends`), with a prior:
boards are nearly flat.

What is compared of a board of which every point may move is what is smooth of its shape: polynomials in x and y. That
is what bends have in common, some forty numbers for a board of any size, and by them views agree at least as well as by
all of its points.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from calib.board_turns import BoardTurn
from calib.refine_board import BoardShape, smooth_shape
from calib.refine_ends import Quadratics, most_likely_turns
from calib.refine_fit import Fit, solve_from_start
from calib.refine_reject import spread_of
from calib.refine_system import CalibrationSystem, Estimate
from calib.refine_views import Observations
from calib.zhang import Homographies
from sfm.core.arrays import FloatArray, Value
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3

_BEND = 0.03
"""Standard deviation of a corner's place, by the distance to the nearest one, that is expected of boards."""
_ALIKE = 1e-6
"""Difference of entries of orthonormal matrices that is a rounding error."""
_RIDGE = 1e-9
"""Of the diagonal, for coefficients that nothing determines."""


def read_alike(
    fit: Fit, observations: Observations, homographies: Homographies
) -> tuple[Observations, Estimate] | None:
    """The views with corners renamed such that all read the board from the same end, and a start for all that is asked.

    They stay as they are where it cannot be told. None where it does not matter to the shape that is to be estimated,
    or there is no solution without what turns change of it.
    """
    turns = fit.config.turns
    if len(observations) < 2 or len(turns) < 2 or not fit.shape.basis.shape[2]:
        return None
    movable = np.all([observations.shown[turn.rows] >= 2 for turn in turns], axis=0)
    ends = ends_of(smooth_shape(fit.config.shape, fit.shape.given, movable), turns)
    if ends is None:
        return None
    solved = solve_from_start(dataclasses.replace(fit, shape=ends.same), observations, homographies)
    if isinstance(solved, Rejected):
        return None
    chosen = most_likely_turns(_quadratics(fit, solved[0], ends), ends.composed)
    now = solved[0].estimate
    if chosen is None or not chosen.any():
        return observations, now
    chosen = ends.turns[chosen]
    back = Rigid3.stack([turn.motion.inverse() for turn in turns])
    poses = now.cams_from_board @ back[chosen]
    estimate = dataclasses.replace(now, rotations=poses.rotation.matrix, translations=np.array(poses.translation))
    return read_after(observations, chosen, turns), estimate


def read_after(observations: Observations, chosen: Int64[np.ndarray, " V"], turns: Sequence[BoardTurn]) -> Observations:
    """Each view's corners renamed by the turn that is chosen for it."""
    if not np.any(chosen):
        return observations
    rows = np.stack([turn.rows for turn in turns])[chosen[observations.view_of], observations.rows]
    return dataclasses.replace(observations, rows=rows)


def turns_matter(shape: BoardShape, turns: Sequence[BoardTurn]) -> bool:
    """Whether a board of this family may be another one after a turn."""
    if len(turns) < 2 or not shape.basis.shape[2]:
        return False
    basis = shape.basis.reshape(-1, shape.basis.shape[2])
    turned = (_turned(shape.basis, turn).reshape(basis.shape) for turn in turns[1:])
    return any(not np.allclose(other, basis, atol=1e-9 * np.abs(basis).max()) for other in turned)


def _turned(basis: FloatArray, turn: BoardTurn) -> FloatArray:
    """(P, 3, S): what is called corner k is the board's `rows[k]`, so what moves that one moves it, turned back."""
    return np.einsum("ji,pjs->pis", turn.motion.rotation.matrix, basis[turn.rows])


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Ends(Value):
    """What turns do to a family of shapes: those that do the same to it count as one.

    Attributes:
        turns: (G,) of the board's turns one for each that counts, the first is none.
        same: the family of what no turn changes; all: that, and then what turns change.
        changes: (G, C, C) what they do to the last C coefficients.
        composed: (G, G) which one the second is after the first.
    """

    turns: Int64[np.ndarray, " G"]
    same: BoardShape
    all: BoardShape
    changes: Float64[np.ndarray, "G C C"]
    composed: Int64[np.ndarray, "G G"]


def ends_of(shape: BoardShape, turns: Sequence[BoardTurn]) -> Ends | None:
    """None where turns change nothing of a family, of which the basis is orthonormal."""
    changes = np.stack([_change(shape, turn) for turn in turns])
    # The mean over a group is a projection onto what none of it changes.
    values, vectors = np.linalg.eigh(changes.mean(0))
    same, other = vectors[:, values > 0.5], vectors[:, values <= 0.5]
    if not other.shape[1]:
        return None
    changes = other.T @ changes @ other
    apart = np.abs(changes[:, None] - changes[None]).max((2, 3))
    first = (apart < _ALIKE).argmax(1)
    kept = np.unique(first)
    composed = np.searchsorted(kept, first[_composed(turns)[np.ix_(kept, kept)]])
    return Ends(kept, _part(shape, same), _part(shape, np.hstack([same, other])), changes[kept], composed)


def _change(shape: BoardShape, turn: BoardTurn) -> FloatArray:
    """(S, S) what a turn does to the coefficients; the basis is orthonormal."""
    basis = shape.basis.reshape(-1, shape.basis.shape[2])
    return basis.T @ _turned(shape.basis, turn).reshape(basis.shape)


def _part(shape: BoardShape, columns: FloatArray) -> BoardShape:
    basis = np.ascontiguousarray(shape.basis @ columns)
    return BoardShape(shape.kind, shape.given, basis, np.zeros(columns.shape[1]))


def _composed(turns: Sequence[BoardTurn]) -> Int64[np.ndarray, "G G"]:
    """Which turn the second is after the first."""
    known = {turn.rows.tobytes(): g for g, turn in enumerate(turns)}
    return np.array([[known[after.rows[turn.rows].tobytes()] for after in turns] for turn in turns], np.int64)


def _quadratics(fit: Fit, solved: CalibrationSystem, ends: Ends) -> Quadratics:
    """The views about a solution, by all coefficients of the shape.

    Corners that are far off take little part, since nothing has been rejected yet.
    """
    sigma, now = spread_of(np.hypot(*solved.residuals().T)), solved.estimate
    about = dataclasses.replace(now, shape=dataclasses.replace(ends.all, given=now.shape.points3D))
    free = fit.lens.columns()
    system = CalibrationSystem(
        solved.observations, about, free, free_shape=True, loss="cauchy", loss_scale=2 * sigma
    )  # fmt: skip
    A, b = (part / sigma**2 for part in without_poses(system))
    return Quadratics(A, b, ends.changes, prior_of(A, len(free), ends))


def prior_of(A: FloatArray, others: int, ends: Ends) -> FloatArray:
    """(K, K) next to none of what comes before the coefficients of the shape, and a board that is nearly flat.

    Args:
        A: (V, K, K) of the views.
        others: how many parameters come before.
    """
    given = ends.all.given
    nearest = np.sort(np.linalg.norm(given[1:] - given[0], axis=1))[0]
    prior = np.diag(A.sum(0)) * _RIDGE
    prior[others:] += 1 / (_BEND * nearest) ** 2
    return np.diag(prior)


def without_poses(system: CalibrationSystem) -> tuple[FloatArray, FloatArray]:
    """Of each view the normal matrix (V, K, K) of what views share, and the negative gradient (V, K)."""
    lower = np.tril(system.blocks)
    full = lower + np.tril(lower, -1).swapaxes(1, 2)
    W = full[:, :6, 6:]
    reduced = full[:, 6:, 6:] - W.swapaxes(1, 2) @ np.linalg.solve(full[:, :6, :6], W)
    return reduced[:, :-1, :-1], -reduced[:, -1, :-1]
