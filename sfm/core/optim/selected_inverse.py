"""Blocks of S⁻¹ from a factor by fronts, without the whole inverse: marginal covariances.

For a front with the factor L₁₁ of its pivots and L₂₁ of the rows below, and with the inverse Z₂₂ of these rows, which
the front of the parent has,

    Y = L₂₁ L₁₁⁻¹        Z₂₁ = −Z₂₂ Y        Z₁₁ = L₁₁⁻ᵀ L₁₁⁻¹ − Yᵀ Z₂₁

so that the inverse goes down the tree, and ends with every block that L has, those of S among them. A dense factor is
a front without rows below. The products are those of NumPy: unlike the factor's, their last bits may depend on the
number of cores that its BLAS uses.

Reference:
    Takahashi, Fagan & Chin, Formation of a sparse bus impedance matrix, 1973.
    Campbell & Davis, Computing the sparse inverse subset: an inverse multifrontal approach, 1995.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import get_lapack_funcs, solve_triangular

from sfm.core.arrays import FloatArray

_STRIP = 8
(_potri,) = get_lapack_funcs(("potri",), dtype=np.float64)


def front_inverse(L: FloatArray, pivots: int, below: FloatArray) -> FloatArray:
    """The inverse Z of a front, with the padding of its strips.

    Args:
        L: the front's factor in strips, flat, with 1 / L_jj for L_jj.
        pivots: its strips of pivots.
        below: Z₂₂, padded likewise; (0, 0) where there are no rows below.
    """
    if not pivots:
        return below
    L11, L21 = _unpacked(L, pivots, len(below))
    if not len(below):
        inverse = _potri(L11.T, lower=0, overwrite_c=1)[0]
        return np.triu(inverse) + np.triu(inverse, 1).T
    inverse = solve_triangular(L11, np.eye(len(L11)), lower=True, check_finite=False)
    Y = L21 @ inverse
    Z21 = -below @ Y
    return np.block([[inverse.T @ inverse - Y.T @ Z21, Z21.T], [Z21, below]])


def least_pivot_of(L: FloatArray, pivots: int) -> float:
    """The least L_jj² of so many pivots (unknowns) of a front."""
    j = np.arange(pivots)
    strip = j // _STRIP
    return float(L[32 * strip * (strip + 1) + j % _STRIP + _STRIP * j].max() ** -2.0)


def gathered_blocks(Z: FloatArray, rows: np.ndarray, columns: np.ndarray) -> FloatArray:
    """Blocks (n, 6, 6) of Z at these rows and columns (n, 6); zero where one of them is −1."""
    if not len(Z):
        return np.zeros((*rows.shape, columns.shape[1]))
    blocks = Z[rows[:, :, None], columns[:, None, :]]
    return np.where((rows >= 0)[:, :, None] & (columns >= 0)[:, None, :], blocks, 0.0)


def _unpacked(L: FloatArray, pivots: int, rows: int) -> tuple[FloatArray, FloatArray]:
    """L₁₁ and L₂₁ of the factor of a front with so many rows below its pivots."""
    n, triangle = _STRIP * pivots, 32 * pivots * (pivots + 1)
    first = np.zeros((n, n))
    for i in range(pivots):
        strip = L[32 * i * (i + 1) : 32 * (i + 1) * (i + 2)]
        first[_STRIP * i : _STRIP * (i + 1), : _STRIP * (i + 1)] = strip.reshape(-1, _STRIP).T
    np.einsum("ii->i", first)[:] **= -1
    rest = L[triangle:].reshape(rows // _STRIP, n, _STRIP)
    return first, rest.transpose(0, 2, 1).reshape(rows, n)
