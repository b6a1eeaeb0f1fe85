"""Tangent reprojection errors of absolute poses, their scores and normal equations.

A pixel with unit ray r and derivative B (2 × 3) of the pixel by the ray is compared with a point x = R X + t of the
camera frame on the plane that touches the unit sphere at r:

    residual = B x / (r · x)        (B r = 0)

This is the reprojection error in px up to terms of second order in the angle between r and x, for any camera model,
without projecting anything. Points with r · x ≤ 0 have an infinite error.

Data are columns: r (3), B (6, by rows), X (3, world). Poses are R (9, by rows), t (3).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfm.core.geometry.minimal._p3p_kernels import p3p
from sfm.core.robust._loss_kernels import robust_weight
from sfm.core.robust._manifold_kernels import moved_pose


class Resection(NamedTuple):
    """The problem of an absolute pose: its columns (12, N), contiguous."""

    data: np.ndarray


def solve(problem, samples, models):
    return p3p(problem.data, samples, models)


def plausible(problem, model, sample):
    """Always: the depths of the sample are positive."""
    return True


def squared_errors(problem, model, start, stop, out):
    """Fills out[start:stop] with the squared errors in px² of the pose `model`."""
    data, m = problem.data, model
    for i in range(start, stop):
        a, b, c = data[9, i], data[10, i], data[11, i]
        x = m[0] * a + m[1] * b + m[2] * c + m[9]
        y = m[3] * a + m[4] * b + m[5] * c + m[10]
        z = m[6] * a + m[7] * b + m[8] * c + m[11]
        along = data[0, i] * x + data[1, i] * y + data[2, i] * z
        u = data[3, i] * x + data[4, i] * y + data[5, i] * z
        v = data[6, i] * x + data[7, i] * y + data[8, i] * z
        out[i] = (u * u + v * v) / (along * along) if along > 0.0 else np.inf


def parameters(problem):
    return 6


def start(problem, model, state):
    for k in range(12):
        state[k] = model[k]
    return True


def model_of(problem, state, model):
    for k in range(12):
        model[k] = state[k]


def moved(problem, state, step):
    return moved_pose(state, step)


def equations(problem, state, loss, square_scale, max_square, hessian, gradient):
    """Adds JᵀWJ (6, 6) and JᵀWr to `hessian` and `gradient`; returns Σ ρ(r²).

    With s = r · x, the derivative of the residual by x is (B − residual rᵀ) / s.
    """
    data, m = problem.data, state
    turned, rows, residual, by_point = np.empty(3), np.empty((2, 6)), np.empty(2), np.empty(3)
    cost = 0.0
    for i in range(data.shape[1]):
        along, u, v = 0.0, 0.0, 0.0
        for j in range(3):
            turned[j] = m[3 * j] * data[9, i] + m[3 * j + 1] * data[10, i] + m[3 * j + 2] * data[11, i]
            x = turned[j] + m[9 + j]
            along += data[j, i] * x
            u += data[3 + j, i] * x
            v += data[6 + j, i] * x
        # A point behind its ray costs as much as any point that is far away.
        square = (u * u + v * v) / (along * along) if along > 0.0 else 1e12
        rho, weight = robust_weight(square, loss, square_scale, max_square)
        cost += rho
        if weight == 0.0 or not along > 0.0:
            continue
        residual[0], residual[1] = u / along, v / along
        for n in range(2):
            for j in range(3):
                by_point[j] = (data[3 + 3 * n + j, i] - residual[n] * data[j, i]) / along
            for j in range(3):
                a, b = (j + 1) % 3, (j + 2) % 3
                rows[n, j] = turned[a] * by_point[b] - turned[b] * by_point[a]
                rows[n, 3 + j] = by_point[j]
            for j in range(6):
                gradient[j] += weight * rows[n, j] * residual[n]
                for k in range(j + 1):
                    hessian[j, k] += weight * rows[n, j] * rows[n, k]
    return cost
