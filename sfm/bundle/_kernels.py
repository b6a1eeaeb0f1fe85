"""Kernels of bundle adjustment; the mathematics is in `system`, the meaning of the arrays in `layout`."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from sfm.core.cameras._kernels import project_point, project_point_jacobians
from sfm.core.optim._block_kernels import add_combination, add_gram, set_product
from sfm.core.optim._loss_kernels import loss_and_weight
from sfm.core.optim._schur_kernels import damped_diagonal


@nb.njit(cache=True, nogil=True, error_model="numpy")
def squared_errors(image, point, observed, camera, model_ids, params, R, t, X, out):
    """Squared reprojection errors in px²; NaN where there is no projection."""
    for o in range(len(image)):
        i, p = image[o], point[o]
        x0, x1, x2 = X[p, 0], X[p, 1], X[p, 2]
        x = R[i, 0, 0] * x0 + R[i, 0, 1] * x1 + R[i, 0, 2] * x2 + t[i, 0]
        y = R[i, 1, 0] * x0 + R[i, 1, 1] * x1 + R[i, 1, 2] * x2 + t[i, 1]
        z = R[i, 2, 0] * x0 + R[i, 2, 1] * x1 + R[i, 2, 2] * x2 + t[i, 2]
        c = camera[i]
        u, v, ok = project_point(model_ids[c], params[c], x, y, z)
        du, dv = u - observed[o, 0], v - observed[o, 1]
        out[o] = du * du + dv * dv if ok else np.nan


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def linearize(
    first, last, offsets, image, observed, precision, coupling, point_free, camera, model_ids, columns, pose_slot,
    R, t, params, X, loss, scale, lost_cost, H, F, h, V, g, W, B,
):  # fmt: skip
    """Cost ½ Σ ρ of the points `first:last`, and the blocks of their normal equations.

    Adds, for every image, the products of its pose with itself to H (I, 6, 6), those of its camera with the pose
    and with itself to F (I, K, 6 + K), and the gradient to h (I, 6 + K). Fills V and g of the points and W of the
    observations, and adds to B of their couplings with cameras.
    """
    K = columns.shape[1]
    A, Q, J, P, C = np.empty((2, 3)), np.empty((2, 12)), np.empty((2, 6)), np.empty((2, 3)), np.empty((2, K))
    cost = 0.0
    for p in range(first, last):
        x0, x1, x2 = X[p, 0], X[p, 1], X[p, 2]
        v0 = v1 = v2 = v3 = v4 = v5 = g0 = g1 = g2 = 0.0
        for o in range(offsets[p], offsets[p + 1]):
            i = image[o]
            c = camera[i]
            r = R[i]
            x = r[0, 0] * x0 + r[0, 1] * x1 + r[0, 2] * x2 + t[i, 0]
            y = r[1, 0] * x0 + r[1, 1] * x1 + r[1, 2] * x2 + t[i, 1]
            z = r[2, 0] * x0 + r[2, 1] * x1 + r[2, 2] * x2 + t[i, 2]
            u, v, ok = project_point_jacobians(model_ids[c], params[c], x, y, z, A, Q)
            if not ok:
                cost += lost_cost
                W[o, :, :] = 0.0
                continue
            root = precision[o]
            eu, ev = (u - observed[o, 0]) * root, (v - observed[o, 1]) * root
            rho, weight = loss_and_weight(loss, scale, eu * eu + ev * ev)
            cost += 0.5 * rho
            weight = math.sqrt(weight)
            eu, ev = eu * weight, ev * weight
            root *= weight
            a0, a1, a2 = A[0, 0] * root, A[0, 1] * root, A[0, 2] * root
            b0, b1, b2 = A[1, 0] * root, A[1, 1] * root, A[1, 2] * root
            # exp(δ) x = x + ω × x + υ to first order, and a · (ω × x) = ω · (x × a).
            J[0, 0], J[0, 1], J[0, 2] = y * a2 - z * a1, z * a0 - x * a2, x * a1 - y * a0
            J[1, 0], J[1, 1], J[1, 2] = y * b2 - z * b1, z * b0 - x * b2, x * b1 - y * b0
            J[0, 3], J[0, 4], J[0, 5], J[1, 3], J[1, 4], J[1, 5] = a0, a1, a2, b0, b1, b2
            moving = pose_slot[i] >= 0
            if moving:
                add_gram(H[i], J)
                add_combination(h[i], eu, ev, J)
            k = 0
            while k < K and columns[c, k] >= 0:
                ca, cb = Q[0, columns[c, k]] * root, Q[1, columns[c, k]] * root
                C[0, k], C[1, k] = ca, cb
                h[i, 6 + k] += ca * eu + cb * ev
                add_combination(F[i, k], ca, cb, J)
                for a in range(k + 1):
                    F[i, k, 6 + a] += ca * C[0, a] + cb * C[1, a]
                k += 1
            if not point_free[p]:
                continue
            p0 = a0 * r[0, 0] + a1 * r[1, 0] + a2 * r[2, 0]
            p1 = a0 * r[0, 1] + a1 * r[1, 1] + a2 * r[2, 1]
            p2 = a0 * r[0, 2] + a1 * r[1, 2] + a2 * r[2, 2]
            q0 = b0 * r[0, 0] + b1 * r[1, 0] + b2 * r[2, 0]
            q1 = b0 * r[0, 1] + b1 * r[1, 1] + b2 * r[2, 1]
            q2 = b0 * r[0, 2] + b1 * r[1, 2] + b2 * r[2, 2]
            g0, g1, g2 = g0 + p0 * eu + q0 * ev, g1 + p1 * eu + q1 * ev, g2 + p2 * eu + q2 * ev
            v0, v1, v2 = v0 + p0 * p0 + q0 * q0, v1 + p0 * p1 + q0 * q1, v2 + p0 * p2 + q0 * q2
            v3, v4, v5 = v3 + p1 * p1 + q1 * q1, v4 + p1 * p2 + q1 * q2, v5 + p2 * p2 + q2 * q2
            if moving:
                P[0, 0], P[0, 1], P[0, 2], P[1, 0], P[1, 1], P[1, 2] = p0, p1, p2, q0, q1, q2
                set_product(W[o], P, J)
            if k > 0:
                block = B[coupling[o]]
                for a in range(k):
                    block[0, a] += p0 * C[0, a] + q0 * C[1, a]
                    block[1, a] += p1 * C[0, a] + q1 * C[1, a]
                    block[2, a] += p2 * C[0, a] + q2 * C[1, a]
        V[p, 0], V[p, 1], V[p, 2], V[p, 3], V[p, 4], V[p, 5] = v0, v1, v2, v3, v4, v5
        g[p, 0], g[p, 1], g[p, 2] = g0, g1, g2
    return cost


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def try_points(
    first, last, offsets, image, observed, precision, starts, slot, coupling_offsets, coupling_slot, camera, model_ids,
    R, t, params, X, loss, scale, lost_cost, damping, M, V, g, W, B, pose_delta, camera_delta, moved, totals,
):  # fmt: skip
    """Steps of the points `first:last` by back-substitution, and the cost where everything has moved.

    A point whose step would lose projections that it keeps where it stands is left where it stands.
    Fills `moved`, and `totals` with the cost, the promised decrease, |δ|², |X|² and the lost projections.
    """
    K = B.shape[2]
    cost = decrease = step = norm = all_lost = 0.0
    for p in range(first, last):
        q0, q1, q2 = g[p, 0], g[p, 1], g[p, 2]
        for o in range(starts[p], offsets[p + 1]):
            w, d = W[o], pose_delta[slot[o]]
            for a in range(6):
                q0 += w[0, a] * d[a]
                q1 += w[1, a] * d[a]
                q2 += w[2, a] * d[a]
        for e in range(coupling_offsets[p], coupling_offsets[p + 1]):
            for a in range(K):
                s = camera_delta[coupling_slot[e] * K + a]
                q0 += B[e, 0, a] * s
                q1 += B[e, 1, a] * s
                q2 += B[e, 2, a] * s
        d0 = -(M[p, 0] * q0 + M[p, 1] * q1 + M[p, 2] * q2)
        d1 = -(M[p, 1] * q0 + M[p, 3] * q1 + M[p, 4] * q2)
        d2 = -(M[p, 2] * q0 + M[p, 4] * q1 + M[p, 5] * q2)
        best_cost, best_lost = np.inf, offsets[p + 1] - offsets[p] + 1
        s0 = s1 = s2 = 0.0
        for attempt in range(2):
            if attempt == 1:
                d0 = d1 = d2 = 0.0
            x0, x1, x2 = X[p, 0] + d0, X[p, 1] + d1, X[p, 2] + d2
            here, lost = 0.0, 0
            for o in range(offsets[p], offsets[p + 1]):
                i = image[o]
                c = camera[i]
                r = R[i]
                x = r[0, 0] * x0 + r[0, 1] * x1 + r[0, 2] * x2 + t[i, 0]
                y = r[1, 0] * x0 + r[1, 1] * x1 + r[1, 2] * x2 + t[i, 1]
                z = r[2, 0] * x0 + r[2, 1] * x1 + r[2, 2] * x2 + t[i, 2]
                u, v, ok = project_point(model_ids[c], params[c], x, y, z)
                if ok:
                    eu, ev = (u - observed[o, 0]) * precision[o], (v - observed[o, 1]) * precision[o]
                    rho, _ = loss_and_weight(loss, scale, eu * eu + ev * ev)
                    here += 0.5 * rho
                else:
                    here += lost_cost
                    lost += 1
            if lost < best_lost:
                best_cost, best_lost = here, lost
                s0, s1, s2 = d0, d1, d2
                moved[p, 0], moved[p, 1], moved[p, 2] = x0, x1, x2
            if lost == 0:
                break
        cost += best_cost
        all_lost += best_lost
        decrease -= 0.5 * (g[p, 0] * s0 + g[p, 1] * s1 + g[p, 2] * s2)
        f0, f1, f2 = damped_diagonal(V[p], damping)
        decrease += 0.5 * (f0 * s0 * s0 + f1 * s1 * s1 + f2 * s2 * s2)
        step += s0 * s0 + s1 * s1 + s2 * s2
        norm += X[p, 0] * X[p, 0] + X[p, 1] * X[p, 1] + X[p, 2] * X[p, 2]
    totals[0], totals[1], totals[2], totals[3], totals[4] = cost, decrease, step, norm, all_lost


@nb.njit(cache=True, nogil=True, error_model="numpy")
def move_poses(images, delta, wxyz, t, new_wxyz, new_t, R):
    """exp(δ) from the left on the poses of `images`; fills quaternions, translations and rotation matrices."""
    for k in range(len(images)):
        i = images[k]
        w0, w1, w2 = delta[k, 0], delta[k, 1], delta[k, 2]
        u0, u1, u2 = delta[k, 3], delta[k, 4], delta[k, 5]
        square = w0 * w0 + w1 * w1 + w2 * w2
        angle = math.sqrt(square)
        if angle < 1e-4:
            half, b, c = 0.5 - square / 48.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
        else:
            half = math.sin(0.5 * angle) / angle
            b, c = (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
        q0, q1, q2, q3 = math.cos(0.5 * angle), half * w0, half * w1, half * w2
        p0, p1, p2, p3 = wxyz[i, 0], wxyz[i, 1], wxyz[i, 2], wxyz[i, 3]
        n0 = q0 * p0 - q1 * p1 - q2 * p2 - q3 * p3
        n1 = q0 * p1 + q1 * p0 + q2 * p3 - q3 * p2
        n2 = q0 * p2 - q1 * p3 + q2 * p0 + q3 * p1
        n3 = q0 * p3 + q1 * p2 - q2 * p1 + q3 * p0
        scale = 1.0 / math.sqrt(n0 * n0 + n1 * n1 + n2 * n2 + n3 * n3)
        n0, n1, n2, n3 = n0 * scale, n1 * scale, n2 * scale, n3 * scale
        new_wxyz[i, 0], new_wxyz[i, 1], new_wxyz[i, 2], new_wxyz[i, 3] = n0, n1, n2, n3
        R[i, 0, 0], R[i, 0, 1] = 1.0 - 2.0 * (n2 * n2 + n3 * n3), 2.0 * (n1 * n2 - n0 * n3)
        R[i, 0, 2], R[i, 1, 0] = 2.0 * (n1 * n3 + n0 * n2), 2.0 * (n1 * n2 + n0 * n3)
        R[i, 1, 1], R[i, 1, 2] = 1.0 - 2.0 * (n1 * n1 + n3 * n3), 2.0 * (n2 * n3 - n0 * n1)
        R[i, 2, 0], R[i, 2, 1] = 2.0 * (n1 * n3 - n0 * n2), 2.0 * (n2 * n3 + n0 * n1)
        R[i, 2, 2] = 1.0 - 2.0 * (n1 * n1 + n2 * n2)
        # exp(ω) x = x + a ω × x + b ω × (ω × x) with a = sin θ / θ = 1 − c θ², and the same with b, c for Jl(ω).
        a = 1.0 - c * square
        t0, t1, t2 = t[i, 0], t[i, 1], t[i, 2]
        x0, x1, x2 = w1 * t2 - w2 * t1, w2 * t0 - w0 * t2, w0 * t1 - w1 * t0
        y0, y1, y2 = w1 * u2 - w2 * u1, w2 * u0 - w0 * u2, w0 * u1 - w1 * u0
        f0, f1, f2 = b * x0 + c * y0, b * x1 + c * y1, b * x2 + c * y2
        new_t[i, 0] = t0 + u0 + a * x0 + b * y0 + w1 * f2 - w2 * f1
        new_t[i, 1] = t1 + u1 + a * x1 + b * y1 + w2 * f0 - w0 * f2
        new_t[i, 2] = t2 + u2 + a * x2 + b * y2 + w0 * f1 - w1 * f0
