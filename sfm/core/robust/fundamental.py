"""Robust fundamental matrices and homographies between pixels."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from sfm.core.arrays import FloatArray, Mask, Matrix3, Points2D, Value, Vector, readonly
from sfm.core.errors import Rejected
from sfm.core.geometry.rotation import skew
from sfm.core.robust._loss_kernels import MARGINALIZED, TRUNCATED
from sfm.core.robust._problem_kernels import SIZE
from sfm.core.robust.ransac import CompiledProblem, Estimate, RansacConfig, polish, ransac
from sfm.core.robust.relative_pose import check_lengths, chosen, finite_rows, scatter
from sfm.core.robust.two_view import common_normalisation, fundamental_matrix, homography_matrix

_DOMINANT = 0.6
"""Share of the inliers of F that makes a plane dominant."""
_OFF_PLANE = 2.0
"""Pairs are off the plane beyond so many error bounds."""
_PLANE_SAMPLES, _PARALLAX_SAMPLES = 200, 300


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
    plane = homography_matrix(np.ascontiguousarray(columns[:, estimate.inliers]), problem.max_error)
    needed = max(math.ceil(_DOMINANT * plane.count), 8)
    short = dataclasses.replace(
        config, min_iterations=20, max_iterations=_PLANE_SAMPLES, min_inliers=needed, min_inlier_ratio=0.0
    )
    found = ransac(plane, short, rng)
    if not isinstance(found, Estimate):
        return estimate
    squares = homography_matrix(columns, problem.max_error).squared_errors(found.model)
    off = np.flatnonzero(squares > (_OFF_PLANE * problem.max_error) ** 2)
    if len(off) < 2:
        return estimate
    h = found.model[:9].reshape(3, 3)
    ones = np.ones(len(off))
    lines = np.cross(np.stack([*columns[2:, off], ones], 1), np.stack([*columns[:2, off], ones], 1) @ h.T)
    first, second = rng.integers(0, len(off), (2, _PARALLAX_SAMPLES))
    epipoles = np.cross(lines[first], lines[second])
    lengths = np.linalg.norm(epipoles, axis=1)
    epipoles = epipoles[lengths > 1e-12] / lengths[lengths > 1e-12, None]
    models = np.zeros((len(epipoles), SIZE))
    models[:, :9] = (skew(epipoles) @ h).reshape(-1, 9)
    loss = MARGINALIZED if config.score == "marginalized" else TRUNCATED
    index, _, _ = problem.best(models, loss, np.inf)
    if index < 0:
        return estimate
    improved = problem.improved(models[index], loss, problem.max_error, 1e-4)
    index, score, _ = problem.best(improved[None], loss, estimate.score)
    if index < 0:
        return estimate
    model, squares = polish(problem, improved)
    inliers = squares < problem.max_error**2
    if inliers.sum() < estimate.inliers.sum():
        return estimate
    return dataclasses.replace(estimate, model=model, score=score, inliers=inliers)


def estimate_homography(
    points2D_1: Points2D,
    points2D_2: Points2D,
    config: RansacConfig = RansacConfig(),
    *,
    rng: np.random.Generator,
    quality: Vector | None = None,
) -> MatrixEstimate | Rejected:
    """H with x2 ~ H x1, by four points and LO-RANSAC on Sampson errors in px, which treat both images alike.

    The sign of H is such that the inliers have w > 0.

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
