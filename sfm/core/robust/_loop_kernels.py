"""The search through samples, and the refinement of a model, for any problem of `_problem_kernels`."""

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
    plausible,
    solve,
    squared_errors,
    start,
)

_BLOCK, _ROUND, _STEPS = 16, 20, 20
_PATIENCE, _ALL = 3.0, 1e150


@njit(cache=True, nogil=True, error_model="numpy")
def score(problem, model, loss, max_square, bound, patience, squares):
    """Σ ρ(r²) of a model, or infinity as soon as that is sure not to be below `bound`; and the number of inliers.

    Of data in random order, the first n of N have n / N of the sum to within a few times √n p (1 − p), in units of
    ρ(∞) and with p = sum / N. A model whose first data cost more than `patience` such deviations above the share of
    `bound` is given up as well; p (1 − p) counts as a twentieth at least, since a bound that no model has set yet has
    p = 1, and says nothing. `squares` are those of the data that were looked at.
    """
    count, total, inliers, last = squares.shape[0], 0.0, 0, 0
    share = bound / count
    deviation = patience * np.sqrt(max(share * (max_square - share), 0.05 * max_square**2))
    while last < count:
        first, last = last, min(last + _BLOCK, count)
        squared_errors(problem, model, first, last, squares)
        for i in range(first, last):
            if squares[i] < max_square:
                total += squares[i] if loss == TRUNCATED else robust_weight(squares[i], loss, 1.0, max_square)[0]
                inliers += 1
            else:
                total += max_square
        if not total < min(bound, share * last + deviation * np.sqrt(last)):
            return np.inf, inliers
    return total, inliers


@njit(cache=True, nogil=True, error_model="numpy")
def best_model(problem, models, loss, max_square, bound, squares):
    """The model of the lowest score Σ ρ(r²) below `bound`: its index, or −1, its score and its number of inliers."""
    index, best_inliers = -1, 0
    for k in range(models.shape[0]):
        total, inliers = score(problem, models[k], loss, max_square, bound, _ALL, squares)
        if total < bound:
            index, bound, best_inliers = k, total, inliers
    return index, bound, best_inliers


@njit(cache=True, nogil=True, error_model="numpy")
def search(problem, some, samples, models, loss, max_square, tolerance, bounds, best):
    """Solves samples one by one until a model is better than all before: how many were used, and its inliers or −1.

    After every `_ROUND` samples their best model is refined on `some` of the data, if it beats all minimal ones before.
    `bounds` (2,) are the lowest scores so far of a minimal and of a refined model; the best model goes to `best`.
    `models` is scratch. Minimal models, which chance has made exact for the sample and inexact for the rest, are ranked
    by the truncated loss: the marginalised one looks at the sample above all.
    """
    squares, candidate = np.empty(problem.data.shape[1]), np.empty(SIZE)
    improved = False
    for k in range(samples.shape[0]):
        for n in range(solve(problem, samples[k : k + 1], models)):
            if not plausible(problem, models[n], samples[k]):
                continue
            total = score(problem, models[n], TRUNCATED, max_square, bounds[0], _PATIENCE, squares)[0]
            if total < bounds[0]:
                bounds[0], improved = total, True
                # Not by slices, whose errors have messages that take a second and a half to compile.
                for i in range(SIZE):
                    candidate[i] = models[n, i]
        if improved and ((k + 1) % _ROUND == 0 or k + 1 == samples.shape[0]):
            improved = False
            improve(some, candidate, loss, max_square, max_square, tolerance)
            total, inliers = score(problem, candidate, loss, max_square, bounds[1], _ALL, squares)
            if total < bounds[1]:
                bounds[1] = total
                for i in range(SIZE):
                    best[i] = candidate[i]
                return k + 1, inliers
    return samples.shape[0], -1


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
