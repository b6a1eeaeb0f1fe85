"""The problem of two views with an unknown focal length: that of both cameras, or of the first.

Points are counted from the principal points, in one unit for both images, and K = diag(f, f, 1) with f in that unit.
The second of two cameras with different focal lengths has f = 1. Errors are Sampson distances of

    F = K⁻¹ E K⁻¹   (shared)        F = E K⁻¹   (one-sided)

Models are F (9, by rows) and log f. States are two rows of R (6), unit t (3) and log f; steps are those of an essential
matrix (5) and of log f. Data are columns x1, y1, x2, y2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from sfm.core.geometry.minimal._six_point_kernels import six_point
from sfm.core.robust import _manifold_kernels as manifold
from sfm.core.robust._two_view_kernels import FUNDAMENTAL, TwoViews, epipolar_equations


class FocalViews(NamedTuple):
    """The problem of two views: whether f is that of both, and its columns (4, N), contiguous."""

    shared: bool
    data: np.ndarray


def solve(problem, samples, models):
    return six_point(problem.data, samples, problem.shared, models)


def plausible(problem, model, sample):
    """Always: what is behind a camera shows in the end."""
    return True


def squared_errors(problem, model, start, stop, out):
    """Fills out[start:stop] with the squared errors of the model m, in the squared unit of the points."""
    data, m = problem.data, model
    for i in range(start, stop):
        x1, y1, x2, y2 = data[0, i], data[1, i], data[2, i], data[3, i]
        a0 = m[0] * x1 + m[1] * y1 + m[2]
        a1 = m[3] * x1 + m[4] * y1 + m[5]
        b0 = m[0] * x2 + m[3] * y2 + m[6]
        b1 = m[1] * x2 + m[4] * y2 + m[7]
        e = a0 * x2 + a1 * y2 + m[6] * x1 + m[7] * y1 + m[8]
        out[i] = e * e / (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1 + 1e-300)


def parameters(problem):
    return 6


def start(problem, model, state):
    """Any of the four decompositions of E serves, since all have the same E up to sign."""
    essential, pose = np.empty(9), np.empty(12)
    scaled_by_focal(model, model[9], problem.shared, essential)
    if not manifold.matrix_state(essential, True, pose):
        return False
    _packed(pose, model[9], state)
    return True


def model_of(problem, state, model):
    essential, pose = np.empty(9), np.empty(12)
    _unpacked(state, pose)
    manifold.matrix_of(pose, essential)
    scaled_by_focal(essential, -state[9], problem.shared, model)
    model[9] = state[9]


def moved(problem, state, step):
    new, pose = state.copy(), np.empty(12)
    _unpacked(state, pose)
    _packed(manifold.moved_matrix(pose, step[:5]), state[9] + step[5], new)
    return new


def equations(problem, state, loss, square_scale, max_square, hessian, gradient):
    """With log f, F[i, j] changes by −F[i, j] for each of i, j < 2 whose camera has that f."""
    model, pose, essential, tangent = np.empty(9), np.empty(12), np.empty(9), np.empty((6, 9))
    _unpacked(state, pose)
    manifold.matrix_of(pose, essential)
    manifold.matrix_tangent(pose, tangent[:5])
    scaled_by_focal(essential, -state[9], problem.shared, model)
    for k in range(5):
        scaled_by_focal(tangent[k], -state[9], problem.shared, tangent[k])
    for k in range(9):
        count = (1.0 if k % 3 < 2 else 0.0) + (1.0 if problem.shared and k < 6 else 0.0)
        tangent[5, k] = -count * model[k]
    views = TwoViews(FUNDAMENTAL, problem.data)
    return epipolar_equations(views, model, tangent, loss, square_scale, max_square, hessian, gradient)


@njit(cache=True, nogil=True, error_model="numpy")
def scaled_by_focal(matrix, log_focal, shared, out):
    """out (9,) = K matrix K, or matrix K if it is not shared, for K = diag(f, f, 1); `out` may be `matrix`."""
    focal = np.exp(log_focal)
    for k in range(9):
        out[k] = matrix[k] * (focal if k % 3 < 2 else 1.0) * (focal if shared and k < 6 else 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _packed(pose, log_focal, state):
    """Fills `state` from R (9), t (3) and log f."""
    for k in range(6):
        state[k] = pose[k]
    for k in range(3):
        state[6 + k] = pose[9 + k]
    state[9] = log_focal


@njit(cache=True, nogil=True, error_model="numpy")
def _unpacked(state, pose):
    """Fills R (9), t (3) from a state; the third row of R is the cross product of the others."""
    for k in range(6):
        pose[k] = state[k]
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        pose[6 + k] = state[a] * state[3 + b] - state[b] * state[3 + a]
        pose[9 + k] = state[6 + k]
