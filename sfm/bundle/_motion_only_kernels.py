"""Kernel of the refinement without points; the mathematics is in `motion_only`."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from sfm.core.optim._loss_kernels import loss_and_weight


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _turn_back(R, x, out):
    """out = Rᵀ x."""
    for k in range(3):
        out[k] = R[0, k] * x[0] + R[1, k] * x[1] + R[2, k] * x[2]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _add_cross(factor, x, y, out):
    """out += factor (x × y)."""
    out[0] += factor * (x[1] * y[2] - x[2] * y[1])
    out[1] += factor * (x[2] * y[0] - x[0] * y[2])
    out[2] += factor * (x[0] * y[1] - x[1] * y[0])


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def evaluate_pairs(
    begin, end, offsets, first, second, rays1, rays2, tangents1, tangents2, R, C, loss, scale, lost_cost,
    derivatives, cost, H, g,
):  # fmt: skip
    """Fills cost (M,) of the pairs `begin:end` and, with `derivatives`, their H (M, 9, 9), lower half, and g (M, 9).

    Rows of H and g: turns of the first and the second camera, change of the baseline. `tangents` (n, 2, 3) are the
    derivatives of the rays by their pixel.
    """
    w = np.empty((12, 3))
    a, b, B, across, toward1, toward2 = w[0], w[1], w[2], w[3], w[4], w[5]
    p, P, q, Q, c, d = w[6], w[7], w[8], w[9], w[10], w[11]
    J, h = np.empty(9), np.empty((9, 9))
    for m in range(begin, end):
        Ri, Rj = R[first[m]], R[second[m]]
        for k in range(3):
            B[k] = C[second[m], k] - C[first[m], k]
        total = 0.0
        h[:] = 0.0
        g[m, :] = 0.0
        for o in range(offsets[m], offsets[m + 1]):
            _turn_back(Ri, rays1[o], a)
            _turn_back(Rj, rays2[o], b)
            across[:], toward1[:], toward2[:], P[:], Q[:] = 0.0, 0.0, 0.0, 0.0, 0.0
            _add_cross(1.0, a, b, across)
            _add_cross(1.0, b, B, toward1)
            _add_cross(1.0, B, a, toward2)
            square = 0.0
            for t in range(2):
                _turn_back(Ri, tangents1[o, t], p)
                _turn_back(Rj, tangents2[o, t], q)
                n1 = p[0] * toward1[0] + p[1] * toward1[1] + p[2] * toward1[2]
                n2 = q[0] * toward2[0] + q[1] * toward2[1] + q[2] * toward2[2]
                square += n1 * n1 + n2 * n2
                for k in range(3):
                    P[k] += n1 * p[k]
                    Q[k] += n2 * q[k]
            if not square > 0.0:
                total += lost_cost
                continue
            s = 1.0 / math.sqrt(square)
            r = (B[0] * across[0] + B[1] * across[1] + B[2] * across[2]) * s
            rho, weight = loss_and_weight(loss, scale, r * r)
            total += 0.5 * rho
            if not derivatives:
                continue
            u, root = r * s, s * math.sqrt(weight)
            J[:] = 0.0
            c[:], d[:] = 0.0, 0.0
            _add_cross(1.0, Q, B, c)
            _add_cross(1.0, B, P, d)
            for k in range(3):
                p[k], q[k] = a[k] - u * P[k], b[k] - u * Q[k]
            _add_cross(1.0, toward1, p, J[0:3])
            _add_cross(-u, c, a, J[0:3])
            _add_cross(1.0, toward2, q, J[3:6])
            _add_cross(-u, d, b, J[3:6])
            _add_cross(-u, P, b, J[6:9])
            _add_cross(1.0, a, q, J[6:9])
            r *= math.sqrt(weight)
            for i in range(9):
                J[i] *= root
                g[m, i] += J[i] * r
                for j in range(i + 1):
                    h[i, j] += J[i] * J[j]
        cost[m] = total
        H[m] = h
