"""Solution of symmetric positive definite systems S x = b, S a square array."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray
from sfm.core.optim.dense_cholesky import STRIP, factor_strips, solve_strips, strip_count


def solve_positive_definite(S: FloatArray, b: FloatArray) -> FloatArray | None:
    """x with S x = b, or None where S is not positive definite or x not finite.

    Only the lower triangle of `S` (N, N) counts.
    """
    n, strips = len(b), strip_count(len(b))
    if n == 0:
        return np.zeros(0)
    padded = np.eye(STRIP, STRIP * strips, STRIP * (strips - 1))
    padded[: n - STRIP * (strips - 1), :n] = S[STRIP * (strips - 1) :]
    rows = [S[STRIP * i : STRIP * (i + 1), : STRIP * (i + 1)] for i in range(strips - 1)]
    L = np.concatenate([strip.T.ravel() for strip in (*rows, padded)])
    if not factor_strips(L, strips):
        return None
    x = solve_strips(L, b)
    return x if np.all(np.isfinite(x)) else None
