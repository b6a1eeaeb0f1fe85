"""Dense Cholesky factor and solution; see `linear`.

`reassoc` lets the inner products run in vector registers: the order of summation is then the compiler's, always the
same one, and unlike that of a threaded BLAS it does not depend on the number of cores.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})
def factor_and_solve(S, b, panel):
    """Overwrites the lower triangle of S by L (but for its diagonal) and b by S⁻¹ b; False: not positive definite.

    L is built from inner products of rows, L_ij = (S_ij − Σ_k<j L_ik L_jk) / L_jj. Row j is fetched once for `panel`
    rows i, a multiple of four, and each load of it serves four of them.
    """
    n = len(b)
    inverse = np.empty(n)
    for top in range(0, n, panel):
        end = min(top + panel, n)
        fours = end - (end - top) % 4
        for j in range(top):
            row, d = S[j], inverse[j]
            for i in range(top, fours, 4):
                r0, r1, r2, r3 = S[i], S[i + 1], S[i + 2], S[i + 3]
                s0 = s1 = s2 = s3 = 0.0
                for k in range(j):
                    x = row[k]
                    s0 += r0[k] * x
                    s1 += r1[k] * x
                    s2 += r2[k] * x
                    s3 += r3[k] * x
                r0[j], r1[j], r2[j], r3[j] = (r0[j] - s0) * d, (r1[j] - s1) * d, (r2[j] - s2) * d, (r3[j] - s3) * d
        for i in range(top, end):
            r0 = S[i]
            for j in range(top if i < fours else 0, i + 1):
                row = S[j]
                s0 = 0.0
                for k in range(j):
                    s0 += r0[k] * row[k]
                if j < i:
                    r0[j] = (r0[j] - s0) * inverse[j]
                elif r0[i] - s0 > 0.0:
                    inverse[i] = 1.0 / math.sqrt(r0[i] - s0)
                else:
                    return False
    for i in range(n):
        row = S[i]
        s0 = 0.0
        for k in range(i):
            s0 += row[k] * b[k]
        b[i] = (b[i] - s0) * inverse[i]
    for i in range(n - 1, -1, -1):
        row = S[i]
        x = b[i] * inverse[i]
        b[i] = x
        for k in range(i):
            b[k] -= row[k] * x
    return True
