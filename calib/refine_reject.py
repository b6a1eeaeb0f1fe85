"""What is left out of a calibration: views that cannot be used, and corners and views that do not fit."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from calib.detect_plane import fit_plane_closely
from calib.refine_board import shape_still_shown
from calib.refine_copies import without_copies
from calib.refine_fit import ROBUST, CalibrationConfig, Fit
from calib.refine_system import CalibrationSystem
from calib.refine_views import BoardView, Observations, RejectedView, gather
from calib.zhang import Homographies, fit_view_homographies
from sfm.core.arrays import BoolArray, FloatArray, Vector
from sfm.core.geometry.homogeneous import transform_points
from sfm.core.optim.levenberg_marquardt import Summary, minimize

_NOT_A_BOARD = 0.2
"""RMS error of a view's homography over the spread of its corners. Fisheye views stay below 0.1; corners in a wrong
order are near 0.5."""
_MOSTLY = 0.1
"""Part of that limit which the median corner must keep if some are far off."""
_THROUGH_LENS = 0.25
"""Part of that limit for a board behind a lens, which fits fisheyes up to a right angle from the axis."""
_RAYLEIGH_MEDIAN = 1.17741
"""Median length of a pair of unit normal numbers."""
_UNNOTICED_PX = 0.1
"""Detection on clean photos errs by up to this: a corner that is off by less is not wrong, however good the others."""
_ODD_VIEW, _ODD_VIEW_PX = 4.0, 0.3
"""Times the usual error, and px, that the typical corner of a view must be off before it does not belong. The photos of
eleven sets stay below 3.2 times; with the best fitting board below 0.25 px, where the usual one is 0.15 px or less."""
_ROUNDS = 8


def sort_out(
    board: FloatArray, views: Sequence[BoardView], config: CalibrationConfig
) -> tuple[Observations, Homographies, list[RejectedView]]:
    """Views that can be used, and the others.

    These are copies, of another size, or have too few corners, corners on a line or in a wrong order.
    """
    views, rejected = without_copies(views)
    sizes = [(view.width, view.height) for view in views]
    common = max(sorted(set(sizes), reverse=True), key=sizes.count) if sizes else (0, 0)
    usable = []
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
    for v in np.flatnonzero(flat & ~fits):
        one, limit = observations.of_views([int(v)]), _MOSTLY * limits[v]
        # Near a right angle from the axis nothing is flat any more: there a board must be one through a lens.
        if _error_through_lens(one) <= _THROUGH_LENS * limits[v]:
            fits[v] = True
        elif config.reject:  # single corners may be far off: most of them must fit
            H[v] = fit_view_homographies(one, robust=True).matrices[0]
            off = np.linalg.norm(transform_points(H[v], one.board[one.rows, :2]) - one.points2D, axis=1)
            fits[v] = np.median(off) <= limit
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


def _error_through_lens(one: Observations) -> float:
    """Rms of the corners of a view against a flat board behind a lens of one coefficient, px."""
    places = one.board[one.rows, :2]
    wanted = fit_plane_closely(places, one.points2D, (one.width, one.height)).image(places)
    error = float(np.sqrt(np.mean(np.sum((wanted - one.points2D) ** 2, axis=1))))
    return error if np.isfinite(error) else np.inf


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
    """Refits without corners beyond some σ, and without views that are far worse than the others.

    Corners may come back: all are judged again by each new fit, until the choice stays. A point of the board of which
    too few corners are left to tell its place has the place that was given.
    """
    config, rejected = fit.config, []
    full, lengths = system.observations, _lengths(system)
    sigma = spread_of(lengths)
    if not np.any(lengths > limits_of(lengths, full, config.reject_beyond_sigma, sigma)):
        return system, summary, rejected
    # Least squares bends towards what is wrong; which corners that are, a robust fit tells.
    judge = fit.system(full, system.estimate, loss="cauchy", scale=2 * sigma)
    minimize(judge, ROBUST)
    before = None
    for _ in range(_ROUNDS):
        lengths = _lengths(judge)
        sigma = spread_of(lengths if before is None else lengths[before])
        kept = lengths <= limits_of(lengths, full, config.keep_within_sigma, sigma, among=before)
        views, gone = views_that_belong(full, kept, lengths, sigma, config.min_corners, "outlier_view")
        rejected += gone
        if len(views) < config.min_views:
            return fit.system(full.of_views(views), judge.estimate.of_views(views)), summary, rejected
        if before is not None and not gone and np.array_equal(kept, before):
            break
        inside = np.concatenate([kept[full.offsets[v] : full.offsets[v + 1]] for v in views])
        full = full.of_views(views)
        some, now = full.of_corners(inside), judge.estimate.of_views(views)
        now = dataclasses.replace(now, shape=shape_still_shown(now.shape, some.shown))
        system, summary = fit.solve(some, now)
        judge, before = fit.system(full, system.estimate), inside
    if before is not None:
        names, views_of = full.names, full.view_of
        corners += [(names[views_of[n]], int(full.rows[n])) for n in np.flatnonzero(~before)]
    return system, summary, rejected


def spread_of(lengths: Vector) -> float:
    """The standard deviation of a coordinate by the median length."""
    return max(float(np.median(lengths)) / _RAYLEIGH_MEDIAN, 1e-9)


def limits_of(
    lengths: Vector, observations: Observations, sigmas: float, sigma: float, *, among: BoolArray | None = None
) -> Vector:
    """(n,) lengths beyond which a corner is wrong: so many standard deviations, of all corners or of its own view's.

    Photos differ: one that is blurred has corners that are three times as uncertain, and no reason to lose those that
    are off by more than the sharp ones ever are. By one measure for all, a right model (one with small residuals) loses
    a tenth of the corners of some sets; by its own view's, none but those that are wrong.

    Args:
        sigma: of all corners.
        among: (n,) corners by which views are measured; all of them by default.
    """
    inside = np.ones(len(lengths), bool) if among is None else among
    limits = np.full(len(lengths), max(sigmas * sigma, _UNNOTICED_PX))
    worst = max(_ODD_VIEW * sigma, _ODD_VIEW_PX / _RAYLEIGH_MEDIAN)
    for start, end in itertools.pairwise(observations.offsets.tolist()):
        mine = lengths[start:end][inside[start:end]]
        # Where most of a view is wrong its own measure is none.
        if len(mine):
            limits[start:end] = np.maximum(limits[start:end], sigmas * min(spread_of(mine), worst))
    return limits


def views_that_belong(
    observations: Observations, kept: BoolArray, lengths: Vector, sigma: float, min_corners: int, reason: str
) -> tuple[list[int], list[RejectedView]]:
    """Views to go on with, and those that do not belong.

    Half of their corners are wrong, or the typical one is off by several times what is usual, and that by more than
    detection makes of a good photo: a photo that is but a little worse than very good ones stays.

    Args:
        sigma: what is usual, px.
    """
    good, bad = [], []
    limit = max(_ODD_VIEW * _RAYLEIGH_MEDIAN * sigma, _ODD_VIEW_PX)
    for v, name in enumerate(observations.names):
        rows = slice(observations.offsets[v], observations.offsets[v + 1])
        inside, typical = kept[rows], float(np.median(lengths[rows]))
        if typical <= limit and inside.sum() >= max(min_corners, 0.5 * len(inside)):
            good.append(v)
            continue
        usual = _RAYLEIGH_MEDIAN * sigma
        detail = f"the typical corner is {typical:.2g} px off, where {usual:.2g} px are usual"
        if typical <= limit:
            detail = f"{int((~inside).sum())} of {len(inside)} corners beyond limits; {detail}"
        bad.append(RejectedView(name, reason, detail))
    return good, bad


def _lengths(system: CalibrationSystem) -> Vector:
    """(n,) lengths of the whitened residuals; inf where there is no projection."""
    r, roots = system.residuals(), system.observations.roots
    lengths = np.hypot(roots[:, 0] * r[:, 0] + roots[:, 1] * r[:, 1], roots[:, 2] * r[:, 1])
    return np.where(np.isfinite(lengths), lengths, np.inf)
