"""Kernels of bundle adjustment; the mathematics is in `system`, the meaning of the arrays in `layout`."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from sfm.bundle import _lane_kernels as lanes
from sfm.core.cameras._kernels import MAX_PARAMS, distortion_limit
from sfm.core.cameras._lane_kernels import BY_PARAMS, LANES, fill_by_param, project_lanes
from sfm.core.optim._schur_kernels import damped_diagonal


@nb.njit(cache=True, nogil=True, error_model="numpy")
def evaluate_images(
    first, last, offsets, point, place, observed, precision, slot, camera, model_ids, limits, column_count, columns,
    R, t, centers, params, X, loss, scale, lost_cost, derive, costs, out, h, F, G, f,
):  # fmt: skip
    """Cost ½ Σ ρ of the images `first:last` and their share of the normal equations; see `system`.

    Args:
        derive: whether there is more to do than to fill `costs` (n,) with 2 × `lost_cost` or ρ of each observation, in
            the order by points; if so, these are left alone.
        offsets, point, place: observations by image (I + 1,), their points and their places in the order by points.
        slot, centers: row of each image's frame, −1 where it does not move, and the centres by row.
        column_count, columns: how many free columns an image shares with others, and which (I, k): parameters, or
            from MAX_PARAMS on the tangent of its sensor.
        out: (n, 9 + 3 k) gets PᵀP, Pᵀe and the products of P with the columns, in the order by points.
        h, F, G, f: (I, 6), (I, 6, k), (I, k, k) and (I, k) get the gradient of the frame, the products of its tangent
            with the columns, those of the columns (lower triangle), and the columns' gradient.
    """
    w = np.zeros(lanes.ROWS * LANES)
    cost = 0.0
    for i in range(first, last):
        c, own, count = camera[i], slot[i] >= 0, column_count[i]
        for begin in range(offsets[i], offsets[i + 1], LANES):
            lanes.fetch(begin, offsets[i + 1], point, observed, precision, X, R[i], t[i], w)
            project_lanes(model_ids[c], params[c], limits[c], w)
            lanes.weigh(loss, scale, lost_cost, w)
            if not derive:
                for n in range(min(LANES, offsets[i + 1] - begin)):
                    costs[place[begin + n]] = w[lanes.COST * LANES + n]
                continue
            lanes.derive_by_point(R[i], w)
            for k in range(count):
                column = columns[i, k]
                if column < MAX_PARAMS:
                    fill_by_param(model_ids[c], params[c], column, w)
                    lanes.derive_by_column(k, BY_PARAMS + 2 * column, w)
                else:
                    lanes.derive_by_sensor(column - MAX_PARAMS, w)
                    lanes.derive_by_column(k, lanes.BY_SENSOR, w)
            if own:
                lanes.derive_by_turn(centers[slot[i]], w)
                for a in range(6):
                    u, v = _tangent_rows(a)
                    h[i, a] += lanes.total(u, lanes.ERROR, v, lanes.ERROR + 1, w)
                    for k in range(count):
                        column = lanes.BY_COLUMN + 2 * k
                        F[i, a, k] += lanes.total(u, column, v, column + 1, w)
            for k in range(count):
                row = lanes.BY_COLUMN + 2 * k
                f[i, k] += lanes.total(row, lanes.ERROR, row + 1, lanes.ERROR + 1, w)
                for j in range(k + 1):
                    column = lanes.BY_COLUMN + 2 * j
                    G[i, k, j] += lanes.total(row, column, row + 1, column + 1, w)
            for n in range(min(LANES, offsets[i + 1] - begin)):
                cost += 0.5 * w[lanes.COST * LANES + n]
                target = out[place[begin + n]]
                for a in range(9 + 3 * count):
                    target[a] = w[(lanes.OUT + a) * LANES + n]
    return cost


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _tangent_rows(a):
    """Rows with the derivatives of u and v by entry `a` of the tangent of the frame."""
    if a < 3:
        return lanes.BY_TURN + a, lanes.BY_TURN + 3 + a
    return lanes.BY_POINT_IN_WORLD + a - 3, lanes.BY_POINT_IN_WORLD + a


@nb.njit(cache=True, nogil=True, error_model="numpy")
def gather_points(
    first, last, offsets, slot, column_count, column_place, image, obs_shared, starts, point_free, rows, V, g, N, B
):  # fmt: skip
    """Sums what images have put into `rows` over the points `first:last`: V, g and the couplings N and B."""
    for p in range(first, last):
        v0 = v1 = v2 = v3 = v4 = v5 = g0 = g1 = g2 = 0.0
        coupling, before = starts[p] - 1, -1
        for o in range(offsets[p], offsets[p + 1]):
            r = rows[o]
            v0, v1, v2, v3, v4, v5 = v0 + r[0], v1 + r[1], v2 + r[2], v3 + r[3], v4 + r[4], v5 + r[5]
            g0, g1, g2 = g0 + r[6], g1 + r[7], g2 + r[8]
            if slot[o] > before:
                before = slot[o]
                coupling += 1
                for a in range(6):
                    N[coupling, a] = r[a]
            elif slot[o] >= 0:
                for a in range(6):
                    N[coupling, a] += r[a]
            if point_free[p]:
                i = image[o]
                for k in range(column_count[i]):
                    block, a = B[obs_shared[o, column_place[i, k] // 6]], column_place[i, k] % 6
                    block[0, a] += r[9 + 3 * k]
                    block[1, a] += r[10 + 3 * k]
                    block[2, a] += r[11 + 3 * k]
        if not point_free[p]:
            v0 = v1 = v2 = v3 = v4 = v5 = g0 = g1 = g2 = 0.0
        V[p, 0], V[p, 1], V[p, 2], V[p, 3], V[p, 4], V[p, 5] = v0, v1, v2, v3, v4, v5
        g[p, 0], g[p, 1], g[p, 2] = g0, g1, g2


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def move_points(
    first, last, starts, slot, N, shared_starts, shared_slot, B, centers, X, M, g, delta, moved
):  # fmt: skip
    """The points `first:last` after the step that back-substitution gives them."""
    for p in range(first, last):
        y0, y1, y2 = X[p, 0], X[p, 1], X[p, 2]
        if not M[p, 0] + M[p, 3] + M[p, 5] > 0.0:
            moved[p, 0], moved[p, 1], moved[p, 2] = y0, y1, y2
            continue
        q0, q1, q2 = g[p, 0], g[p, 1], g[p, 2]
        for e in range(starts[p], starts[p + 1]):
            s, n = slot[e], N[e]
            d = delta[s]
            u0, u1, u2 = y0 - centers[s, 0], y1 - centers[s, 1], y2 - centers[s, 2]
            w0 = d[1] * u2 - d[2] * u1 + d[3]
            w1 = d[2] * u0 - d[0] * u2 + d[4]
            w2 = d[0] * u1 - d[1] * u0 + d[5]
            q0 += n[0] * w0 + n[1] * w1 + n[2] * w2
            q1 += n[1] * w0 + n[3] * w1 + n[4] * w2
            q2 += n[2] * w0 + n[4] * w1 + n[5] * w2
        for e in range(shared_starts[p], shared_starts[p + 1]):
            d, block = delta[shared_slot[e]], B[e]
            for a in range(6):
                q0 += block[0, a] * d[a]
                q1 += block[1, a] * d[a]
                q2 += block[2, a] * d[a]
        moved[p, 0] = y0 - (M[p, 0] * q0 + M[p, 1] * q1 + M[p, 2] * q2)
        moved[p, 1] = y1 - (M[p, 1] * q0 + M[p, 3] * q1 + M[p, 4] * q2)
        moved[p, 2] = y2 - (M[p, 2] * q0 + M[p, 4] * q1 + M[p, 5] * q2)


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def settle_points(first, last, offsets, X, lost_cost, damping, V, g, costs, costs_here, moved, totals):
    """Adds up the points `first:last` of a trial, and leaves in its place a point that would lose projections there.

    `costs` holds ρ of each observation at `moved`, `costs_here` at `X`, NaN where there is no projection.
    Fills `totals` with the cost, the promised decrease, |δ|², |X|² and the lost projections.
    """
    cost = decrease = step = norm = all_lost = 0.0
    for p in range(first, last):
        if offsets[p] == offsets[p + 1]:
            continue
        there, lost = _cost_of_point(offsets[p], offsets[p + 1], costs, lost_cost)
        if lost > 0:
            here, lost_here = _cost_of_point(offsets[p], offsets[p + 1], costs_here, lost_cost)
            if lost_here < lost:
                there, lost = here, lost_here
                moved[p, 0], moved[p, 1], moved[p, 2] = X[p, 0], X[p, 1], X[p, 2]
        s0, s1, s2 = moved[p, 0] - X[p, 0], moved[p, 1] - X[p, 1], moved[p, 2] - X[p, 2]
        cost += there
        all_lost += lost
        decrease -= 0.5 * (g[p, 0] * s0 + g[p, 1] * s1 + g[p, 2] * s2)
        f0, f1, f2 = damped_diagonal(V[p], damping)
        decrease += 0.5 * (f0 * s0 * s0 + f1 * s1 * s1 + f2 * s2 * s2)
        step += s0 * s0 + s1 * s1 + s2 * s2
        norm += X[p, 0] * X[p, 0] + X[p, 1] * X[p, 1] + X[p, 2] * X[p, 2]
    totals[0], totals[1], totals[2], totals[3], totals[4] = cost, decrease, step, norm, all_lost


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _cost_of_point(first, last, costs, lost_cost):
    """Cost of the observations `first:last`, and how many of them have no projection."""
    cost, lost = 0.0, 0
    for o in range(first, last):
        if math.isnan(costs[o]):
            cost += lost_cost
            lost += 1
        else:
            cost += 0.5 * costs[o]
    return cost, lost


@nb.njit(cache=True, nogil=True, error_model="numpy")
def squared_limits(model_ids, params):
    """(C,) the square of the radius up to which each camera's distortion can be inverted."""
    out = np.empty(len(model_ids))
    for c in range(len(model_ids)):
        limit = distortion_limit(model_ids[c], params[c])
        out[c] = limit * limit
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def turn_poses(frames, delta, wxyz, centers, R, t, new_wxyz, new_centers, new_R, new_t):
    """Moves the poses `frames` by δ = (ω, υ) in world axes: R exp(ω), and the centre to C − υ; those of δ = 0 stay."""
    for k in range(len(frames)):
        i, d = frames[k], delta[k]
        if d[0] == 0.0 and d[1] == 0.0 and d[2] == 0.0 and d[3] == 0.0 and d[4] == 0.0 and d[5] == 0.0:
            for a in range(4):
                new_wxyz[i, a] = wxyz[i, a]
            for a in range(3):
                new_centers[i, a], new_t[i, a] = centers[i, a], t[i, a]
                for b in range(3):
                    new_R[i, a, b] = R[i, a, b]
            continue
        square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        angle = math.sqrt(square)
        half = 0.5 - square / 48.0 if angle < 1e-4 else math.sin(0.5 * angle) / angle
        q0, q1, q2, q3 = math.cos(0.5 * angle), half * d[0], half * d[1], half * d[2]
        p0, p1, p2, p3 = wxyz[i, 0], wxyz[i, 1], wxyz[i, 2], wxyz[i, 3]
        w = p0 * q0 - p1 * q1 - p2 * q2 - p3 * q3
        x = p0 * q1 + p1 * q0 + p2 * q3 - p3 * q2
        y = p0 * q2 - p1 * q3 + p2 * q0 + p3 * q1
        z = p0 * q3 + p1 * q2 - p2 * q1 + p3 * q0
        scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
        w, x, y, z = w * scale, x * scale, y * scale, z * scale
        new_wxyz[i, 0], new_wxyz[i, 1], new_wxyz[i, 2], new_wxyz[i, 3] = w, x, y, z
        r = new_R[i]
        r[0, 0], r[0, 1], r[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        r[1, 0], r[1, 1], r[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        r[2, 0], r[2, 1], r[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        c0, c1, c2 = centers[i, 0] - d[3], centers[i, 1] - d[4], centers[i, 2] - d[5]
        new_centers[i, 0], new_centers[i, 1], new_centers[i, 2] = c0, c1, c2
        for a in range(3):
            new_t[i, a] = -(r[a, 0] * c0 + r[a, 1] * c1 + r[a, 2] * c2)
