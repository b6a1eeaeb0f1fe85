"""Levenberg–Marquardt on a few parameters for problems that NumPy linearises."""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

import numpy as np

from sfm.core.arrays import FloatArray
from sfm.core.robust._damping_kernels import damped_step
from sfm.core.robust._loss_kernels import CAUCHY

_FINAL_STEPS = 20
_SCALE = 2.0


@runtime_checkable
class Problem(Protocol):
    """What the refinement needs to know of a problem; errors are in the problem's units.

    A *state* is a point of a manifold on which `moved` steps.
    """

    max_error: float

    def squared_errors(self, state: FloatArray) -> FloatArray:
        """r² of every datum; infinite or NaN where there is none."""
        ...

    def moved(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """The state after a step in its tangent space."""
        ...

    def normal_equations(self, state: FloatArray, loss: np.int64, scale: float) -> tuple[float, FloatArray, FloatArray]:
        """Cost Σ ρ(r²), JᵀWJ, of which the lower triangle is read, and JᵀWr."""
        ...


def refine(problem: Problem, state: FloatArray, loss: np.int64, scale: float, steps: int) -> FloatArray:
    """Levenberg–Marquardt on Σ ρ(r²) from a state; never ends higher than it began."""
    cost, hessian, gradient = problem.normal_equations(state, loss, scale)
    damping = 1e-4
    for _ in range(steps):
        step = damped_step(hessian, gradient, damping)
        candidate = problem.moved(state, step)
        new_cost, new_hessian, new_gradient = problem.normal_equations(candidate, loss, scale)
        if not new_cost < cost:
            damping *= 10
            if damping > 1e4:
                break
            continue
        converged = cost - new_cost < 1e-6 * cost
        state, cost, hessian, gradient = candidate, new_cost, new_hessian, new_gradient
        damping = max(0.1 * damping, 1e-9)
        if converged:
            break
    return state


def polish(problem: Problem, state: FloatArray) -> FloatArray:
    """Final refinement with Cauchy's loss at the scale of the residuals themselves."""
    squares = problem.squared_errors(state)
    inliers = squares[squares < problem.max_error**2]
    if not len(inliers):
        return state
    scale = max(_SCALE * math.sqrt(float(np.median(inliers))), 1e-3 * problem.max_error)
    return refine(problem, state, CAUCHY, scale, _FINAL_STEPS)
