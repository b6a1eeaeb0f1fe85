"""The problem of an absolute pose with an unknown focal length: reprojection errors of a camera with square pixels.

Points of the image are counted from the principal point. Models and states are K R (9, by rows) and K t (3) with
K = diag(f, f, 1), f in the unit of the image; steps are those of the pose (6) and of log f. Points behind the camera
have an infinite error. Data are columns u, v, X (3, world).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from sfm.core.geometry.minimal._p4pf_kernels import p4pf
from sfm.core.robust._loss_kernels import robust_weight
from sfm.core.robust._manifold_kernels import moved_pose


class FocalResection(NamedTuple):
    """The problem of a pose and a focal length: its columns (5, N), contiguous."""

    data: np.ndarray


def solve(problem, samples, models):
    return p4pf(problem.data, samples, models)


def plausible(problem, model, sample):
    """Always: the depths of the sample are positive."""
    return True


def squared_errors(problem, model, start, stop, out):
    """Fills out[start:stop] with the squared errors of the model, in the squared unit of the image."""
    data, m = problem.data, model
    for i in range(start, stop):
        a, b, c = data[2, i], data[3, i], data[4, i]
        depth = m[6] * a + m[7] * b + m[8] * c + m[11]
        u = (m[0] * a + m[1] * b + m[2] * c + m[9]) / depth - data[0, i]
        v = (m[3] * a + m[4] * b + m[5] * c + m[10]) / depth - data[1, i]
        out[i] = u * u + v * v if depth > 0.0 else np.inf


def parameters(problem):
    return 7


def start(problem, model, state):
    for k in range(12):
        state[k] = model[k]
    focal = focal_of(model)
    return 0.0 < focal < np.inf


def model_of(problem, state, model):
    for k in range(12):
        model[k] = state[k]


def moved(problem, state, step):
    pose, focal = state.copy(), focal_of(state)
    _scale_rows(pose, 1.0 / focal)
    pose = moved_pose(pose, step[:6])
    _scale_rows(pose, focal * np.exp(step[6]))
    return pose


def equations(problem, state, loss, square_scale, max_square, hessian, gradient):
    """Adds JᵀWJ (7, 7) and JᵀWr to `hessian` and `gradient`; returns Σ ρ(r²).

    With x = R X + t at depth z, d(f x / z) = f / z (dx − (x / z) dz) + (f x / z) d log f, and dx = −[R X]× ω + υ.
    """
    data, pose, focal = problem.data, state.copy(), focal_of(state)
    _scale_rows(pose, 1.0 / focal)
    turned, rows, residual, by_point = np.empty(3), np.empty((2, 7)), np.empty(2), np.empty(3)
    cost = 0.0
    for i in range(data.shape[1]):
        for j in range(3):
            turned[j] = pose[3 * j] * data[2, i] + pose[3 * j + 1] * data[3, i] + pose[3 * j + 2] * data[4, i]
        depth = turned[2] + pose[11]
        for n in range(2):
            rows[n, 6] = focal * (turned[n] + pose[9 + n]) / depth
            residual[n] = rows[n, 6] - data[n, i]
        # A point behind the camera costs as much as any point that is far away.
        square = residual[0] * residual[0] + residual[1] * residual[1] if depth > 0.0 else 1e12
        rho, weight = robust_weight(square, loss, square_scale, max_square)
        cost += rho
        if weight == 0.0 or not depth > 0.0:
            continue
        for n in range(2):
            by_point[n], by_point[1 - n], by_point[2] = focal / depth, 0.0, -rows[n, 6] / depth
            for j in range(3):
                a, b = (j + 1) % 3, (j + 2) % 3
                rows[n, j] = turned[a] * by_point[b] - turned[b] * by_point[a]
                rows[n, 3 + j] = by_point[j]
            for j in range(7):
                gradient[j] += weight * rows[n, j] * residual[n]
                for k in range(j + 1):
                    hessian[j, k] += weight * rows[n, j] * rows[n, k]
    return cost


@njit(cache=True, nogil=True, error_model="numpy")
def focal_of(model):
    """f of K R (9), by its first two rows."""
    first = model[0] * model[0] + model[1] * model[1] + model[2] * model[2]
    second = model[3] * model[3] + model[4] * model[4] + model[5] * model[5]
    return (first * second) ** 0.25


@njit(cache=True, nogil=True, error_model="numpy")
def _scale_rows(model, factor):
    """Multiplies what belongs to u and v by a factor, in place."""
    for k in range(6):
        model[k] *= factor
    model[9] *= factor
    model[10] *= factor
