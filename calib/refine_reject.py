"""What is left out of a calibration: views that cannot be used, and corners and views that do not fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from calib.refine_fit import ROBUST, CalibrationConfig, Fit
from calib.refine_system import CalibrationSystem
from calib.refine_views import BoardView, Observations, gather
from calib.zhang import Homographies, fit_view_homographies
from sfm.core.arrays import BoolArray, FloatArray, Vector
from sfm.core.geometry.homogeneous import transform_points
from sfm.core.optim.levenberg_marquardt import Summary, minimize

_NOT_A_BOARD = 0.2
"""RMS error of a view's homography over the spread of its corners. Fisheye views stay below 0.1; corners in a wrong
order are near 0.5."""
_MOSTLY = 0.1
"""Part of that limit which the median corner must keep if some are far off."""
_RAYLEIGH_MEDIAN = 1.17741
"""Median length of a pair of unit normal numbers."""
_ROUNDS = 8


@dataclasses.dataclass(frozen=True, slots=True)
class RejectedView:
    """A view that is left out, and why."""

    name: str
    reason: str
    detail: str = ""


def sort_out(
    board: FloatArray, views: Sequence[BoardView], config: CalibrationConfig
) -> tuple[Observations, Homographies, list[RejectedView]]:
    """Views that can be used, and the others: another size, too few corners, corners on a line or in a wrong order."""
    sizes = [(view.width, view.height) for view in views]
    common = max(sorted(set(sizes)), key=sizes.count) if sizes else (0, 0)
    usable, rejected = [], []
    for view, size in zip(views, sizes, strict=True):
        if size != common:
            detail = f"{size[0]}x{size[1]} among photos of {common[0]}x{common[1]}"
            rejected.append(RejectedView(view.name, "other_size", detail))
        elif len(view.corner_ids) < config.min_corners:
            detail = f"{len(view.corner_ids)} of {config.min_corners} needed"
            rejected.append(RejectedView(view.name, "too_few_corners", detail))
        else:
            usable.append(view)
    observations = gather(board, usable)
    found = fit_view_homographies(observations)
    H, errors = found.matrices, found.errors
    flat, limits = np.isfinite(errors), _NOT_A_BOARD * found.spreads
    fits = flat & (errors <= limits)
    for v in np.flatnonzero(flat & ~fits) if config.reject else ():
        # Single corners may be far off: most of them must fit.
        one = observations.of_views([int(v)])
        H[v] = fit_view_homographies(one, robust=True).matrices[0]
        off = np.linalg.norm(transform_points(H[v], one.board[one.rows, :2]) - one.points2D, axis=1)
        fits[v] = np.median(off) <= _MOSTLY * limits[v]
        errors[v] = np.inf if fits[v] else errors[v]
    # det ∂(u, v)/∂(x, y) = det H / w³ has the sign of det H, as w is positive on what is seen.
    turns = np.linalg.det(np.where(np.isfinite(H), H, 0.0)) > 0
    alike = turns == (np.sum(turns & fits) * 2 >= np.sum(fits))
    out = np.flatnonzero(~(fits & alike))
    rejected += [
        RejectedView(observations.names[v], *_why_not(bool(flat[v]), bool(fits[v]), float(errors[v]))) for v in out
    ]
    if np.all(fits & alike):
        return observations, found, rejected
    kept = np.flatnonzero(fits & alike).tolist()
    return observations.of_views(kept), Homographies(H[kept], errors[kept], found.spreads[kept]), rejected


def _why_not(flat: bool, fits: bool, error: float) -> tuple[str, str]:
    if not flat:
        return "corners_on_a_line", "they determine no homography"
    if not fits:
        detail = f"{error:.1f} px from a flat board: corners in a wrong order, or rows and columns swapped"
        return "not_this_board", detail
    return "mirrored", "corners run the other way round than in most views"


def reject_outliers(
    fit: Fit, system: CalibrationSystem, summary: Summary, corners: list[tuple[str, int]]
) -> tuple[CalibrationSystem, Summary, list[RejectedView]]:
    """Refits without corners beyond some σ, and without views that lose half of theirs.

    Corners may come back: all are judged again by each new fit, until the choice stays.
    """
    config, rejected = fit.config, []
    full, lengths = system.observations, _lengths(system)
    if not lengths.max() > config.reject_beyond_sigma * _spread_of(lengths):
        return system, summary, rejected
    # Least squares bends towards what is wrong; which corners that are, a robust fit tells.
    judge = fit.system(full, system.estimate, loss="cauchy", scale=2 * _spread_of(lengths))
    minimize(judge, ROBUST)
    before = None
    for _ in range(_ROUNDS):
        lengths = _lengths(judge)
        sigma = _spread_of(lengths if before is None else lengths[before])
        kept = lengths <= config.keep_within_sigma * sigma
        views, gone = _without_bad_views(full, kept, lengths, sigma, config.min_corners)
        rejected += gone
        if len(views) < config.min_views:
            return fit.system(full.of_views(views), judge.estimate.of_views(views)), summary, rejected
        if before is not None and not gone and np.array_equal(kept, before):
            break
        inside = np.concatenate([kept[full.offsets[v] : full.offsets[v + 1]] for v in views])
        full = full.of_views(views)
        system, summary = fit.solve(full.of_corners(inside), judge.estimate.of_views(views))
        judge, before = fit.system(full, system.estimate), inside
    if before is not None:
        names, views_of = full.names, full.view_of
        corners += [(names[views_of[n]], int(full.rows[n])) for n in np.flatnonzero(~before)]
    return system, summary, rejected


def _spread_of(lengths: Vector) -> float:
    """The standard deviation of a coordinate by the median length."""
    return max(float(np.median(lengths)) / _RAYLEIGH_MEDIAN, 1e-9)


def _without_bad_views(
    observations: Observations, kept: BoolArray, lengths: Vector, sigma: float, min_corners: int
) -> tuple[list[int], list[RejectedView]]:
    """Views to go on with, and those whose corners are mostly outliers."""
    good, bad = [], []
    for v, name in enumerate(observations.names):
        inside = kept[observations.offsets[v] : observations.offsets[v + 1]]
        if inside.sum() >= max(min_corners, 0.5 * len(inside)):
            good.append(v)
            continue
        typical = float(np.median(lengths[observations.offsets[v] : observations.offsets[v + 1]]))
        detail = f"{int((~inside).sum())} of {len(inside)} corners beyond limits; median {typical / sigma:.1f} sigma"
        bad.append(RejectedView(name, "outlier_view", detail))
    return good, bad


def _lengths(system: CalibrationSystem) -> Vector:
    """(n,) lengths of the whitened residuals; inf where there is no projection."""
    r, roots = system.residuals(), system.observations.roots
    lengths = np.hypot(roots[:, 0] * r[:, 0] + roots[:, 1] * r[:, 1], roots[:, 2] * r[:, 1])
    return np.where(np.isfinite(lengths), lengths, np.inf)
