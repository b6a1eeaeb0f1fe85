"""Elimination of many small blocks that only couple to few large ones: points out of a bundle adjustment.

The damped normal equations of poses a, shared parameters c (camera intrinsics) and points p are

    | U + λD   Fᵀ    W |  | δa |       | ga |
    | F       C + λD B |  | δc |  = −  | gc |         V block-diagonal, 3×3 blocks V_p
    | Wᵀ       Bᵀ  V+λD|  | δp |       | gp |

With M_p = (V_p + λ D_p)⁻¹ the points drop out, and the system of poses and shared parameters remains:

    S = [U F; F C] + λD − Σ_p E_p M_p E_pᵀ        S [δa; δc] = −[ga; gc] + Σ_p E_p M_p g_p
    δp = −M_p (g_p + E_pᵀ [δa; δc])               E_p the rows of [W; B] of point p

W is never a matrix: it is one 6×3 block for each observation, sorted by point and, within it, by pose. S is packed
in the 6×6 blocks of its lower triangle. The sum over p is shared out among jobs in one of two ways. Where there are
many products for each block of S, every job takes a range of points and has a copy of S, and the copies are added
in order. Where there are few, jobs own ranges of rows of one S and each walks through all points. Either way each
number is a sum in one order that the problem alone decides, not the number of threads. M_p comes from a Cholesky
factor with guarded pivots: it stays positive semidefinite for a point that its views do not determine.

Reference:
    Triggs et al., Bundle adjustment — a modern synthesis, 2000, §6.1.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.optim import _schur_kernels as kernels
from sfm.core.optim.linear import solve_positive_definite

POSE_SIZE = 6

invert_blocks = kernels.invert_blocks
eliminate_poses = kernels.eliminate_poses
eliminate_border = kernels.eliminate_border


@dataclasses.dataclass(slots=True)
class ReducedSystem:
    """S and the right-hand side, in the parts that kernels fill; lives as long as one adjustment.

    The first axis of each array counts the copies, N of them.

    Attributes:
        blocks: (N, I (I + 1) / 2, 6, 6) the lower triangle pose by pose, row by row.
        border: (N, I, C K, 6) shared parameters by pose.
        corner: (N, C K, C K) shared parameters, lower triangle.
        pose_side, corner_side: (N, I, 6) and (N, C K), the right-hand side.
    """

    blocks: np.ndarray
    border: np.ndarray
    corner: np.ndarray
    pose_side: np.ndarray
    corner_side: np.ndarray

    @staticmethod
    def allocate(poses: int, shared: int, copies: int = 1) -> ReducedSystem:
        """Zeros for that many poses and shared parameters."""
        return ReducedSystem(
            np.zeros((copies, poses * (poses + 1) // 2, POSE_SIZE, POSE_SIZE)),
            np.zeros((copies, poses, shared, POSE_SIZE)),
            np.zeros((copies, shared, shared)),
            np.zeros((copies, poses, POSE_SIZE)),
            np.zeros((copies, shared)),
        )

    def clear(self) -> None:
        """Sets everything to zero."""
        for part in (self.blocks, self.border, self.corner, self.pose_side, self.corner_side):
            part.fill(0)

    def side(self) -> FloatArray:
        """The right-hand side (6 I + C K,)."""
        return np.concatenate([_total(self.pose_side).ravel(), _total(self.corner_side)])

    def matrix(self) -> FloatArray:
        """S, of which only the lower triangle counts."""
        poses, shared = self.border.shape[1:3]
        n = poses * POSE_SIZE
        S = np.empty((n + shared, n + shared))
        blocks = _total(self.blocks)
        for i in range(poses):
            row = blocks[i * (i + 1) // 2 : (i + 1) * (i + 2) // 2]
            top, end = POSE_SIZE * i, POSE_SIZE * (i + 1)
            S[top:end, :end] = row.transpose(1, 0, 2).reshape(POSE_SIZE, end)
        S[n:, :n] = _total(self.border).transpose(1, 0, 2).reshape(shared, n)
        S[n:, n:] = _total(self.corner)
        return S


def _total(copies: FloatArray) -> FloatArray:
    return copies[0] if len(copies) == 1 else copies.sum(axis=0)


def solve_reduced(system: ReducedSystem, damping: FloatArray, held: BoolArray) -> FloatArray | None:
    """Solves (S + diag(damping)) δ = side, with δ = 0 where `held`; None where S is not positive definite."""
    S, side = system.matrix(), system.side()
    diagonal = np.einsum("ii->i", S)
    diagonal += damping
    S[held] = 0
    S[:, held] = 0
    diagonal[held] = 1
    side[held] = 0
    return solve_positive_definite(S, side)
