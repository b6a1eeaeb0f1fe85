"""The two nearest descriptors among those that agree with a geometry of two views."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def scan_epipolar(table1, table2, x1, x2, J1, J2, E, max_square, bits, found1, found2):
    """Fills `found1` (N, 3) and `found2` (M, 3) with distance to the nearest, to the second nearest, and its row.

    Agreeing pairs have  (x2ᵀ E x1)² ≤ max_square (|J1ᵀ Eᵀ x2|² + |J2ᵀ E x1|²),  Sampson's distance with J (N, 3, 2)
    the derivatives of x by the pixel. Distances are squared Euclidean ones, or numbers of bits.
    """
    lines1, lines2 = x1 @ E.T, x2 @ E
    for i in range(len(x1)):
        a = lines1[i]
        for j in range(len(x2)):
            b = lines2[j]
            error = x2[j, 0] * a[0] + x2[j, 1] * a[1] + x2[j, 2] * a[2]
            norm = 0.0
            for k in range(2):
                along1 = J1[i, 0, k] * b[0] + J1[i, 1, k] * b[1] + J1[i, 2, k] * b[2]
                along2 = J2[j, 0, k] * a[0] + J2[j, 1, k] * a[1] + J2[j, 2, k] * a[2]
                norm += along1 * along1 + along2 * along2
            if error * error <= max_square * norm:
                update(table1, table2, i, j, bits, found1, found2)


@njit(cache=True, nogil=True)
def scan_homography(table1, table2, x1, x2, H, max_square, bits, found1, found2):
    """As `scan_epipolar`, for pairs of pixels with  |x2 − H x1|² ≤ max_square.  Points are (N, 3), the third 1."""
    mapped = x1 @ H.T
    for i in range(len(x1)):
        u, v, w = mapped[i]
        for j in range(len(x2)):
            if (x2[j, 0] * w - u) ** 2 + (x2[j, 1] * w - v) ** 2 <= max_square * w * w:
                update(table1, table2, i, j, bits, found1, found2)


@njit(cache=True, nogil=True)
def update(table1, table2, i, j, bits, found1, found2):
    """Takes the pair (i, j) into account; the lower row wins a tie."""
    distance = 0
    for k in range(table1.shape[1]):
        if bits:
            different = np.int64(table1[i, k] ^ table2[j, k])
            while different:
                different &= different - 1
                distance += 1
        else:
            step = np.int64(table1[i, k]) - np.int64(table2[j, k])
            distance += step * step
    if distance < found1[i, 0]:
        found1[i, 1], found1[i, 0], found1[i, 2] = found1[i, 0], distance, j
    elif distance < found1[i, 1]:
        found1[i, 1] = distance
    if distance < found2[j, 0]:
        found2[j, 1], found2[j, 0], found2[j, 2] = found2[j, 0], distance, i
    elif distance < found2[j, 1]:
        found2[j, 1] = distance
