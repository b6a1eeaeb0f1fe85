"""The best of many models and the refinement of one, for any problem of `_problem_kernels`."""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.core.robust._damping_kernels import damped_step
from sfm.core.robust._loss_kernels import TRUNCATED, robust_weight
from sfm.core.robust._problem_kernels import (
    SIZE,
    equations,
    model_of,
    moved,
    parameters,
    squared_errors,
    start,
)

_BLOCK = 64
_STEPS = 20


@njit(cache=True, nogil=True, error_model="numpy")
def best_model(problem, models, loss, max_square, bound, squares):
    """The model of the lowest score Σ ρ(r²) below `bound`: its index, or −1, its score and its number of inliers.

    A model is given up as soon as its partial sum is too high; `squares` are those of the last one, as far as it came.
    """
    count, index, best_inliers = squares.shape[0], -1, 0
    for k in range(models.shape[0]):
        total, inliers = 0.0, 0
        for first in range(0, count, _BLOCK):
            if not total < bound:
                break
            last = min(first + _BLOCK, count)
            squared_errors(problem, models[k], first, last, squares)
            for i in range(first, last):
                if squares[i] < max_square:
                    total += squares[i] if loss == TRUNCATED else robust_weight(squares[i], loss, 1.0, max_square)[0]
                    inliers += 1
                else:
                    total += max_square
        if total < bound:
            index, bound, best_inliers = k, total, inliers
    return index, bound, best_inliers


@njit(cache=True, nogil=True, error_model="numpy")
def improve(problem, model, loss, square_scale, max_square, tolerance):
    """Levenberg–Marquardt on Σ ρ(r²), in place; never ends higher than it began. False if the model is degenerate."""
    state = np.zeros(SIZE)
    if not start(problem, model, state):
        return False
    dof, damping = parameters(problem), 1e-4
    hessian, gradient = np.zeros((dof, dof)), np.zeros(dof)
    new_hessian, new_gradient = np.zeros((dof, dof)), np.zeros(dof)
    cost = equations(problem, state, loss, square_scale, max_square, hessian, gradient)
    for _ in range(_STEPS):
        candidate = moved(problem, state, damped_step(hessian, gradient, damping))
        new_hessian.fill(0.0)
        new_gradient.fill(0.0)
        new_cost = equations(problem, candidate, loss, square_scale, max_square, new_hessian, new_gradient)
        if not new_cost < cost:
            damping *= 10.0
            if damping > 1e4:
                break
            continue
        converged = cost - new_cost < tolerance * cost
        state, cost, damping = candidate, new_cost, max(0.1 * damping, 1e-9)
        hessian, new_hessian = new_hessian, hessian
        gradient, new_gradient = new_gradient, gradient
        if converged:
            break
    model_of(problem, state, model)
    return True
