"""The scan of a block of squared distances for the two nearest in both directions."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def scan_block(dots, first_row, squared1, squared2, best1, second1, index1, best2, second2, index2):
    """Updates the nearest and second nearest of both images by rows `first_row…` of the table of distances.

    The squared distance of row i and column j is |a|² + |b|² − 2 a·b. All its terms are integers below 2²⁴, exact
    in float32, so no order of summation matters. Strict comparisons in ascending order make the lower index win a tie.
    """
    rows, columns = dots.shape
    for r in range(rows):
        i = first_row + r
        offset = squared1[i]
        for j in range(columns):  # no branches and no dependence between columns: vector instructions
            distance = offset + squared2[j] - np.float32(2) * dots[r, j]
            dots[r, j] = distance
            nearer = distance < best2[j]
            index2[j] = np.int32(i) if nearer else index2[j]
            second2[j] = min(second2[j], max(distance, best2[j]))
            best2[j] = min(best2[j], distance)
        best, second, index = best1[i], second1[i], index1[i]
        for j in range(columns):
            distance = dots[r, j]
            if distance < second:
                if distance < best:
                    second, best, index = best, distance, np.int32(j)
                else:
                    second = distance
        best1[i], second1[i], index1[i] = best, second, index


@njit(cache=True, nogil=True)
def nearest_cells(dots, half_squared, cells):
    """Fills `cells` (n, P) with the cells whose centres are nearest, the nearest first; the lower one wins a tie.

    |x − c|² is smallest where x · c − ½ |c|² is largest; `dots` (n, K) are the products x · c.
    """
    rows, count = dots.shape
    width = cells.shape[1]
    largest = np.empty(width, np.float32)
    for r in range(rows):
        held = 0
        for c in range(count):
            value = dots[r, c] - half_squared[c]
            if held == width and value <= largest[width - 1]:
                continue
            held = min(held + 1, width)
            k = held - 1
            while k > 0 and largest[k - 1] < value:
                largest[k], cells[r, k] = largest[k - 1], cells[r, k - 1]
                k -= 1
            largest[k], cells[r, k] = value, c


@njit(cache=True, nogil=True)
def group(labels, starts, order):
    """Sorts the positions of `labels` (n,) by label, stably: label k has `order[starts[k]:starts[k + 1]]`."""
    for k in range(len(starts)):
        starts[k] = 0
    for label in labels:
        starts[label + 1] += 1
    for k in range(1, len(starts)):
        starts[k] += starts[k - 1]
    free = starts[:-1].copy()
    for position in range(len(labels)):
        label = labels[position]
        order[free[label]] = position
        free[label] += 1


@njit(cache=True, nogil=True)
def gather(source, rows, out):
    """out[k] = source[rows[k]]."""
    for k in range(len(rows)):
        row = rows[k]
        for d in range(source.shape[1]):
            out[k, d] = source[row, d]


@njit(cache=True, nogil=True)
def scan_cell(dots, rows, first_column, squared1, squared2, best1, second1, index1, best2, second2, index2):
    """As `scan_block`, for some rows of image 1 and the columns `first_column…` of image 2."""
    columns = dots.shape[1]
    # Slices: with an offset in the index, which might be negative, the loop would not become vector instructions.
    near, next_, index_of = (
        best2[first_column : first_column + columns],
        second2[first_column : first_column + columns],
        index2[first_column : first_column + columns],
    )
    squared = squared2[first_column : first_column + columns]
    for r in range(len(rows)):
        i = rows[r]
        offset, line = squared1[i], dots[r]
        for c in range(columns):
            distance = offset + squared[c] - np.float32(2) * line[c]
            line[c] = distance
            index_of[c] = i if distance < near[c] else index_of[c]
            next_[c] = min(next_[c], max(distance, near[c]))
            near[c] = min(near[c], distance)
        best, second, index = best1[i], second1[i], index1[i]
        for c in range(columns):
            distance = line[c]
            if distance < second:
                if distance < best:
                    second, best, index = best, distance, np.int32(first_column + c)
                else:
                    second = distance
        best1[i], second1[i], index1[i] = best, second, index
