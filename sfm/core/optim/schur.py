"""Elimination of many points that only couple to few rows of six: what is left of a bundle adjustment.

The damped normal equations of rows a (poses, and what several images share) and points p are

    | U + λD   E    | |δa|       |ga|
    | Eᵀ     V + λD | |δp|  =  − |gp|        V block-diagonal, 3×3 blocks V_p;  E_p the columns of E of point p

With M_p = (V_p + λ D_p)⁻¹ the points drop out:

    S = U + λD − Σ_p E_p M_p E_pᵀ        S δa = −ga + Σ_p E_p M_p g_p        δp = −M_p (g_p + E_pᵀ δa)

A pose moves by a turn ω about its centre C and a shift υ, both in the axes of the world (see `sfm.bundle.system`), so
that a point X moves against it by ω × u + υ with u = X − C. With N = PᵀP, P the derivative of the residuals by X:

    Eᵀ = N T,    U = Σ Tᵀ N T,    T = [−[u]×, I]

A coupling of a point and a pose is thus no more than the six numbers of N, and what a pose has of its own and what is
taken off it are one product, Tᵀ (N − N M N) T. Couplings with shared rows are blocks B (3, 6), Bᵀ a part of E.

S is kept in 6×6 blocks (`BlockPattern`). Each row belongs to one job that walks through all points in order, so every
number is a sum in one order, however many jobs there are. M_p comes from a Cholesky factor with guarded pivots: it
stays positive semidefinite for a point that its views do not determine.

Reference:
    Triggs et al., Bundle adjustment — a modern synthesis, 2000, §6.1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfm.core.optim import _schur_kernels as kernels

invert_blocks = kernels.invert_blocks
eliminate = kernels.eliminate
multiply = kernels.multiply


class Couplings(NamedTuple):
    """Which rows each point couples to, and how; the order of the kernels' arguments.

    Attributes:
        starts, slot, N: by point (P + 1,), the row of each coupling with a pose (E,), ascending, and its (E, 6).
        shared_starts, shared_slot, B: the same for shared rows, which lie behind those of poses; (G, 3, 6).
    """

    starts: np.ndarray
    slot: np.ndarray
    N: np.ndarray
    shared_starts: np.ndarray
    shared_slot: np.ndarray
    B: np.ndarray
