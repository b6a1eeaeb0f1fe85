"""Fundamental matrices from seven, homographies from four pairs of points.

Seven equations x2ᵀ F x1 = 0 leave F = G + z H; det F = 0 is a cubic in z.
Four pairs give eight equations x2 × H x1 = 0, whose null vector is the homography.

Reference:
    Hartley & Zisserman, Multiple View Geometry, 2nd ed., §11.1.2 and §4.1.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sfm.core.geometry.minimal._cubic_kernels import cubic_roots
from sfm.core.geometry.minimal._linear_kernels import nullspace

MAX_SOLUTIONS = 3


@njit(cache=True, nogil=True, error_model="numpy")
def _determinant(m):
    return (
        m[0] * (m[4] * m[8] - m[5] * m[7])
        - m[1] * (m[3] * m[8] - m[5] * m[6])
        + m[2] * (m[3] * m[7] - m[4] * m[6])
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def seven_point(data, samples, fundamentals):
    """Fills the rows of `fundamentals` (3 B, 9) with the F of unit norm that fit samples of seven; returns how many.

    Columns of `data` are pairs of points, x1, y1, x2, y2, centred and of a size near 1; rows of `samples` (B, 7) name
    columns.
    """
    a, basis, c, mixed, roots = np.empty((7, 9)), np.empty((2, 9)), np.empty(4), np.empty(9), np.empty(10)
    count = 0
    for s in range(samples.shape[0]):
        for p in range(7):
            for i in range(3):
                for j in range(3):
                    left = data[2 + i, samples[s, p]] if i < 2 else 1.0
                    a[p, 3 * i + j] = left * data[j, samples[s, p]] if j < 2 else left
        if not nullspace(a, basis):
            continue
        # The cubic det(G + z H) by its values at z = 0, 1, −1 and its leading coefficient det H.
        c[0], c[3] = _determinant(basis[0]), _determinant(basis[1])
        for i in range(9):
            mixed[i] = basis[0, i] + basis[1, i]
        plus = _determinant(mixed)
        for i in range(9):
            mixed[i] = basis[0, i] - basis[1, i]
        minus = _determinant(mixed)
        c[2] = 0.5 * (plus + minus) - c[0]
        c[1] = 0.5 * (plus - minus) - c[3]
        for k in range(cubic_roots(c, roots)):
            norm = np.sqrt(1.0 + roots[k] * roots[k])
            for i in range(9):
                fundamentals[count, i] = (basis[0, i] + roots[k] * basis[1, i]) / norm
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def four_point(data, samples, homographies):
    """Fills the rows of `homographies` (B, 9) with the H of unit norm that map samples of four; returns how many.

    Columns of `data` are as in `seven_point`. Three collinear points have no homography.
    """
    a, basis = np.empty((8, 9)), np.empty((1, 9))
    count = 0
    for s in range(samples.shape[0]):
        for p in range(4):
            for j in range(3):
                x1 = data[j, samples[s, p]] if j < 2 else 1.0
                for r in range(2):
                    a[2 * p + r, j + 3 * r] = x1
                    a[2 * p + r, j + 3 - 3 * r] = 0.0
                    a[2 * p + r, 6 + j] = -x1 * data[2 + r, samples[s, p]]
        if nullspace(a, basis) and abs(_determinant(basis[0])) > 1e-12:
            for i in range(9):
                homographies[count, i] = basis[0, i]
            count += 1
    return count
