"""Decomposition of essential matrices and the test which rays meet in front of both cameras.

With |t| = 1 and E = [t]× R, the cofactors of E are t tᵀ R and [t]× E = t tᵀ R − R, so that R = cof E − [t]× E, and
R' = cof E + [t]× E is the rotation for −t. The left null vector t is the longest cross product of two columns.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def essential_to_pose(e, rotations, t):
    """Fills `rotations` (2, 9) by rows and unit `t`; False where E has rank below two or is not finite."""
    square = 0.0
    for i in range(9):
        square += e[i] * e[i]
    cofactors = np.empty((3, 3))
    longest, best = 0.0, 0
    for j in range(3):
        c, d = (j + 1) % 3, (j + 2) % 3
        norm = 0.0
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            cofactors[i, j] = e[3 * a + c] * e[3 * b + d] - e[3 * a + d] * e[3 * b + c]
            norm += cofactors[i, j] * cofactors[i, j]
        if norm > longest:
            longest, best = norm, j
    if not (longest > 1e-20 * square * square and square < np.inf):
        return False
    for i in range(3):
        t[i] = cofactors[i, best] / np.sqrt(longest)
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            cross = (t[a] * e[3 * b + j] - t[b] * e[3 * a + j]) * np.sqrt(2.0 / square)
            cofactor = cofactors[i, j] * 2.0 / square
            rotations[0, 3 * i + j], rotations[1, 3 * i + j] = cofactor - cross, cofactor + cross
    for r in range(2):
        _orthonormalise(rotations[r])
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _orthonormalise(m):
    """Newton's iteration to the nearest rotation, M ← (M + M⁻ᵀ) / 2 with M⁻ᵀ = cof M / det M, in place."""
    cofactors = np.empty(9)
    for _ in range(6):
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                c, d = (j + 1) % 3, (j + 2) % 3
                cofactors[3 * i + j] = m[3 * a + c] * m[3 * b + d] - m[3 * a + d] * m[3 * b + c]
        det = m[0] * cofactors[0] + m[1] * cofactors[1] + m[2] * cofactors[2]
        for i in range(9):
            m[i] = 0.5 * (m[i] + cofactors[i] / det)


@njit(cache=True, nogil=True, error_model="numpy")
def front_counts(rotations, translations, rays1, rays2):
    """(P, N): whether the rays come nearest each other at positive depths along both, for P poses R (3, 3), t.

    With a = (R r1) · r2, the depths that minimise |d1 R r1 + t − d2 r2| are (a r2·t − R r1·t) / (1 − a²) and
    (r2·t − a R r1·t) / (1 − a²). Parallel rays do not count.
    """
    poses, n = translations.shape[0], rays1.shape[0]
    front = np.empty((poses, n), dtype=np.bool_)
    for p in range(poses):
        for i in range(n):
            a, along1, along2 = 0.0, 0.0, 0.0
            for j in range(3):
                turned = 0.0
                for k in range(3):
                    turned += rotations[p, j, k] * rays1[i, k]
                a += turned * rays2[i, j]
                along1 += turned * translations[p, j]
                along2 += rays2[i, j] * translations[p, j]
            front[p, i] = a * along2 - along1 > 0.0 and along2 - a * along1 > 0.0
    return front
