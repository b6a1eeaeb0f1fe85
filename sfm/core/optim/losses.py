"""Robust losses ρ of the squared residual s = |r|², with ρ(0) = 0 and ρ'(0) = 1.

The cost of a problem is F = ½ Σ ρ(s). Its gradient is Σ ρ'(s) Jᵀ r: least squares with weights w = ρ'(s), renewed
at every linearisation (iteratively reweighted least squares). The second derivative of ρ is left out of the normal
matrix; it is never positive for these losses, so that the matrix stays positive semidefinite.

With scale a, in the unit of the residual:

    trivial   s
    huber     s for s ≤ a², 2 a √s − a² beyond
    soft_l1   2 a² (√(1 + s/a²) − 1)
    cauchy    a² log(1 + s/a²)
    tukey     a²/3 (1 − (1 − s/a²)³) for s ≤ a², a²/3 beyond
    truncated s for s ≤ a², a² beyond

Beyond a, residuals have no weight by the last two: whatever starts outside stays there, unless the scale is wide at
first and narrows step by step (graduated non-convexity; see `BundleConfig.graduated`).

Reference:
    Yang, Antonante, Tzoumas & Carlone, Graduated non-convexity for robust spatial perception, RA-L 2020.
    Triggs, McLauchlan, Hartley & Fitzgibbon, Bundle adjustment — a modern synthesis, 2000, §4.3.
"""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

import numpy as np

from sfm.core.arrays import FloatArray
from sfm.core.optim import _loss_kernels as kernels

Loss: TypeAlias = Literal["trivial", "huber", "soft_l1", "cauchy", "tukey", "truncated"]

LOSSES: tuple[Loss, ...] = get_args(Loss)
_IDS = {
    "trivial": kernels.TRIVIAL,
    "huber": kernels.HUBER,
    "soft_l1": kernels.SOFT_L1,
    "cauchy": kernels.CAUCHY,
    "tukey": kernels.TUKEY,
    "truncated": kernels.TRUNCATED,
}


def loss_id(loss: str) -> int:
    """The number by which kernels know `loss`.

    Raises:
        ValueError: there is no such loss.
    """
    if loss not in _IDS:
        raise ValueError(f"unknown loss {loss!r}; known are {', '.join(_IDS)}")
    return _IDS[loss]


def evaluate_loss(loss: Loss, squared_residuals: FloatArray, scale: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """ρ(s) and the weight ρ'(s) of squared residuals of any shape; `scale` is in the unit of the residual."""
    s = np.asarray(squared_residuals, dtype=np.float64) / scale**2
    match loss:
        case "trivial":
            rho, weight = s, np.ones_like(s)
        case "huber":
            root = np.sqrt(np.maximum(s, 1.0))
            rho, weight = np.where(s <= 1, s, 2 * root - 1), 1 / root
        case "soft_l1":
            root = np.sqrt(1 + s)
            near = np.minimum(s, 1.0)  # where root − 1 would cancel
            rho, weight = np.where(s < 1, 2 * near / (1 + np.sqrt(1 + near)), 2 * (root - 1)), 1 / root
        case "cauchy":
            rho, weight = np.log1p(s), 1 / (1 + s)
        case "tukey":
            near = np.minimum(s, 1.0)
            rho, weight = near * (1 - near * (1 - near / 3)), (1 - near) ** 2
        case "truncated":
            rho, weight = np.minimum(s, 1.0), (s <= 1) * 1.0
    return np.asarray(scale**2 * rho), np.asarray(weight)
