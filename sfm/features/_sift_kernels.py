"""Extrema, orientations and descriptors of SIFT on one octave of the scale space.

A `stack` (L, H, W) holds the Gaussian images of an octave, each blurred more than the one before. Differences of
neighbours are taken where they are needed, and never stored. Coordinates are indices into these images.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_MOVES = 5
_WORD = 8
_ORIENTATION_BINS = 36
_MARGIN = 3
_CELLS, _DIRECTIONS, _SAMPLES_A_CELL = 4, 8, 4
_SAMPLES = (_CELLS + 1) * _SAMPLES_A_CELL


@njit(cache=True, nogil=True)
def find_extrema(stack, threshold, border, found):
    """Local extrema of the differences in scale and space, at least `threshold` in size: rows of layer, y, x.

    Fills `found` (N, 3) up to its end and returns how many there are, which may be more.
    """
    differences, height, width = stack.shape[0] - 1, stack.shape[1], stack.shape[2]
    rows = np.zeros((3, differences, width), np.float32)
    flags = np.zeros((width // _WORD + 1) * _WORD, np.uint8)
    words = flags.view(np.uint64)
    count = 0
    for bottom in range(border - 1, height - border + 1):
        for k in range(differences):
            _subtract(stack[k + 1, bottom], stack[k, bottom], rows[bottom % 3, k])
        y = bottom - 1
        if y < border:
            continue
        above, middle, below = rows[(y - 1) % 3], rows[y % 3], rows[bottom % 3]
        for k in range(1, differences - 1):
            _flag(above[k], middle[k], below[k], threshold, border, flags)
            for word in range(len(words)):
                if words[word] == 0:
                    continue
                for x in range(_WORD * word, _WORD * word + _WORD):
                    if flags[x] != 0 and _is_extreme(above, middle, below, k, x):
                        if count < len(found):
                            found[count, 0], found[count, 1], found[count, 2] = k, y, x
                        count += 1
    return count


@njit(cache=True, nogil=True)
def _subtract(a, b, out):
    for x in range(len(out)):
        out[x] = a[x] - b[x]


@njit(cache=True, nogil=True)
def _flag(above, row, below, threshold, border, flags):
    """Marks what is the largest or the smallest of itself and the four next to it, with vector instructions."""
    # Slices, since an index that might be negative keeps a loop from being vectorised: it counts from the end.
    size = len(row) - 2 * border
    middle, out = row[border : border + size], flags[border : border + size]
    left, right = row[border - 1 : border - 1 + size], row[border + 1 : border + 1 + size]
    up, down = above[border : border + size], below[border : border + size]
    for x in range(size):
        value = middle[x]
        is_highest = (value > threshold) & (value >= left[x]) & (value >= right[x])
        is_lowest = (value < -threshold) & (value <= left[x]) & (value <= right[x])
        is_highest &= (value >= up[x]) & (value >= down[x])
        is_lowest &= (value <= up[x]) & (value <= down[x])
        out[x] = is_highest | is_lowest


@njit(cache=True, nogil=True)
def _is_extreme(above, middle, below, k, x):
    """Whether a value is the largest or the smallest of the 27 around it."""
    value = middle[k, x]
    for rows in (middle, above, below):
        for layer in range(k - 1, k + 2):
            a, b, c = rows[layer, x - 1], rows[layer, x], rows[layer, x + 1]
            if value > 0:
                if a > value or b > value or c > value:
                    return False
            elif a < value or b < value or c < value:
                return False
    return True


@njit(cache=True, nogil=True)
def refine_extrema(stack, found, count, min_contrast, max_edge_ratio, border, refined):
    """Moves extrema to the vertex of the parabola through their neighbours; rows of x, y, layer and contrast.

    Drops those that run away, have less contrast there, or lie on an edge. Returns how many are left.
    """
    kept = 0
    layers, height, width = stack.shape[0] - 3, stack.shape[1], stack.shape[2]
    max_trace = (max_edge_ratio + 1) ** 2 / max_edge_ratio
    d = np.empty((3, 3, 3), np.float64)
    for n in range(count):
        k, y, x = found[n, 0], found[n, 1], found[n, 2]
        settled = False
        gx = gy = gs = dx = dy = ds = xx = yy = xy = 0.0
        for _ in range(_MOVES):
            for i in range(3):
                for j in range(3):
                    for m in range(3):
                        d[i, j, m] = stack[k + i, y + j - 1, x + m - 1] - stack[k + i - 1, y + j - 1, x + m - 1]
            gx, gy, gs = (
                0.5 * (d[1, 1, 2] - d[1, 1, 0]),
                0.5 * (d[1, 2, 1] - d[1, 0, 1]),
                0.5 * (d[2, 1, 1] - d[0, 1, 1]),
            )
            twice = 2 * d[1, 1, 1]
            xx = d[1, 1, 2] + d[1, 1, 0] - twice
            yy = d[1, 2, 1] + d[1, 0, 1] - twice
            ss = d[2, 1, 1] + d[0, 1, 1] - twice
            xy = 0.25 * (d[1, 2, 2] - d[1, 2, 0] - d[1, 0, 2] + d[1, 0, 0])
            xs = 0.25 * (d[2, 1, 2] - d[2, 1, 0] - d[0, 1, 2] + d[0, 1, 0])
            ys = 0.25 * (d[2, 2, 1] - d[2, 0, 1] - d[0, 2, 1] + d[0, 0, 1])
            minor_x, minor_y, minor_s = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - yy * xs
            determinant = xx * minor_x + xy * minor_y + xs * minor_s
            if determinant == 0:
                break
            dx = -(minor_x * gx + minor_y * gy + minor_s * gs) / determinant
            dy = -(minor_y * gx + (xx * ss - xs * xs) * gy + (xs * xy - xx * ys) * gs) / determinant
            ds = -(minor_s * gx + (xs * xy - xx * ys) * gy + (xx * yy - xy * xy) * gs) / determinant
            if abs(dx) < 0.5 and abs(dy) < 0.5 and abs(ds) < 0.5:
                settled = True
                break
            if not (abs(dx) < width and abs(dy) < height and abs(ds) < layers):
                break
            x, y, k = x + round(dx), y + round(dy), k + round(ds)
            if not (1 <= k <= layers and border <= y < height - border and border <= x < width - border):
                break
        if not settled:
            continue
        contrast = abs(d[1, 1, 1] + 0.5 * (gx * dx + gy * dy + gs * ds))
        trace, area = xx + yy, xx * yy - xy * xy
        if contrast < min_contrast or area <= 0 or trace * trace >= max_trace * area:
            continue
        refined[kept, 0], refined[kept, 1], refined[kept, 2], refined[kept, 3] = x + dx, y + dy, k + ds, contrast
        kept += 1
    return kept


@njit(cache=True, nogil=True)
def orientations(stack, keypoints, scales, angles):
    """Main directions of the gradient around keypoints (x, y, layer, ...), in radians from x to y.

    `scales` are σ in pixels of the octave. Fills up to four columns of `angles` a row, NaN after the last: the
    peaks of a histogram with a Gaussian window of 1.5 σ that reach 0.8 of the highest.
    """
    height, width = stack.shape[1], stack.shape[2]
    bins, rounding = np.float32(_ORIENTATION_BINS), np.float32(_MARGIN + 0.5)
    # Bins count from `_MARGIN`: before and after the circle there is room for its continuation.
    raw, smooth = np.empty(_ORIENTATION_BINS + 2 * _MARGIN), np.empty(_ORIENTATION_BINS + 2 * _MARGIN)
    largest = 0.0
    for scale in scales:
        largest = max(largest, scale)
    side = 2 * round(4.5 * largest) + 1
    across, gx, gy = np.empty(side, np.float32), np.empty(side**2, np.float32), np.empty(side**2, np.float32)
    for n in range(len(keypoints)):
        image = stack[round(keypoints[n, 2])]
        column, line = round(keypoints[n, 0]), round(keypoints[n, 1])
        radius = round(4.5 * scales[n])
        for i in range(2 * radius + 1):
            across[i] = math.exp(-((i - radius) ** 2) / (4.5 * scales[n] ** 2))
        filled = 0
        for y in range(max(line - radius, 1), min(line + radius, height - 2) + 1):
            reach = round(math.sqrt(radius**2 - (y - line) ** 2))
            left, right = max(column - reach, 1), min(column + reach, width - 2)
            size = right - left + 1
            above, below = image[y - 1, left : right + 1], image[y + 1, left : right + 1]
            before, after = image[y, left - 1 : right], image[y, left + 1 : right + 2]
            along, weights = across[y - line + radius], across[left - column + radius : right - column + radius + 1]
            row_x, row_y = gx[filled : filled + size], gy[filled : filled + size]
            for i in range(size):
                weight = along * weights[i]
                row_x[i] = weight * (after[i] - before[i])
                row_y[i] = weight * (below[i] - above[i])
            filled += size
        _to_polar(gx[:filled], gy[:filled])
        raw[:] = 0
        for i in range(filled):
            raw[np.uint32(gy[i] * bins + rounding)] += gx[i]
        raw[_MARGIN] += raw[_MARGIN + _ORIENTATION_BINS]
        peak_angles(raw, smooth, angles[n])


@njit(cache=True, nogil=True)
def peak_angles(raw, smooth, angles):
    """The directions of the peaks of a circular histogram, after smoothing, by parabolas through three bins."""
    bins = len(raw) - 2 * _MARGIN
    for b in range(_MARGIN):
        raw[b], raw[_MARGIN + bins + b] = raw[bins + b], raw[_MARGIN + b]
    highest = 0.0
    for b in range(_MARGIN - 1, _MARGIN + bins + 1):
        smooth[b] = 6 * raw[b] + 4 * (raw[b - 1] + raw[b + 1]) + raw[b - 2] + raw[b + 2]
        if smooth[b] > highest:
            highest = smooth[b]
    peaks = 0
    angles[:] = np.nan
    for b in range(_MARGIN, _MARGIN + bins):
        before, here, after = smooth[b - 1], smooth[b], smooth[b + 1]
        if here > before and here > after and here >= 0.8 * highest and peaks < len(angles):
            vertex = b - _MARGIN + 0.5 * (before - after) / (before + after - 2 * here)
            angles[peaks] = vertex * 2 * math.pi / bins
            peaks += 1


@njit(cache=True, nogil=True)
def _to_polar(x, y):
    """Replaces x by the length of the vector and y by its angle in turns, 0 to 1, exact to 1e-5 of a turn."""
    for i in range(len(x)):
        across, along = abs(x[i]), abs(y[i])
        larger, smaller = (across, along) if across > along else (along, across)
        t = smaller / (larger + np.float32(1e-30))
        s = t * t
        series = np.float32(0.0286704) + s * (np.float32(-0.0135494) + s * np.float32(0.0033160))
        turn = t * (np.float32(0.1591337) + s * (np.float32(-0.0525686) + s * series))
        turn = turn if across > along else np.float32(0.25) - turn
        turn = turn if x[i] >= 0 else np.float32(0.5) - turn
        turn = turn if y[i] >= 0 else np.float32(1) - turn
        x[i] = math.sqrt(x[i] * x[i] + y[i] * y[i])
        y[i] = turn


@njit(cache=True, nogil=True)
def describe(stack, keypoints, scales, angles, histograms):
    """Gradient histograms (N, 128) of 4 × 4 cells of 3 σ and 8 directions, in the frame of each keypoint.

    The patch is sampled on a grid of 4 × 4 points a cell, turned with the keypoint; each sample takes the gradient
    of the nearest pixel, and is shared among neighbouring cells and directions.
    """
    height, width = stack.shape[1], stack.shape[2]
    offsets, window = np.empty(_SAMPLES, np.float32), np.empty(_SAMPLES, np.float32)
    share = np.empty(_SAMPLES, np.float32)
    cell = np.empty(_SAMPLES, np.uint32)
    for i in range(_SAMPLES):
        offsets[i] = (i + 0.5) / _SAMPLES_A_CELL - 0.5 * (_CELLS + 1)
        place = offsets[i] + 0.5 * (_CELLS + 1)
        cell[i] = int(place)
        share[i] = place - cell[i]
        window[i] = math.exp(-(offsets[i] ** 2) / (0.5 * _CELLS**2))
    gx, gy = np.empty(_SAMPLES**2, np.float32), np.empty(_SAMPLES**2, np.float32)
    pixels = np.empty(_SAMPLES, np.uint32)
    bins = _DIRECTIONS + 1
    line, table = np.empty((_CELLS + 2) * bins, np.float32), np.empty((_CELLS + 2, (_CELLS + 2) * bins), np.float32)
    highest_x, highest_y = np.float32(width - 2), np.float32(height - 2)
    one, eight = np.float32(1), np.float32(_DIRECTIONS)
    for n in range(len(keypoints)):
        image = stack[round(keypoints[n, 2])].ravel()
        step_x = np.float32(3 * scales[n] * math.cos(angles[n]))
        step_y = np.float32(3 * scales[n] * math.sin(angles[n]))
        turn = angles[n] / (2 * math.pi)
        start = np.float32(turn - math.floor(turn))
        for r in range(_SAMPLES):
            from_x = np.float32(keypoints[n, 0] + 0.5) - offsets[r] * step_y
            from_y = np.float32(keypoints[n, 1] + 0.5) + offsets[r] * step_x
            first = r * _SAMPLES
            # Outside of the image the border is repeated.
            for c in range(_SAMPLES):
                x, y = from_x + offsets[c] * step_x, from_y + offsets[c] * step_y
                x = min(max(x, one), highest_x)
                y = min(max(y, one), highest_y)
                pixels[c] = np.uint32(y) * np.uint32(width) + np.uint32(x)
            for c in range(_SAMPLES):
                at = pixels[c]
                gx[first + c] = image[at + np.uint32(1)] - image[at - np.uint32(1)]
                gy[first + c] = image[at - np.uint32(width)] - image[at + np.uint32(width)]
        _to_polar(gx, gy)
        for i in range(len(gy)):
            direction = gy[i] + start
            gy[i] = eight * (direction if direction < one else direction - one)
        table[:] = 0
        for r in range(_SAMPLES):
            line[:] = 0
            for c in range(_SAMPLES):
                i = r * _SAMPLES + c
                o = min(np.uint32(gy[i]), np.uint32(_DIRECTIONS - 1))
                w, v = gy[i] - np.float32(o), share[c]
                size = window[c] * gx[i]
                upper = w * size
                lower = size - upper
                at = cell[c] * np.uint32(bins) + o
                beyond = at + np.uint32(bins)
                line[at] += lower - v * lower
                line[at + np.uint32(1)] += upper - v * upper
                line[beyond] += v * lower
                line[beyond + np.uint32(1)] += v * upper
            a, b = table[cell[r]], table[cell[r] + 1]
            after = window[r] * share[r]
            before = window[r] - after
            for i in range(len(line)):
                a[i] += before * line[i]
                b[i] += after * line[i]
        i = 0
        for r in range(1, _CELLS + 1):
            for c in range(1, _CELLS + 1):
                first = c * bins
                table[r, first] += table[r, first + _DIRECTIONS]
                for o in range(_DIRECTIONS):
                    histograms[n, i] = table[r, first + o]
                    i += 1
