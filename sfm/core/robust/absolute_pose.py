"""Robust absolute pose of a camera of any model from points of known position."""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.arrays import FloatArray, Mask, Points2D, Points3D, Value, Vector, readonly
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew
from sfm.core.robust._absolute_pose_kernels import Resection
from sfm.core.robust._loss_kernels import CAUCHY, TRUNCATED
from sfm.core.robust._manifold_kernels import moved_pose
from sfm.core.robust.ransac import CompiledProblem, Estimate, RansacConfig, Solver, ransac
from sfm.core.robust.refinement import polish, refine
from sfm.core.robust.relative_pose import check_lengths, chosen, finite_rows, scatter

_FOCAL_FACTORS = np.geomspace(0.4, 2.5, 9)
_SCAN_ITERATIONS, _FOCAL_STEPS = 50, 15


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class AbsolutePoseEstimate(Value):
    """A pose, the camera with the focal length that belongs to it, and the points that agree.

    Attributes:
        camera: the given camera, or a copy with the refined focal length.
        inliers: (N,) visible under the pose, within the error bound.
        iterations: samples that were drawn.
    """

    cam_from_world: Rigid3
    camera: Camera
    inliers: Mask
    iterations: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "inliers", readonly(self.inliers, (len(self.inliers),), np.bool_))


def resection(
    points2D: Points2D, points3D: Points3D, camera: Camera, max_error_px: float
) -> tuple[CompiledProblem, Mask]:
    """The sampling problem of the finite points whose pixels have a ray, and which these are.

    Errors are tangent reprojection errors in px; models and states are R (9), t (3).
    """
    rays, valid = camera.unproject(points2D)
    _, by_point, _, projects = camera.project_with_jacobians(rays)
    usable = valid & projects & np.isfinite(points2D).all(1) & np.isfinite(points3D).all(1)
    data = np.concatenate([rays, by_point.reshape(-1, 6), points3D], axis=1)[usable]
    return CompiledProblem(Resection(np.ascontiguousarray(data.T)), Solver(3, 4, effort=0.5), max_error_px), usable


class ReprojectionProblem:
    """Exact reprojection errors. States are R, t and, with `refine_focal`, the logarithm of a focal factor."""

    def __init__(
        self,
        points2D: Points2D,
        points3D: Points3D,
        camera: Camera,
        max_error: float,
        *,
        refine_focal: bool,
        weights: Vector | None = None,
    ) -> None:
        self.usable = finite_rows(points2D) & finite_rows(points3D)
        self.camera, self.max_error, self.count = camera, max_error, int(self.usable.sum())
        self.points2D, self.points3D = points2D[self.usable], points3D[self.usable]
        self._focal = list(camera.model_info.focal_indices) if refine_focal else []
        self._weights = np.ones(self.count) if weights is None else weights[self.usable]

    def camera_of(self, state: FloatArray) -> Camera:
        """The camera under a state."""
        if not self._focal or len(state) == 12:
            return self.camera
        params = self.camera.params.copy()
        params[self._focal] *= np.exp(np.clip(state[12], -3.0, 3.0))
        return dataclasses.replace(self.camera, params=params)

    def squared_errors(self, state: FloatArray) -> FloatArray:
        """See `Problem`."""
        pixels, valid = self.camera_of(state).project(self._in_camera(state))
        return np.where(valid, np.square(pixels - self.points2D).sum(1), np.inf)

    def state(self, model: FloatArray) -> FloatArray:
        """See `Problem`."""
        return np.append(model, 0.0) if self._focal and len(model) == 12 else model

    def moved(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """See `Problem`."""
        return moved_pose(state, step)

    def normal_equations(self, state: FloatArray, loss: np.int64, scale: float) -> tuple[float, FloatArray, FloatArray]:
        """See `Problem`."""
        camera, points = self.camera_of(state), self._in_camera(state)
        pixels, by_point, by_params, valid = camera.project_with_jacobians(points)
        residuals = np.where(valid[:, None], pixels - self.points2D, 1e6)
        rho, weights = _robust(np.square(residuals).sum(1), loss, scale**2)
        # d(R X + t) = −[R X]× ω + υ
        rows = np.concatenate([-by_point @ skew(points - state[9:12]), by_point], axis=2)
        if self._focal:
            by_log_focal = by_params[:, :, self._focal] @ camera.params[self._focal]
            rows = np.concatenate([rows, by_log_focal[:, :, None]], axis=2)
        weights = self._weights * weights * valid
        weighted = (rows * weights[:, None, None]).reshape(-1, rows.shape[2])
        cost = float(self._weights @ rho)
        return cost, weighted.T @ rows.reshape(weighted.shape), weighted.T @ residuals.ravel()

    def _in_camera(self, state: FloatArray) -> Points3D:
        return self.points3D @ state[:9].reshape(3, 3).T + state[9:12]


def _robust(squares: Vector, loss: np.int64, square_scale: float) -> tuple[Vector, Vector]:
    """ρ and its derivative, as `robust_weight`."""
    if loss == TRUNCATED:
        return np.minimum(squares, square_scale), (squares < square_scale).astype(np.float64)
    return square_scale * np.log1p(squares / square_scale), 1 / (1 + squares / square_scale)


def estimate_absolute_pose(
    points2D: Points2D,
    points3D: Points3D,
    camera: Camera,
    config: RansacConfig = RansacConfig(max_error_px=12.0),
    *,
    rng: np.random.Generator,
    refine_focal: bool = False,
    quality: Vector | None = None,
) -> AbsolutePoseEstimate | Rejected:
    """The pose that most points agree with, by P3P and LO-RANSAC.

    Sampling and refinement use tangent reprojection errors, in px for any camera model, which at 12 px differ from the
    exact ones by a hundredth at most; only points in front of their ray count. Inliers are those of the exact errors.
    With `refine_focal` the camera's focal length is a guess: nine factors from 0.4 to 2.5 are tried by short runs,
    the best is sampled in full, and pose and focal length are refined together. A planar scene that is seen
    frontally leaves the focal length undetermined.

    Args:
        points2D: (N, 2) px; points3D: (N, 3) their points in the world. Rows that are not finite are never inliers.
        quality: (N,) larger for points that are more likely right (see `ransac`).
    Raises:
        ValueError: the point sets or the qualities differ in length.
    """
    check_lengths(points2D, points3D)
    refine_focal = refine_focal and bool(camera.model_info.focal_indices)
    if refine_focal:
        camera = _scanned_focal(points2D, points3D, camera, config, rng)
    tangent, usable = resection(points2D, points3D, camera, config.max_error_px)
    estimate = ransac(tangent, config, rng, chosen(quality, usable))
    if not isinstance(estimate, Estimate):
        return estimate
    exact = ReprojectionProblem(points2D, points3D, camera, config.max_error_px, refine_focal=refine_focal)
    state = exact.state(estimate.model)
    if refine_focal:
        state = polish(exact, refine(exact, state, TRUNCATED, config.max_error_px, _FOCAL_STEPS))
    inliers = scatter(exact.squared_errors(state) < config.max_error_px**2, exact.usable) & usable
    return AbsolutePoseEstimate(_rigid(state), exact.camera_of(state), inliers, estimate.iterations)


def refine_absolute_pose(
    points2D: Points2D,
    points3D: Points3D,
    camera: Camera,
    cam_from_world: Rigid3,
    *,
    max_error_px: float = 12.0,
    weights: Vector | None = None,
    refine_focal: bool = False,
) -> AbsolutePoseEstimate:
    """The pose that minimises Cauchy's loss of the reprojection errors, from a start, and the inliers under it.

    Args:
        weights: (N,) non-negative; an inlier mask serves. Default 1.
    Raises:
        ValueError: the point sets or the weights differ in length.
    """
    check_lengths(points2D, points3D)
    factors = np.ones(len(points2D)) if weights is None else np.asarray(weights, dtype=np.float64)
    check_lengths(points2D, factors)
    problem = ReprojectionProblem(points2D, points3D, camera, max_error_px, refine_focal=refine_focal, weights=factors)
    start = problem.state(np.concatenate([cam_from_world.rotation.matrix.ravel(), cam_from_world.translation]))
    # A coarse pass first: the scale that `polish` takes from the residuals presumes that they are near their best.
    state = polish(problem, refine(problem, start, CAUCHY, max_error_px, 20))
    inliers = problem.squared_errors(state) < max_error_px**2
    return AbsolutePoseEstimate(_rigid(state), problem.camera_of(state), scatter(inliers, problem.usable), 0)


def _scanned_focal(
    points2D: Points2D, points3D: Points3D, camera: Camera, config: RansacConfig, rng: np.random.Generator
) -> Camera:
    """The camera with the focal length, out of a grid of factors, under which a short run scores best."""
    short = dataclasses.replace(
        config,
        min_iterations=_SCAN_ITERATIONS,
        max_iterations=4 * _SCAN_ITERATIONS,
        min_inliers=4,
        min_inlier_ratio=0.0,
    )
    best, best_score = camera, np.inf
    for factor in _FOCAL_FACTORS:
        params = camera.params.copy()
        params[list(camera.model_info.focal_indices)] *= factor
        candidate = dataclasses.replace(camera, params=params)
        tangent, _ = resection(points2D, points3D, candidate, config.max_error_px)
        estimate = ransac(tangent, short, rng)
        if not isinstance(estimate, Estimate):
            continue
        exact = ReprojectionProblem(points2D, points3D, candidate, config.max_error_px, refine_focal=True)
        state = refine(exact, exact.state(estimate.model), TRUNCATED, config.max_error_px, _FOCAL_STEPS)
        score = float(np.minimum(exact.squared_errors(state), config.max_error_px**2).sum())
        if score < best_score:
            best, best_score = exact.camera_of(state), score
    return best


def _rigid(state: FloatArray) -> Rigid3:
    return Rigid3(Rotation3.from_matrix(state[:9].reshape(3, 3)), state[9:12])
