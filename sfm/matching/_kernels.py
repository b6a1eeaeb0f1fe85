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
