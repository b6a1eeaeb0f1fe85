"""From which end each view reads a board that looks the same after a turn.

To a flat board it does not matter. A board of any other shape is another one when it is read from the other end: with
some views read that way its shape averages out, and the rest of it bends the camera. So the views are compared before
a shape is estimated. First what turns leave alone of the shape is fitted, which is the same however views are read. A
view's cost by the other coefficients q is then, its pose eliminated,

    c − bᵀq + ½ qᵀA q

and with R q in place of q if it is read after a turn, where R is what that does to shapes. Let M be the inverse of the
sum of all A, as a mean over the turns so that M and R commute, and with a prior, as boards are nearly flat. A choice of
turns takes off the cost

    ½ Σ_uv b_uᵀ R_u M R_vᵀ b_v

of which the products of different views depend on the choice. It is sought from every view in turn: the others first
as they agree with that one, then each as it agrees with all, until none changes. The end from which most views were
read is the board's. A choice is believed if views agree by it more than they do by chance.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64

from calib.board_turns import BoardTurn
from calib.refine_board import BoardShape, board_shape
from calib.refine_fit import Fit, solve_from_start
from calib.refine_reject import spread_of
from calib.refine_system import CalibrationSystem
from calib.refine_views import Observations
from calib.zhang import Homographies
from sfm.core.arrays import FloatArray, Vector
from sfm.core.errors import Rejected

_BEND = 0.03
"""Standard deviation of a corner's place, by the distance to the nearest one, that is expected of boards."""
_BELIEVED = 5.5
"""Mean over the views of the logarithm of how much likelier the chosen end is than the next. Flat boards reach 2 to 5
by chance, with 30 to 6 views; the boards of five sets of photos are at 6 to 73."""
_LEAST = 2.0
"""Of a view that is turned: what says less stays as it was read."""
_ROUNDS = 20
_LARGEST_WORK = 1e10
"""Corners times squared number of coefficients, beyond which the choice takes minutes: views stay as they were read."""


def read_alike(fit: Fit, observations: Observations, homographies: Homographies) -> Observations:
    """The views with corners renamed such that all read the board from the same end.

    They stay as they are where it does not matter to the shape that is to be estimated, or cannot be told.
    """
    turns = fit.config.turns
    if len(observations) < 2 or not turns_matter(fit.shape, turns):
        return observations
    shown = np.bincount(observations.rows, minlength=len(fit.shape.given)) >= 2
    free = board_shape("free", fit.shape.given, np.all([shown[turn.rows] for turn in turns], axis=0))
    if len(observations.rows) * float(free.basis.shape[2]) ** 2 > _LARGEST_WORK:
        return observations
    changes = _changes(free, turns)
    same, other = _parts(changes)
    solved = solve_from_start(dataclasses.replace(fit, shape=_part(free, same)), observations, homographies)
    if isinstance(solved, Rejected) or not other.shape[1]:
        return observations
    system, sigma = _by_other_part(solved[0], _part(free, other))
    chosen = _chosen(system, [other.T @ change @ other for change in changes], _composed(turns), sigma)
    return read_after(observations, chosen, turns)


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


def _changes(shape: BoardShape, turns: Sequence[BoardTurn]) -> list[FloatArray]:
    """(S, S) of each turn, what it does to the coefficients; the basis is orthonormal."""
    basis = shape.basis.reshape(-1, shape.basis.shape[2])
    return [basis.T @ _turned(shape.basis, turn).reshape(basis.shape) for turn in turns]


def _parts(changes: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Orthonormal columns: coefficients that no turn changes, and the others. The mean over a group is a projection."""
    values, vectors = np.linalg.eigh(sum(changes[1:], changes[0]) / len(changes))
    return vectors[:, values > 0.5], vectors[:, values <= 0.5]


def _part(shape: BoardShape, columns: FloatArray) -> BoardShape:
    basis = np.ascontiguousarray(shape.basis @ columns)
    return BoardShape(shape.kind, shape.given, basis, np.zeros(columns.shape[1]))


def _composed(turns: Sequence[BoardTurn]) -> Int64[np.ndarray, "G G"]:
    """Which turn the second is after the first."""
    known = {turn.rows.tobytes(): g for g, turn in enumerate(turns)}
    return np.array([[known[after.rows[turn.rows].tobytes()] for after in turns] for turn in turns], np.int64)


def _by_other_part(solved: CalibrationSystem, other: BoardShape) -> tuple[CalibrationSystem, float]:
    """The views by what turns change of the shape, about the solution without it, and the noise, px.

    Corners that are far off take little part, since nothing has been rejected yet.
    """
    sigma = spread_of(np.hypot(*solved.residuals().T))
    now = solved.estimate
    about = dataclasses.replace(other, given=now.shape.points3D)
    poses = np.zeros(0, np.int64)
    system = CalibrationSystem(
        solved.observations, dataclasses.replace(now, shape=about), poses, free_shape=True, loss="cauchy",
        loss_scale=2 * sigma,
    )  # fmt: skip
    return system, sigma


def _chosen(
    system: CalibrationSystem, changes: Sequence[FloatArray], composed: Int64[np.ndarray, "G G"], sigma: float
) -> Int64[np.ndarray, " V"]:
    """Of each view the turn after which it is read; none of any where the choice is not to be believed."""
    A, b = _without_poses(system)
    R = np.stack(changes)
    given = system.observations.board
    nearest = np.sort(np.linalg.norm(given[1:] - given[0], axis=1))[0]
    total = np.einsum("gji,jk,gkl->il", R, A.sum(0), R, optimize=True) / len(R)
    M = np.linalg.inv(total + (sigma / (_BEND * nearest)) ** 2 * np.eye(len(total)))
    pulls = np.einsum("gji,vj->gvi", R, b)
    chosen = _most_alike(np.einsum("gvi,ij,huj->vguh", pulls, M, pulls, optimize=True))
    counts = [int(np.sum(composed[chosen, g] == 0)) for g in range(len(R))]
    chosen = composed[chosen, int(np.argmax(counts))]
    odds = _odds(A, b, R, M, chosen) / sigma**2
    believed = np.mean(odds) > _BELIEVED
    return np.where(believed & (odds > _LEAST), chosen, 0)


def _without_poses(system: CalibrationSystem) -> tuple[FloatArray, FloatArray]:
    """A (V, S, S) and b (V, S)."""
    lower = np.tril(system.blocks)
    full = lower + np.tril(lower, -1).swapaxes(1, 2)
    W = full[:, :6, 6:]
    reduced = full[:, 6:, 6:] - W.swapaxes(1, 2) @ np.linalg.solve(full[:, :6, :6], W)
    return reduced[:, :-1, :-1], -reduced[:, -1, :-1]


def _most_alike(products: FloatArray) -> Int64[np.ndarray, " V"]:
    """The choice with the largest sum of products (V, G, V, G) of different views that was found."""
    count = len(products)
    every = np.arange(count)
    K = products.copy()
    K[every, :, every, :] = 0.0
    best, most = np.zeros(count, np.int64), -np.inf
    for start in range(count + 1):
        chosen = np.zeros(count, np.int64)
        if start < count:
            chosen = K[start, 0].argmax(1)
            chosen[start] = 0
        _ascend(K, chosen)
        value = float(K[every[:, None], chosen[:, None], every, chosen].sum())
        if value > most * (1 + 1e-9):
            best, most = chosen, value
    return best


def _ascend(K: FloatArray, chosen: Int64[np.ndarray, " V"]) -> None:
    """One view after the other as it agrees with all others, until none changes."""
    every = np.arange(len(chosen))
    for _ in range(_ROUNDS):
        before = chosen.copy()
        for v in every:
            chosen[v] = K[v][:, every, chosen].sum(1).argmax()
        if np.array_equal(chosen, before):
            return


def _odds(A: FloatArray, b: FloatArray, R: FloatArray, M: FloatArray, chosen: Int64[np.ndarray, " V"]) -> Vector:
    """(V,) cost of the best other reading less that of the chosen one, with the shape that the other views give."""
    every = np.arange(len(b))
    pulls = np.einsum("vji,vj->vi", R[chosen], b)
    q = (pulls.sum(0) - pulls) @ M
    read = np.einsum("gij,vj->gvi", R, q)
    costs = 0.5 * np.einsum("gvi,vij,gvj->gv", read, A, read, optimize=True) - np.einsum("gvi,vi->gv", read, b)
    own = costs[chosen, every]
    costs[chosen, every] = np.inf
    return costs.min(0) - own
