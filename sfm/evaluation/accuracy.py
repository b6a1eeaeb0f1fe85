"""One number from many errors.

Recall r(e) is the share of the n errors e₁ ≤ … ≤ e_n that are at most e, drawn as the polygon through (0, 0) and
(e_k, k / n). The area under it up to a threshold τ, as a share of the best possible,

    AUC(τ) = (1 / τ) ∫₀^τ r(e) de,

where beyond the last error not above τ the polygon runs on level. This is the area of SuperGlue's evaluation, which the
benchmarks of ETH3D and IMC scenes took over; COLMAP's sorts an error equal to τ inside it, as here. Errors of ∞
are failures: they take part in n and never add area.

COLMAP's benchmark calls all errors up to a floor e₀ perfect, r(e) = r(e₀) for e ≤ e₀ (`min_error`), and takes for it
the truth's position accuracy in metres read as degrees (0.001 for ETH3D, 0.02 for IMC): that adds at most 0.1 and
2 points to AUC(1°). Here the floor is 0 unless asked for.

The Image Matching Challenge of 2020 and 2021 itself counts in whole degrees instead,

    mAA(T) = (1 / T) Σ_{τ = 1…T} #{e < τ°} / n,

with the direction's sign ignored; `mean_average_accuracy` is that sum, of whatever errors it is given.

References:
    Sarlin, DeTone, Malisiewicz & Rabinovich, SuperGlue, CVPR 2020 (supplement).
    Jin, Mishkin, Mishchuk, Matas, Fua, Yi & Trulls, Image matching across wide baselines, IJCV 2021, §4.
    COLMAP, benchmark/reconstruction/evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sfm.core.arrays import FloatArray, Vector

THRESHOLDS_DEG = (0.5, 1.0, 3.0, 5.0, 10.0)


def area_under_recall(
    errors: Vector, thresholds: Sequence[float] = THRESHOLDS_DEG, *, min_error: float = 0.0
) -> FloatArray:
    """AUC in [0, 1] at each threshold; NaN where there are no errors at all.

    Args:
        errors: not negative, in the unit of `thresholds`; ∞ for a failure.
        min_error: errors at or below it count as equally perfect.
    Raises:
        ValueError: a threshold is not positive, or an error is negative or NaN.
    """
    limits = np.asarray(thresholds, dtype=np.float64)
    if np.any(limits <= 0):
        raise ValueError(f"thresholds must be positive, got {thresholds}")
    if not np.all(errors >= 0):
        raise ValueError("errors must not be negative or NaN")
    if len(errors) == 0:
        return np.full(len(limits), np.nan)
    e, r = _recall_polygon(np.sort(errors), min_error)
    return np.array([_area_up_to(limit, e, r) / limit for limit in limits])


def _recall_polygon(errors: Vector, min_error: float) -> tuple[FloatArray, FloatArray]:
    recall = np.arange(1, len(errors) + 1) / len(errors)
    if min_error <= 0:
        return np.r_[0.0, errors], np.r_[0.0, recall]
    perfect = int(np.searchsorted(errors, min_error, side="right"))
    level = perfect / len(errors)
    return np.r_[0.0, min_error, errors[perfect:]], np.r_[level, level, recall[perfect:]]


def _area_up_to(limit: float, errors: Vector, recall: Vector) -> float:
    inside = int(np.searchsorted(errors, limit, side="right"))
    e, r = np.r_[errors[:inside], limit], np.r_[recall[:inside], recall[inside - 1]]
    return float(np.sum(np.diff(e) * (r[1:] + r[:-1]) / 2))


def mean_average_accuracy(errors_deg: Vector, max_deg: int = 10) -> float:
    """mAA in [0, 1] over the whole degrees 1 … `max_deg`; NaN where there are no errors."""
    if len(errors_deg) == 0:
        return float("nan")
    return float(np.mean([np.mean(errors_deg < limit) for limit in range(1, max_deg + 1)]))
