"""The damped normal equations of a few parameters."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def damped_step(hessian, gradient, damping):
    """−(H + damping · diag H)⁻¹ g by Cholesky of the lower triangle of H; NaN where it is not positive definite."""
    n = gradient.shape[0]
    factor, step = np.empty((n, n)), np.empty(n)
    for i in range(n):
        for j in range(i + 1):
            total = hessian[i, j]
            if i == j:
                total += damping * hessian[i, i]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if j < i:
                factor[i, j] = total / factor[j, j]
            elif total > 0.0:
                factor[i, i] = np.sqrt(total)
            else:
                for k in range(n):
                    step[k] = np.nan
                return step
    for i in range(n):
        total = -gradient[i]
        for k in range(i):
            total -= factor[i, k] * step[k]
        step[i] = total / factor[i, i]
    for i in range(n - 1, -1, -1):
        total = step[i]
        for k in range(i + 1, n):
            total -= factor[k, i] * step[k]
        step[i] = total / factor[i, i]
    return step
