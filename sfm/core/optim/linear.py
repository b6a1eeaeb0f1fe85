"""Solution of symmetric positive definite systems S x = b.

Up to 2,500 unknowns by a kernel of our own: up to 600 it is as fast as LAPACK on one thread, above it takes up to
twice as long. LAPACK on several threads would harm what comes after it, since the threads of OpenBLAS keep their
cores busy for a while in waiting for more (a factor of 5 for a whole adjustment on two busy cores), and its bits
depend on the number of cores. Above that size LAPACK, whose threads then pay.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import get_lapack_funcs

from sfm.core.arrays import FloatArray
from sfm.core.optim._cholesky_kernels import factor_and_solve

_LAPACK_FROM = 2500
(_posv,) = get_lapack_funcs(("posv",), dtype=np.float64)


def solve_positive_definite(S: FloatArray, b: FloatArray) -> FloatArray | None:
    """x with S x = b, or None where S is not positive definite or x not finite.

    Only the lower triangle of `S` (N, N) counts. Both arrays must be C-contiguous and are overwritten.
    """
    if len(b) < _LAPACK_FROM:
        # Four rows at a time stay in the first cache up to some 1,000 unknowns; beyond, fetching rows is what costs.
        panel = 4 if len(b) < 1000 else 32
        return b if factor_and_solve(S, b, panel) and np.all(np.isfinite(b)) else None
    # LAPACK reads columns first: the lower triangle of S is the upper one of its transpose.
    _, x, info = _posv(S.T, b, lower=0, overwrite_a=1, overwrite_b=1)
    return x if info == 0 and np.all(np.isfinite(x)) else None
