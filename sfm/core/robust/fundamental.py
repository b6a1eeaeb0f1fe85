"""Robust fundamental matrices and homographies between pixels."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from sfm.core.arrays import FloatArray, Mask, Matrix3, Points2D, Value, Vector, readonly
from sfm.core.errors import Rejected
from sfm.core.geometry.rotation import skew
from sfm.core.robust._loss_kernels import TRUNCATED
from sfm.core.robust._problem_kernels import SIZE
from sfm.core.robust.ransac import (
    LOCAL_DATA,
    LOCAL_TOLERANCE,
    CompiledProblem,
    Estimate,
    RansacConfig,
    farthest_bound,
    loss_of,
    polish,
    ransac,
)
from sfm.core.robust.relative_pose import check_lengths, chosen, finite_rows, scatter
from sfm.core.robust.sampling import Sampler
from sfm.core.robust.two_view import common_normalisation, fundamental_matrix, homography_matrix

_DOMINANT = 0.6
"""Share of the inliers of F that makes a plane dominant."""
_OFF_PLANE = 2.0
"""Pairs are off the plane beyond so many of the largest errors of an inlier."""
_PLANE_SAMPLES, _PARALLAX_SAMPLES = 60, 150
"""Of 60 samples of four one is clean on a dominant plane with a probability of 0.9998."""
_PLANE_DATA = 200


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MatrixEstimate(Value):
    """A matrix between pixels, of unit norm, the pairs (N,) that agree with it and the samples drawn."""

    matrix: Matrix3
    inliers: Mask
    iterations: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", readonly(self.matrix, (3, 3)))
        object.__setattr__(self, "inliers", readonly(self.inliers, (len(self.inliers),), np.bool_))


def estimate_fundamental(
    points2D_1: Points2D,
    points2D_2: Points2D,
    config: RansacConfig = RansacConfig(),
    *,
    rng: np.random.Generator,
    quality: Vector | None = None,
) -> MatrixEstimate | Rejected:
    """F of rank two with x2ᵀ F x1 = 0, by the seven-point solver and LO-RANSAC on Sampson errors in px.

    Where most inliers lie on one plane, F is sought once more from its homography and two pairs off the plane, since a
    sample of seven that holds five or more of the plane gives a wrong F with many inliers. A scene that is all planar
    leaves F undetermined: the result then explains the pairs, but its epipoles mean nothing.

    Args:
        quality: (N,) larger for pairs that are more likely right (see `ransac`).
    Raises:
        ValueError: the point sets or the qualities differ in length.
    """
    check_lengths(points2D_1, points2D_2)
    usable = finite_rows(points2D_1) & finite_rows(points2D_2)
    if not usable.any():
        return Rejected("too_few_points", "no finite pair of points")
    columns, t1, t2 = common_normalisation(points2D_1[usable], points2D_2[usable])
    problem = fundamental_matrix(columns, config.max_error_px * t1[0, 0])
    estimate = ransac(problem, config, rng, chosen(quality, usable))
    if not isinstance(estimate, Estimate):
        return estimate
    estimate = _off_plane(problem, columns, estimate, config, rng)
    matrix = t2.T @ estimate.model[:9].reshape(3, 3) @ t1
    return MatrixEstimate(matrix / np.linalg.norm(matrix), scatter(estimate.inliers, usable), estimate.iterations)


def _off_plane(
    problem: CompiledProblem, columns: FloatArray, estimate: Estimate, config: RansacConfig, rng: np.random.Generator
) -> Estimate:
    """The estimate, or a better one by plane and parallax: F = [e]× H, where e lies on the lines x2 × H x1.

    Reference:
        Chum, Werner & Matas, Two-view geometry estimation unaffected by a dominant plane, CVPR 2005.
    """
    wide, loss = problem.within(problem.max_error * farthest_bound(problem.solver, config)), loss_of(config)
    near = wide.squared_errors(estimate.model) < wide.max_error**2
    plane = _dominant_plane(columns[:, near], wide.max_error, rng)
    if plane is None:
        return estimate
    squares = homography_matrix(columns, wide.max_error).squared_errors(plane)
    off = rng.permutation(np.flatnonzero(squares > (_OFF_PLANE * problem.max_error) ** 2))
    if len(off) < 2:
        return estimate
    off = columns[:, off[:_PLANE_DATA]]
    models = _parallax_models(off, plane, rng)
    # Every one of them explains the plane: what lies off it decides.
    index, _, _ = fundamental_matrix(off, wide.max_error).best(models, loss, np.inf)
    if index < 0:
        return estimate
    some = wide.ordered(rng.permutation(wide.count)[:LOCAL_DATA])
    improved = some.improved(models[index], loss, wide.max_error, LOCAL_TOLERANCE)
    index, score, _ = wide.best(improved[None], loss, estimate.score)
    if index < 0:
        return estimate
    model, _ = polish(wide, improved)
    inliers = problem.squared_errors(model) < problem.max_error**2
    if inliers.sum() < estimate.inliers.sum():
        return estimate
    return dataclasses.replace(estimate, model=model, score=score, inliers=inliers)


def _dominant_plane(columns: FloatArray, max_error: float, rng: np.random.Generator) -> FloatArray | None:
    """The homography of most of the inliers of F, if there is one; a few hundred of them tell."""
    some = rng.permutation(columns.shape[1])[:_PLANE_DATA]
    needed = max(math.ceil(_DOMINANT * len(some)), 8)
    if len(some) < needed:
        return None
    problem = homography_matrix(columns[:, some], max_error)
    sampler = Sampler(len(some), problem.sample_size, _PLANE_SAMPLES, rng)
    model, bounds = np.zeros(SIZE), np.full(2, len(some) * max_error**2)
    while sampler.used < _PLANE_SAMPLES:
        used, _ = problem.search(sampler.ahead(_PLANE_SAMPLES - sampler.used), TRUNCATED, bounds, model)
        sampler.use(used)
    found = model.any() and np.sum(problem.squared_errors(model) < max_error**2) >= needed
    return model if found else None


def _parallax_models(off: FloatArray, plane: FloatArray, rng: np.random.Generator) -> FloatArray:
    """[e]× H for the epipoles e in which the lines x2 × H x1 of two pairs of points off the plane meet."""
    h = plane[:9].reshape(3, 3)
    ones = np.ones(off.shape[1])
    lines = np.cross(np.stack([*off[2:], ones], 1), np.stack([*off[:2], ones], 1) @ h.T)
    first, second = rng.integers(0, len(lines), (2, _PARALLAX_SAMPLES))
    epipoles = np.cross(lines[first], lines[second])
    lengths = np.linalg.norm(epipoles, axis=1)
    epipoles = epipoles[lengths > 1e-12] / lengths[lengths > 1e-12, None]
    models = np.zeros((len(epipoles), SIZE))
    models[:, :9] = (skew(epipoles) @ h).reshape(-1, 9)
    return models


def estimate_homography(
    points2D_1: Points2D,
    points2D_2: Points2D,
    config: RansacConfig = RansacConfig(),
    *,
    rng: np.random.Generator,
    quality: Vector | None = None,
) -> MatrixEstimate | Rejected:
    """H with x2 ~ H x1, by four points and LO-RANSAC on Sampson errors in px, which treat both images alike.

    The sign of H is such that the inliers have w > 0, and both cameras see one side of a plane, so that det H > 0: no H
    mirrors.

    Args:
        quality: (N,) larger for pairs that are more likely right (see `ransac`).
    Raises:
        ValueError: the point sets or the qualities differ in length.
    """
    check_lengths(points2D_1, points2D_2)
    usable = finite_rows(points2D_1) & finite_rows(points2D_2)
    if not usable.any():
        return Rejected("too_few_points", "no finite pair of points")
    columns, t1, t2 = common_normalisation(points2D_1[usable], points2D_2[usable])
    estimate = ransac(homography_matrix(columns, config.max_error_px * t1[0, 0]), config, rng, chosen(quality, usable))
    if not isinstance(estimate, Estimate):
        return estimate
    h = estimate.model[:9].reshape(3, 3)
    w = h[2, :2] @ columns[:2, estimate.inliers] + h[2, 2]
    matrix = np.linalg.solve(t2, h) @ t1 * (1.0 if np.median(w) > 0 else -1.0)
    return MatrixEstimate(matrix / np.linalg.norm(matrix), scatter(estimate.inliers, usable), estimate.iterations)
