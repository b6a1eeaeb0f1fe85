"""Steps that keep some unknowns within bounds.

A damped step minimises  q(x) = ½ xᵀ A x − bᵀ x  with A = S + λD positive definite. With l ≤ x_k ≤ u for some entries k,
some of these end on a bound, the *active* ones, and for the right set of them

    A x = b + E μ        x_k = l_k, μ_k ≥ 0   or   x_k = u_k, μ_k ≤ 0   or   l_k ≤ x_k ≤ u_k, μ_k = 0

with E the columns of the identity for the active entries. From x₀ = A⁻¹ b and Y = A⁻¹ E

    x = x₀ + Y μ        Eᵀ Y μ = bounds − Eᵀ x₀

so that the factor of A serves for every set. Entries that left the box become active, active ones whose μ has the
wrong sign are freed, all at once, until nothing changes. That this may run in circles is ruled out after a few rounds
by freeing no more; then what is active only grows.

Reference:
    Portugal, Júdice & Vicente, A comparison of block pivoting and interior-point algorithms for linear least squares
        problems with nonnegative variables, 1994.
    Nocedal & Wright, Numerical optimization, 2nd ed. 2006, §16.7.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from sfm.core.arrays import FloatArray

_FREEING_ROUNDS = 10


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
    """
    count = len(box.entries)
    sides, columns, now, mu = np.zeros(count, np.int64), {}, x, np.zeros(count)
    for k in range(_FREEING_ROUNDS + count + 1):
        here = now[box.entries]
        free = sides == 0
        wanted = np.where(free, (here > box.upper) * 1 - (here < box.lower), sides)
        if k < _FREEING_ROUNDS:
            wanted[~free & (sides * mu > 0)] = 0
        if np.array_equal(wanted, sides):
            break
        sides = wanted
        active = np.flatnonzero(sides)
        for a in active.tolist():
            if a not in columns:
                columns[a] = inverse_column(int(box.entries[a]))
        now, mu = x.copy(), np.zeros(count)
        if len(active):
            Y = np.stack([columns[a] for a in active.tolist()], axis=1)
            bounds = np.where(sides > 0, box.upper, box.lower)[active]
            mu[active] = np.linalg.solve(Y[box.entries[active]], bounds - x[box.entries[active]])
            now += Y @ mu[active]
            now[box.entries[active]] = bounds
    return BoxedStep(now, sides, mu)
