"""Steps that keep some unknowns within bounds.

A damped step minimises  q(x) = ½ xᵀ A x − bᵀ x  with A = S + λD positive definite. With l ≤ x_k ≤ u for some entries k,
some of these end on a bound, the *active* ones, and for the right set of them

    A x = b + E μ        x_k = l_k, μ_k ≥ 0   or   x_k = u_k, μ_k ≤ 0   or   l_k ≤ x_k ≤ u_k, μ_k = 0

with E the columns of the identity for the active entries. From x₀ = A⁻¹ b and Y = A⁻¹ E

    x = x₀ + Y μ        Eᵀ Y μ = bounds − Eᵀ x₀

so that the factor of A serves for every set. Entries that left the box become active, active ones whose μ has the
wrong sign are freed, all at once, as long as there become fewer of both. Where that runs in circles the bounded entries
alone are a small least-squares problem, whose matrix is the inverse of Eᵀ A⁻¹ E, for a method that cannot.

Reference:
    Portugal, Júdice & Vicente, A comparison of block pivoting and interior-point algorithms for linear least squares
        problems with nonnegative variables, 1994.
    Stark & Parker, Bounded-variable least squares: an algorithm and applications, 1995.
    Nocedal & Wright, Numerical optimization, 2nd ed. 2006, §16.7.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy.linalg import solve_triangular
from scipy.optimize import lsq_linear

from sfm.core.arrays import FloatArray

_ROUNDS_WITHOUT_GAIN = 10


class Box(NamedTuple):
    """Entries (K,) of the unknowns, and the least and largest value (K,) that each may have."""

    entries: Int64[np.ndarray, " K"]
    lower: Float64[np.ndarray, " K"]
    upper: Float64[np.ndarray, " K"]


class BoxedStep(NamedTuple):
    """The best step within a box.

    Attributes:
        x: (n,).
        sides: (K,) −1 for entries on their lower bound, 1 on their upper one, 0 for the others.
        multipliers: (K,) μ, 0 where not active.
    """

    x: FloatArray
    sides: np.ndarray
    multipliers: FloatArray


def step_in_box(x: FloatArray, inverse_column: Callable[[int], FloatArray], box: Box) -> BoxedStep:
    """Moves x = A⁻¹ b into the box.

    Args:
        inverse_column: entry k → A⁻¹ e_k (n,), asked once for each entry that is active in some round.
    Returns:
        The step; NaN where rounding leaves no positive definite matrix of the bounded entries.
    """
    columns: dict[int, FloatArray] = {}

    def column(k: int) -> FloatArray:
        if k not in columns:
            columns[k] = inverse_column(int(box.entries[k]))
        return columns[k]

    step, fewest, patience = BoxedStep(x, np.zeros(len(box.entries), np.int64), np.zeros(len(box.entries))), np.inf, 0
    while patience < _ROUNDS_WITHOUT_GAIN:
        wanted = _better_sides(step, box)
        wrong = int(np.sum(wanted != step.sides))
        if not wrong:
            return step
        patience = 0 if wrong < fewest else patience + 1
        fewest = min(fewest, wrong)
        step = _on_sides(wanted, x, column, box)
    try:
        return _on_sides(_sides_one_by_one(x, column, box), x, column, box)
    except np.linalg.LinAlgError:
        return BoxedStep(np.full_like(x, np.nan), step.sides, step.multipliers)


def _better_sides(step: BoxedStep, box: Box) -> np.ndarray:
    """(K,) the sides of a step, with those that left the box on its edge and those freed that their edge holds back."""
    here, free = step.x[box.entries], step.sides == 0
    held_back = (step.sides * step.multipliers > 0) & (box.lower < box.upper)
    return np.where(free, (here > box.upper) * 1 - (here < box.lower), np.where(held_back, 0, step.sides))


def _on_sides(sides: np.ndarray, x: FloatArray, column: Callable[[int], FloatArray], box: Box) -> BoxedStep:
    """The best step with some entries on a side of the box, wherever that leaves the others."""
    active, mu = np.flatnonzero(sides), np.zeros(len(sides))
    if not len(active):
        return BoxedStep(x, sides, mu)
    Y, entries = np.stack([column(a) for a in active.tolist()], axis=1), box.entries[active]
    bounds = np.where(sides > 0, box.upper, box.lower)[active]
    mu[active] = np.linalg.solve(Y[entries], bounds - x[entries])
    now = x + Y @ mu[active]
    now[entries] = bounds
    return BoxedStep(now, sides, mu)


def _sides_one_by_one(x: FloatArray, column: Callable[[int], FloatArray], box: Box) -> np.ndarray:
    """(K,) on which side entries end; by `scipy.optimize.lsq_linear`, which frees or holds one entry at a time."""
    G = np.stack([column(k)[box.entries] for k in range(len(box.entries))], axis=1)
    root = np.linalg.cholesky(0.5 * (G + G.T))
    J = solve_triangular(root, np.eye(len(G)), lower=True)  # Jᵀ J = G⁻¹
    moving = np.flatnonzero(box.lower < box.upper)
    sides = np.ones(len(G), np.int64)
    there = np.where(box.lower < box.upper, 0.0, box.lower)
    found = lsq_linear(
        J[:, moving], J @ (x[box.entries] - there), (box.lower[moving], box.upper[moving]), "bvls", tol=0.0,
        max_iter=20 * len(G),
    )  # fmt: skip
    sides[moving] = found.active_mask
    return sides
