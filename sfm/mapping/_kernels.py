"""Kernels of the mapper: building, triangulating, completing and filtering tracks, and scoring next images.

Observations are rows of flat columns in the order of the tracks: `image`, `xy` (px), `ray` (unit, camera frame), and
`on`, whether the observation belongs to the point of its track. Images count from 0 in the mapper's own order.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.core.cameras._kernels import project_point
from sfm.core.geometry._triangulation_kernels import (
    range_along,
    triangulate_rays_refined,
    triangulate_two_rays,
    triangulation_angle,
)

# All pairs of a track of six views; longer tracks try as many, spread evenly over their pairs.
_TRIED_PAIRS = 15


@njit(cache=True, nogil=True, error_model="numpy")
def join_matches(edges, keypoint_image, keypoint_xy, image_count, near_px):
    """Labels of keypoints (K,): the smallest keypoint of the track, or −1 for one that is in none.

    `edges` (M, 2) are matched keypoints, the most trustworthy first. An edge that would bring two keypoints of one
    image, further apart than `near_px`, into one track is left out: a wrong match then cannot merge two points.
    """
    count = len(keypoint_image)
    label = np.arange(count).astype(np.int32)
    following = np.arange(count).astype(np.int32)  # circular lists of the members of each track
    size = np.ones(count, np.int32)
    seen_by = np.full(image_count, -1, np.int64)
    seen_keypoint = np.zeros(image_count, np.int32)
    limit = near_px * near_px
    for e in range(len(edges)):
        a, b = label[edges[e, 0]], label[edges[e, 1]]
        if a == b:
            continue
        if size[a] < size[b]:
            a, b = b, a
        k = b
        while True:
            seen_by[keypoint_image[k]] = e
            seen_keypoint[keypoint_image[k]] = k
            k = following[k]
            if k == b:
                break
        conflict = False
        k = a
        while True:
            if seen_by[keypoint_image[k]] == e:
                other = seen_keypoint[keypoint_image[k]]
                dx = keypoint_xy[k, 0] - keypoint_xy[other, 0]
                dy = keypoint_xy[k, 1] - keypoint_xy[other, 1]
                if dx * dx + dy * dy > limit:
                    conflict = True
                    break
            k = following[k]
            if k == a:
                break
        if conflict:
            continue
        k = b
        while True:
            label[k] = a
            k = following[k]
            if k == b:
                break
        following[a], following[b] = following[b], following[a]
        size[a] += size[b]
    smallest = np.full(count, count, np.int32)
    for k in range(count):
        smallest[label[k]] = min(smallest[label[k]], k)
    for k in range(count):
        label[k] = smallest[label[k]] if size[label[k]] > 1 else -1
    return label


@njit(cache=True, nogil=True, error_model="numpy")
def _squared_error(R, t, model_id, params, X, xy):
    """Squared reprojection error in px², inf where the point has no pixel."""
    x = R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]
    y = R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]
    z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
    u, v, ok = project_point(np.int64(model_id), params, x, y, z)
    if not ok:
        return np.inf
    return (u - xy[0]) ** 2 + (v - xy[1]) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def _copy(values, out):
    """Three numbers; an assignment of arrays would compile the texts of its errors for more than a second."""
    for i in range(3):
        out[i] = values[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _camera_center(R, t, out):
    for i in range(3):
        out[i] = -(R[0, i] * t[0] + R[1, i] * t[1] + R[2, i] * t[2])


@njit(cache=True, nogil=True, error_model="numpy")
def triangulate_tracks(
    tracks, offsets, image, xy, ray, on, points, has_point,
    registered, R, t, image_camera, model_ids, params, max_error_px, min_angle,
):  # fmt: skip
    """Gives points to tracks that lack one, and observations of registered images to points that they fit.

    Returns:
        How many points were made and how many observations were added to older points.
    """
    limit = max_error_px * max_error_px
    made, added = 0, 0
    X, best_X = np.empty(3), np.empty(3)
    center1, center2 = np.empty(3), np.empty(3)
    for track in tracks:
        first, last = offsets[track], offsets[track + 1]
        seen = np.empty(last - first, np.int64)
        k = 0
        for o in range(first, last):
            if registered[image[o]]:
                seen[k] = o
                k += 1
        if has_point[track]:
            for s in range(k):
                o = seen[s]
                i = image[o]
                c = image_camera[i]
                if not on[o] and _squared_error(R[i], t[i], model_ids[c], params[c], points[track], xy[o]) <= limit:
                    on[o] = True
                    added += 1
            continue
        if k < 2:
            continue
        pairs = k * (k - 1) // 2
        step = max(1, pairs // _TRIED_PAIRS)
        best_count, best_cost = 0, np.inf
        index = -1
        for a in range(k):
            for b in range(a + 1, k):
                index += 1
                if index % step:
                    continue
                oa, ob = seen[a], seen[b]
                ia, ib = image[oa], image[ob]
                if not triangulate_two_rays(R[ia], t[ia], ray[oa], R[ib], t[ib], ray[ob], X):
                    continue
                if range_along(R[ia], t[ia], ray[oa], X) <= 0 or range_along(R[ib], t[ib], ray[ob], X) <= 0:
                    continue
                _camera_center(R[ia], t[ia], center1)
                _camera_center(R[ib], t[ib], center2)
                if triangulation_angle(center1, center2, X) < min_angle:
                    continue
                count, cost = 0, 0.0
                for s in range(k):
                    i = image[seen[s]]
                    c = image_camera[i]
                    error = _squared_error(R[i], t[i], model_ids[c], params[c], X, xy[seen[s]])
                    if error <= limit:
                        count += 1
                        cost += error
                if count > best_count or (count == best_count and cost < best_cost):
                    best_count, best_cost = count, cost
                    _copy(X, best_X)
        if best_count < 2:
            continue
        if best_count > 2:
            Rs, ts, rays = np.empty((best_count, 3, 3)), np.empty((best_count, 3)), np.empty((best_count, 3))
            j = 0
            for s in range(k):
                i = image[seen[s]]
                c = image_camera[i]
                if _squared_error(R[i], t[i], model_ids[c], params[c], best_X, xy[seen[s]]) <= limit:
                    _copy(t[i], ts[j])
                    _copy(ray[seen[s]], rays[j])
                    for row in range(3):
                        _copy(R[i, row], Rs[j, row])
                    j += 1
            if triangulate_rays_refined(Rs, ts, rays, X):
                count = 0
                for s in range(k):
                    i = image[seen[s]]
                    c = image_camera[i]
                    count += _squared_error(R[i], t[i], model_ids[c], params[c], X, xy[seen[s]]) <= limit
                if count >= best_count:
                    _copy(X, best_X)
        for s in range(k):
            i = image[seen[s]]
            c = image_camera[i]
            on[seen[s]] = _squared_error(R[i], t[i], model_ids[c], params[c], best_X, xy[seen[s]]) <= limit
        _copy(best_X, points[track])
        has_point[track] = True
        made += 1
    return made, added


@njit(cache=True, nogil=True, error_model="numpy")
def filter_tracks(
    tracks, offsets, image, xy, on, points, has_point,
    R, t, image_camera, model_ids, params, max_error_px, min_angle,
):  # fmt: skip
    """Drops observations that miss by more than `max_error_px`, then points with one view or too small an angle.

    Returns:
        How many observations were dropped, those of dropped points included.
    """
    limit = max_error_px * max_error_px
    dropped = 0
    center1, center2 = np.empty(3), np.empty(3)
    for track in tracks:
        if not has_point[track]:
            continue
        first, last = offsets[track], offsets[track + 1]
        left = 0
        for o in range(first, last):
            if on[o]:
                i = image[o]
                c = image_camera[i]
                if _squared_error(R[i], t[i], model_ids[c], params[c], points[track], xy[o]) <= limit:
                    left += 1
                else:
                    on[o] = False
                    dropped += 1
        wide = False
        for a in range(first, last):
            if wide or left < 2:
                break
            if not on[a]:
                continue
            _camera_center(R[image[a]], t[image[a]], center1)
            for b in range(a + 1, last):
                if on[b]:
                    _camera_center(R[image[b]], t[image[b]], center2)
                    if triangulation_angle(center1, center2, points[track]) >= min_angle:
                        wide = True
                        break
        if not wide:
            has_point[track] = False
            for o in range(first, last):
                dropped += on[o]
                on[o] = False
    return dropped


@njit(cache=True, nogil=True, error_model="numpy")
def mean_errors(offsets, image, xy, on, points, has_point, R, t, image_camera, model_ids, params):
    """Mean reprojection error in px of each track's point, −1 for tracks without one."""
    errors = np.full(len(has_point), -1.0)
    for track in range(len(has_point)):
        if not has_point[track]:
            continue
        total, count = 0.0, 0
        for o in range(offsets[track], offsets[track + 1]):
            if on[o]:
                i = image[o]
                c = image_camera[i]
                total += np.sqrt(_squared_error(R[i], t[i], model_ids[c], params[c], points[track], xy[o]))
                count += 1
        errors[track] = total / count
    return errors


@njit(cache=True, nogil=True, error_model="numpy")
def visibility_scores(images, image_offsets, image_observations, track_of, has_point, xy, sizes, levels):
    """How many points each image could see, and how evenly they spread over it.

    The score counts occupied cells on grids of 2, 4, … 2^levels cells a side, a finer cell weighing as its grid.
    """
    counts = np.zeros(len(images), np.int64)
    scores = np.zeros(len(images), np.int64)
    side = 1 << levels
    occupied = np.empty((side, side), np.bool_)
    for row in range(len(images)):
        i = images[row]
        occupied[:] = False
        for k in range(image_offsets[i], image_offsets[i + 1]):
            o = image_observations[k]
            if has_point[track_of[o]]:
                counts[row] += 1
                x = min(max(int(xy[o, 0] / sizes[i, 0] * side), 0), side - 1)
                y = min(max(int(xy[o, 1] / sizes[i, 1] * side), 0), side - 1)
                occupied[y, x] = True
        n = side
        while n >= 2:
            cells = 0
            for y in range(n):
                for x in range(n):
                    cells += occupied[y, x]
            scores[row] += cells * n * n
            n //= 2
            for y in range(n):
                for x in range(n):
                    occupied[y, x] = (
                        occupied[2 * y, 2 * x]
                        or occupied[2 * y + 1, 2 * x]
                        or occupied[2 * y, 2 * x + 1]
                        or occupied[2 * y + 1, 2 * x + 1]
                    )
    return counts, scores
