"""Preconditioned conjugate gradients for S x = b, S symmetric and positive definite, known by its products alone.

The x of step k minimises the model  Q(x) = ½ xᵀ S x − bᵀ x  over a space that grows by one dimension with each step.
A step of Newton's method needs no exact solution: besides the residual r = b − S x, the model tells when to stop,
once a step lowers it by less than a part ζ of the mean of all steps so far,

    k (Q_k − Q_k−1) / Q_k < ζ,        Q = −½ xᵀ (b + r).

Reference:
    Nash & Sofer, Assessing a search direction within a truncated-Newton method, 1990.
    Nocedal & Wright, Numerical optimization, 2nd ed. 2006, §5.1 and §7.1.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np

from sfm.core.arrays import FloatArray

GradientsEnd: TypeAlias = Literal["residual", "model", "max_iterations", "curvature", "breakdown"]
"""Small residual; little left to gain; enough; a direction of no positive curvature; numbers that are not finite, or
a preconditioner that is not positive definite."""
Linear: TypeAlias = Callable[[FloatArray], FloatArray]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Approximation:
    """An approximate solution (n,), always finite, the steps it took, why they ended, and |b − S x| / |b|."""

    x: FloatArray
    iterations: int
    reason: GradientsEnd
    relative_residual: float


def conjugate_gradients(
    product: Linear, side: FloatArray, precondition: Linear, *,
    residual_tolerance: float = 1e-8, model_tolerance: float = 0.0, max_iterations: int = 500,
) -> Approximation:  # fmt: skip
    """An approximate solution of S x = b, from x = 0.

    Where the arithmetic ends it, the x before is the answer: no step raises the model, so that it is the best so far.

    Args:
        product: x → S x; `precondition`: r → M⁻¹ r with M ≈ S positive definite. Neither changes its argument.
        side: b (n,).
        residual_tolerance: ends when |r| ≤ this part of |b|.
        model_tolerance: ζ; 0 leaves the model alone, 0.1 suits steps far from the minimum.
    """
    x, r, length = np.zeros_like(side), side.copy(), _norm(side)
    if length == 0:
        return Approximation(x, 0, "residual", 0.0)
    p, before, model = np.zeros_like(side), 1.0, 0.0

    def ended(iterations: int, reason: GradientsEnd) -> Approximation:
        return Approximation(x, iterations, reason, _norm(r) / length)

    if not np.isfinite(length):
        return Approximation(x, 0, "breakdown", 1.0)
    for k in range(1, max_iterations + 1):
        z = precondition(r)
        descent = _dot(r, z)
        if not 0 < descent < np.inf:
            return ended(k - 1, "breakdown")
        p = z + descent / before * p if k > 1 else z
        Sp = product(p)
        curvature = _dot(p, Sp)
        if not 0 < curvature < np.inf:
            return ended(k - 1, "curvature" if curvature <= 0 else "breakdown")
        step = descent / curvature
        next_x, next_r = x + step * p, r - step * Sp
        if not np.isfinite(_norm(next_x) + _norm(next_r)):
            return ended(k - 1, "breakdown")
        x, r, before = next_x, next_r, descent
        if _norm(r) <= residual_tolerance * length:
            return ended(k, "residual")
        last, model = model, -0.5 * _dot(x, side + r)
        if model_tolerance > 0 and k * (model - last) > model_tolerance * model:  # both are negative
            return ended(k, "model")
    return ended(max_iterations, "max_iterations")


def _dot(a: FloatArray, b: FloatArray) -> float:
    """aᵀ b, summed in an order of its own: that of a BLAS depends on the number of cores."""
    return float(np.sum(a * b))


def _norm(a: FloatArray) -> float:
    return float(np.sqrt(np.sum(a * a)))
