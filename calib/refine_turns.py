"""From which end each view reads a board that looks the same after a turn.

To a flat board it does not matter. A board of any other shape is another one when it is read from the other end: with
some views read that way its shape averages out, and the rest of it bends the camera. So the views are compared before
a shape is estimated. First what turns leave alone of the shape is fitted, which is the same however views are read. A
view's cost by small changes x of the camera and of the shape is then, its pose eliminated,

    c − bᵀx + ½ xᵀA x

and with R x in place of x if it is read after a turn, where R is what that does to shapes. For a choice of turns let
A and b be those of the views as they are then read, and P a prior: boards are nearly flat. What other views than v say
is x = (Σ A − A_v + P)⁻¹ (Σ b − b_v), and v's cost with it tells from which end it is read. It is sought in two steps:

1. With M, the inverse of the mean of ΣA + P over the turns, for what turns change, pairs of views agree by the products
   b_uᵀ R_u M R_vᵀ b_v. The choice with the largest sum is sought from every view: the others first as they agree with
   that one, then each as it agrees with all.
2. From there, and from the views as they were read, each view is turned as the others want it, until none changes. The
   better one has the lower sum of costs.

The end from which most views were read is the board's. A choice is believed if views agree by it more than they do by
chance.
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
from sfm.core.arrays import FloatArray, Value, Vector
from sfm.core.errors import Rejected

_BEND = 0.03
"""Standard deviation of a corner's place, by the distance to the nearest one, that is expected of boards."""
_FEWEST, _BY_CHANCE = 3, (3.0, 60.0)
"""A choice of V views is believed if their agreement is beyond 3 + 60 / (V − 3). On flat boards the best choice reaches
27, 15, 10, 5 and 3 by chance with 5, 6, 8, 14 and 30 views; boards of five sets of 6 to 26 photos are at 15 to 155."""
_LEAST = 2.0
"""Cost that a view must save when it is turned, by what the others say: what saves less stays as it was read."""
_ROUNDS = 20
_RIDGE = 1e-9
"""Of the diagonal, for coefficients that nothing determines."""
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
    changes = np.stack([_change(free, turn) for turn in turns])
    same, other = _parts(changes)
    solved = solve_from_start(dataclasses.replace(fit, shape=_part(free, same)), observations, homographies)
    if isinstance(solved, Rejected) or not other.shape[1]:
        return observations
    quadratics = _quadratics(fit, solved[0], _part(free, np.hstack([same, other])), changes, np.hstack([same, other]))
    chosen = most_likely_turns(quadratics, _composed(turns), other.shape[1])
    return observations if chosen is None else read_after(observations, chosen, turns)


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


def _change(shape: BoardShape, turn: BoardTurn) -> FloatArray:
    """(S, S) what a turn does to the coefficients; the basis is orthonormal."""
    basis = shape.basis.reshape(-1, shape.basis.shape[2])
    return basis.T @ _turned(shape.basis, turn).reshape(basis.shape)


def _parts(changes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal columns: coefficients that no turn changes, and the others. The mean over a group is a projection."""
    values, vectors = np.linalg.eigh(changes.mean(0))
    return vectors[:, values > 0.5], vectors[:, values <= 0.5]


def _part(shape: BoardShape, columns: FloatArray) -> BoardShape:
    basis = np.ascontiguousarray(shape.basis @ columns)
    return BoardShape(shape.kind, shape.given, basis, np.zeros(columns.shape[1]))


def _composed(turns: Sequence[BoardTurn]) -> Int64[np.ndarray, "G G"]:
    """Which turn the second is after the first."""
    known = {turn.rows.tobytes(): g for g, turn in enumerate(turns)}
    return np.array([[known[after.rows[turn.rows].tobytes()] for after in turns] for turn in turns], np.int64)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Quadratics(Value):
    """Costs of views by changes of the camera and the shape, in units of the noise; what turns change comes last.

    Attributes:
        A: (G, V, K, K) and b (G, V, K), after each turn.
        prior: (K, K).
    """

    A: FloatArray
    b: FloatArray
    prior: FloatArray


def _quadratics(
    fit: Fit, solved: CalibrationSystem, shape: BoardShape, changes: FloatArray, columns: FloatArray
) -> Quadratics:
    """The views about a solution, by all coefficients of the shape.

    Corners that are far off take little part, since nothing has been rejected yet.
    """
    sigma, now = spread_of(np.hypot(*solved.residuals().T)), solved.estimate
    about = dataclasses.replace(now, shape=dataclasses.replace(shape, given=now.shape.points3D))
    system = CalibrationSystem(
        solved.observations, about, fit.lens.columns(), free_shape=True, loss="cauchy", loss_scale=2 * sigma
    )
    A, b = (part / sigma**2 for part in without_poses(system))
    free = len(fit.lens.columns())
    R = np.tile(np.eye(A.shape[1]), (len(changes), 1, 1))
    R[:, free:, free:] = columns.T @ changes @ columns
    nearest = np.sort(np.linalg.norm(shape.given[1:] - shape.given[0], axis=1))[0]
    prior = np.diag(A.sum(0)) * _RIDGE
    prior[free:] += 1 / (_BEND * nearest) ** 2
    A = R.swapaxes(1, 2)[:, None] @ A @ R[:, None]
    return Quadratics(A, np.einsum("gji,vj->gvi", R, b), np.diag(prior))


def without_poses(system: CalibrationSystem) -> tuple[FloatArray, FloatArray]:
    """Of each view the normal matrix (V, K, K) of what views share, and the negative gradient (V, K)."""
    lower = np.tril(system.blocks)
    full = lower + np.tril(lower, -1).swapaxes(1, 2)
    W = full[:, :6, 6:]
    reduced = full[:, 6:, 6:] - W.swapaxes(1, 2) @ np.linalg.solve(full[:, :6, :6], W)
    return reduced[:, :-1, :-1], -reduced[:, -1, :-1]


def most_likely_turns(
    quadratics: Quadratics, composed: Int64[np.ndarray, "G G"], changed: int
) -> Int64[np.ndarray, " V"] | None:
    """Of each view the turn after which it is read; None where the choice is not to be believed.

    Args:
        changed: number of coefficients that turns change.
    """
    A, b = quadratics.A[:, :, -changed:, -changed:], quadratics.b[:, :, -changed:]
    M = np.linalg.inv(A.mean(0).sum(0) + quadratics.prior[-changed:, -changed:])
    first = _most_alike(np.einsum("gvi,ij,huj->vguh", b, M, b, optimize=True))
    tried = (_settled(quadratics, start) for start in (np.zeros_like(first), first))
    chosen, costs = min(tried, key=lambda one: float(one[1].min(1).sum()))
    sure = np.partition(costs, 1)[:, 1] - costs.min(1) > _LEAST
    agreement = _agreement(quadratics, chosen)
    counts = [int(np.sum(composed[chosen, g] == 0)) for g in range(len(composed))]
    chosen = composed[chosen, int(np.argmax(counts))]
    beyond, few = _BY_CHANCE
    views = len(chosen)
    if views <= _FEWEST or agreement <= beyond + few / (views - _FEWEST):
        return None
    return np.where(sure, chosen, 0)


def _most_alike(products: FloatArray) -> Int64[np.ndarray, " V"]:
    """The choice with the largest sum of products (V, G, V, G) of different views that was found."""
    count = len(products)
    every = np.arange(count)
    K = products.copy()
    K[every, :, every, :] = 0.0
    best, most = np.zeros(count, np.int64), -np.inf
    for start in range(count):
        chosen = K[start, 0].argmax(1)
        chosen[start] = 0
        for _ in range(_ROUNDS):
            before = chosen.copy()
            for v in every:
                chosen[v] = K[v][:, every, chosen].sum(1).argmax()
            if np.array_equal(chosen, before):
                break
        value = float(K[every, chosen][:, every, chosen].sum())
        if value > most * (1 + 1e-9):
            best, most = chosen, value
    return best


def _settled(quadratics: Quadratics, start: Int64[np.ndarray, " V"]) -> tuple[Int64[np.ndarray, " V"], FloatArray]:
    """Each view turned as the others want it, until none changes; and the costs (V, G) by what these say."""
    chosen, costs = start.copy(), np.empty((len(start), len(quadratics.A)))
    for _ in range(_ROUNDS):
        before = chosen.copy()
        for v in range(len(chosen)):
            costs[v] = _costs(quadratics, chosen, v)
            chosen[v] = costs[v].argmin()
        if np.array_equal(chosen, before):
            break
    return chosen, costs


def _costs(quadratics: Quadratics, chosen: Int64[np.ndarray, " V"], view: int) -> Vector:
    """(G,) of a view after each turn, with the camera and the shape that the other views give."""
    every = np.arange(len(chosen))
    A, b = quadratics.A[chosen, every].sum(0), quadratics.b[chosen, every].sum(0)
    own = quadratics.A[:, view], quadratics.b[:, view]
    x = np.linalg.solve(A - own[0][chosen[view]] + quadratics.prior, b - own[1][chosen[view]])
    return 0.5 * np.einsum("i,gij,j->g", x, own[0], x, optimize=True) - own[1] @ x


def _agreement(quadratics: Quadratics, chosen: Int64[np.ndarray, " V"]) -> float:
    """Mean over the views of the logarithm of how much likelier all is as chosen than with this one read otherwise."""
    every = np.arange(len(chosen))
    A, b = quadratics.A[chosen, every].sum(0) + quadratics.prior, quadratics.b[chosen, every].sum(0)
    most, odds = _likelihood(A, b), []
    for v, own in enumerate(chosen.tolist()):
        own_A, own_b = quadratics.A[own, v], quadratics.b[own, v]
        others = (g for g in range(len(quadratics.A)) if g != own)
        tried = (_likelihood(A - own_A + quadratics.A[g, v], b - own_b + quadratics.b[g, v]) for g in others)
        odds.append(most - max(tried))
    return float(np.mean(odds))


def _likelihood(A: FloatArray, b: FloatArray) -> float:
    """Logarithm of the integral over x of exp(bᵀx − ½ xᵀA x), less a constant."""
    return 0.5 * float(b @ np.linalg.solve(A, b) - np.linalg.slogdet(A)[1])
