"""Counting the matches of one image with many."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def count_matches(dots, squared1, squared2, offsets, max_ratio_squared, counts):
    """Mutual nearest neighbours of one image and each of several, whose distances pass the ratio test on both sides.

    `dots` (n, M) are products of the image's rows with those of the others, which have the columns
    `offsets[k]:offsets[k + 1]`; `counts` (K,) is filled. All terms are integers below 2²⁴, exact in float32.
    """
    rows = len(squared1)
    for k in range(len(counts)):
        first, last = offsets[k], offsets[k + 1]
        columns = last - first
        best2 = np.full(columns, np.inf, np.float32)
        second2 = np.full(columns, np.inf, np.float32)
        index2 = np.full(columns, -1, np.int32)
        index1 = np.full(rows, -1, np.int32)
        for r in range(rows):
            best, second, index = np.float32(np.inf), np.float32(np.inf), -1
            for c in range(columns):
                distance = squared1[r] + squared2[first + c] - np.float32(2) * dots[r, first + c]
                if distance < second:
                    if distance < best:
                        second, best, index = best, distance, c
                    else:
                        second = distance
                if distance < second2[c]:
                    if distance < best2[c]:
                        second2[c], best2[c], index2[c] = best2[c], distance, r
                    else:
                        second2[c] = distance
            if best < max_ratio_squared * second:
                index1[r] = index
        count = 0
        for c in range(columns):
            r = index2[c]
            if r >= 0 and index1[r] == c and best2[c] < max_ratio_squared * second2[c]:
                count += 1
        counts[k] = count
