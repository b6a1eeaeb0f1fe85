"""Null spaces and solutions of small linear systems by elimination with pivoting."""

from __future__ import annotations

import numpy as np
from numba import njit

_RANK_TOLERANCE = 1e-11


@njit(cache=True, nogil=True, error_model="numpy")
def nullspace(a, basis):
    """Fills the rows of `basis` (n − m, n) with an orthonormal basis of the null space of `a` (m, n).

    Destroys `a`. Returns False, with `basis` undefined, where `a` does not have full rank or is not finite.
    """
    m, n = a.shape
    order = np.arange(n)
    first = 0.0
    for k in range(m):
        largest, row, column = 0.0, k, k
        for i in range(k, m):
            for j in range(k, n):
                if abs(a[i, j]) > largest:
                    largest, row, column = abs(a[i, j]), i, j
        if k == 0:
            first = largest
        if not _RANK_TOLERANCE * first < largest < np.inf:
            return False
        if row != k:
            for j in range(n):
                a[k, j], a[row, j] = a[row, j], a[k, j]
        if column != k:
            for i in range(m):
                a[i, k], a[i, column] = a[i, column], a[i, k]
            order[k], order[column] = order[column], order[k]
        inverse = 1.0 / a[k, k]
        for j in range(k + 1, n):
            a[k, j] *= inverse
        for i in range(m):
            if i != k:
                factor = a[i, k]
                for j in range(k + 1, n):
                    a[i, j] -= factor * a[k, j]
    for free in range(n - m):
        for j in range(n):
            basis[free, j] = 0.0
        basis[free, order[m + free]] = 1.0
        for k in range(m):
            basis[free, order[k]] = -a[k, m + free]
    # Modified Gram–Schmidt: the five-point solver is better conditioned on an orthonormal basis.
    for i in range(n - m):
        for k in range(i + 1):
            dot = 0.0
            for j in range(n):
                dot += basis[i, j] * basis[k, j]
            for j in range(n):
                if k < i:
                    basis[i, j] -= dot * basis[k, j]
                else:
                    basis[i, j] /= np.sqrt(dot)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def solve(a, b):
    """Puts the solution of a x = b in the place of `b`; destroys `a` (n, n). Not finite where it is singular."""
    n = a.shape[0]
    for k in range(n):
        row = k
        for i in range(k + 1, n):
            if abs(a[i, k]) > abs(a[row, k]):
                row = i
        for j in range(k, n):
            a[k, j], a[row, j] = a[row, j], a[k, j]
        b[k], b[row] = b[row], b[k]
        for i in range(k + 1, n):
            factor = a[i, k] / a[k, k]
            for j in range(k + 1, n):
                a[i, j] -= factor * a[k, j]
            b[i] -= factor * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= a[k, j] * b[j]
        b[k] /= a[k, k]
