"""How uncertain a calibration is: its parameters, its poses, and where it says that a ray of the scene is seen.

With unit noise the covariance of what views share is Σ = S⁻¹ (see `refine_system`) and that of a pose

    H_v⁻¹ + H_v⁻¹ W_vᵀ Σ W_v H_v⁻¹

both times the variance σ² of the residuals, if all corners are equally certain. They are not: one of a small or
slanted square errs twice as much as one of a large square, and where it counts most. So every corner i speaks for
itself, by its own residual e_i. With D_i (2, K) its derivatives by what views share, those by the pose projected out,
and h_i its leverage, the part of its own error that the fit has followed,

    Σ (Σ_i D_iᵀ r_i r_iᵀ D_i) Σ,      r_i = (I − h_i)^−½ e_i

which is right on average where corners are alike as well. What rejection hides is not added: its limits are far beyond
what good corners err by.

Both take residuals for independent. `by_view` takes only the views for independent: each is left out in turn, by one
Newton step from the solution,

    θ₋ᵥ − θ = (S − S_v)⁻¹ s_v,      s_v = J_vᵀ e_v the view's part of the gradient

and the scatter of what comes of it is the covariance (the jackknife).

The parameters of a lens are no use to anybody by themselves: a shift of the principal point is nearly a turn of the
camera. What counts is by how much the pixel of a fixed point would move, were the calibration repeated, when camera
frames are aligned as well as the data tell. A repetition that moves pose v by δ_v, tangents of the camera frame, has
moved the frame by the ξ that minimises Σ (δ_v − ξ)ᵀ H_v (δ_v − ξ). As δ_v = −H_v⁻¹ W_vᵀ dθ + noise of covariance H_v⁻¹,

    ξ = −(Σ H_v)⁻¹ (Σ W_vᵀ) dθ + noise of covariance (Σ H_v)⁻¹
    dq = ∂q/∂θ dθ + ∂q/∂p [−[p]×, I] ξ

for a point p of the camera frame; for one infinitely far ξ is its turn alone.

Reference:
    Kogan, mrcal, Projection uncertainty (documentation): the idea, and the implied movement of the frame.
    MacKinnon & White, Some heteroskedasticity-consistent covariance matrix estimators, 1985: HC2.
    Bell & McCaffrey, Bias reduction in standard errors for linear regression with multi-stage samples, 2002.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float64

from calib.refine import Calibration
from calib.uncertainty_corners import (
    corner_derivatives,
    corner_scores,
    jackknife,
    scaled_inverse,
)
from sfm.core.arrays import FloatArray, Points2D, Value, Vector, readonly
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew

_ALIGNMENTS = 8


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CalibrationCovariance(Value):
    """Covariances of what was estimated.

    Attributes:
        names: of the shared parameters: the free ones of the camera, then "shape 0" … of the board.
        shared: (K, K) of them. Coefficients of the board that one view fewer leaves open have an infinite variance by
            view; `frame` holds them as they are then.
        poses: (V, 6, 6) of the tangents (ω, υ) of `cams_from_board`, radians and units of the board.
        frame: (K + 6, K + 6) of the shared parameters and the implied movement ξ of the camera frame.
        variance: σ² of one coordinate of a residual, px², already in all of them.
    """

    names: tuple[str, ...]
    shared: Float64[np.ndarray, "K K"]
    poses: Float64[np.ndarray, "V 6 6"]
    frame: Float64[np.ndarray, "L L"]
    variance: float

    def __post_init__(self) -> None:
        for name, shape in (("shared", (None, None)), ("poses", (None, 6, 6)), ("frame", (None, None))):
            object.__setattr__(self, name, readonly(getattr(self, name), shape))

    @property
    def deviations(self) -> dict[str, float]:
        """Standard deviation of each shared parameter."""
        return dict(zip(self.names, np.sqrt(np.diag(self.shared)).tolist(), strict=True))


def covariance(
    calibration: Calibration, *, by_view: bool = False, alike: bool = False
) -> CalibrationCovariance | Rejected:
    """Covariances at the solution, each corner as uncertain as its residual tells.

    Args:
        by_view: by leaving out each view in turn, which holds however residuals of one view are correlated; it needs
            many more views than parameters to be accurate itself.
        alike: takes all corners for equally certain (by their covariances, where they came with any), as OpenCV does.
            So does the covariance of poses, always.
    Returns:
        `undetermined_parameters` where the views leave a parameter open.
    """
    parts = _parts(calibration)
    sigma = scaled_inverse(parts.reduced.sum(0))
    if sigma is None:
        return Rejected("undetermined_parameters", "the views leave a combination of parameters open")
    variance = calibration.sigma_px**2
    left_open = np.zeros(len(sigma), bool)
    if by_view:
        found = jackknife(parts.reduced, parts.scores, len(calibration.free_names))
        if found is None:
            return Rejected("undetermined_parameters", "without one of the views a combination of parameters is open")
        shared, left_open = found
    else:
        shared = variance * sigma if alike else _by_corner(calibration, parts, sigma)
    solved = np.linalg.solve(parts.H, parts.W)
    total = np.linalg.inv(parts.H.sum(0))
    turn = -total @ parts.W.sum(0)
    frame = np.block([[shared, shared @ turn.T], [turn @ shared, turn @ shared @ turn.T + variance * total]])
    shared = shared.copy()
    shared[left_open, left_open] = np.inf
    shape = [f"shape {k}" for k in range(len(sigma) - len(calibration.free_names))]
    return CalibrationCovariance(
        names=(*calibration.free_names, *shape),
        shared=shared,
        poses=variance * (np.linalg.inv(parts.H) + solved @ sigma @ solved.swapaxes(1, 2)),
        frame=frame,
        variance=variance,
    )


def projection_covariances(
    calibration: Calibration, covariances: CalibrationCovariance, points2D: Points2D, distance: float = math.inf
) -> Float64[np.ndarray, "N 2 2"]:
    """Covariance in px² of the pixel of what is seen at `points2D` now; NaN for a pixel without a ray.

    Args:
        distance: of what is seen, from the camera, in the board's unit.
    """
    camera, count = calibration.camera, len(calibration.free_names)
    rays, valid = camera.unproject(points2D)
    rays = np.where(valid[:, None], rays, [0.0, 0.0, 1.0])
    _, by_point, by_params, _ = camera.project_with_jacobians(rays)
    J = np.zeros((len(points2D), 2, len(covariances.frame)))
    J[:, :, :count] = by_params[:, :, calibration.columns]
    J[:, :, -6:-3] = -by_point @ skew(rays)
    J[:, :, -3:] = by_point / distance
    out = J @ covariances.frame @ J.swapaxes(1, 2)
    out[~valid] = np.nan
    return out


def worst_deviations(covariances: Float64[np.ndarray, "N 2 2"]) -> Vector:
    """(N,) standard deviation in the worst direction."""
    a, b, d = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    return np.sqrt(np.maximum((a + d) / 2 + np.hypot((a - d) / 2, b), 0.0))


def uncertainty_map(
    calibration: Calibration, covariances: CalibrationCovariance, distance: float = math.inf, across: int = 40
) -> tuple[Float64[np.ndarray, "Y X"], Points2D]:
    """Standard deviation in px, in the worst direction, over the image; and the pixels (Y X, 2), row by row."""
    pixels, shape = pixel_grid(calibration.camera, across)
    return worst_deviations(projection_covariances(calibration, covariances, pixels, distance)).reshape(shape), pixels


def rms_uncertainty(calibration: Calibration, covariances: CalibrationCovariance, across: int = 24) -> float:
    """Of `uncertainty_map` for what is far away, over the pixels that have a ray; inf where none has."""
    deviations, _ = uncertainty_map(calibration, covariances, across=across)
    seen = deviations[np.isfinite(deviations)]
    return math.sqrt(float(np.mean(seen**2))) if len(seen) else math.inf


def pixel_grid(camera: Camera, across: int = 40) -> tuple[Points2D, tuple[int, int]]:
    """Centres of square cells that cover the image, so many across, row by row; and how many down and across."""
    down = max(1, round(across * camera.height / camera.width))
    x = (np.arange(across) + 0.5) * camera.width / across
    y = (np.arange(down) + 0.5) * camera.height / down
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2), (down, across)


def projection_difference(
    camera1: Camera, camera2: Camera, points2D: Points2D, distance: float = math.inf
) -> Float64[np.ndarray, "N 2"]:
    """Where `camera2` sees what `camera1` sees at `points2D`, less `points2D`, px; NaN where one of them sees nothing.

    Frames are aligned first, by the turn (and for a finite distance the shift) that makes the differences least in
    the sense of least squares.
    """
    rays, valid = camera1.unproject(points2D)
    points = np.where(valid[:, None], rays, [0.0, 0.0, 1.0]) * (distance if math.isfinite(distance) else 1.0)
    free = 6 if math.isfinite(distance) else 3
    motion = Rigid3.identity()
    for _ in range(_ALIGNMENTS):
        moved = motion @ points
        pixels, by_point, _, seen = camera2.project_with_jacobians(moved)
        both = valid & seen
        if both.sum() < free:
            break
        J = np.concatenate([-by_point @ skew(moved), by_point], 2)[both, :, :free].reshape(-1, free)
        step = np.linalg.lstsq(J, -(pixels - points2D)[both].ravel(), rcond=None)[0]
        motion = Rigid3(Rotation3.exp(step[:3]), step[3:] if free == 6 else np.zeros(3)) @ motion
    pixels, seen = camera2.project(motion @ points)
    return np.where((valid & seen)[:, None], pixels - points2D, np.nan)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """Of each view: H (6, 6), W (6, K), what it adds to S (K, K) and to the gradient (K,) with its pose eliminated."""

    H: FloatArray
    W: FloatArray
    reduced: FloatArray
    scores: FloatArray


def _parts(calibration: Calibration) -> _Parts:
    blocks = np.tril(calibration.system().blocks)
    blocks = blocks + np.tril(blocks, -1).swapaxes(1, 2)
    H, W, A = blocks[:, :6, :6], blocks[:, :6, 6:-1], blocks[:, 6:-1, 6:-1]
    solved = np.linalg.solve(H, W)
    reduced = A - W.swapaxes(1, 2) @ solved
    scores = blocks[:, 6:-1, -1] - np.einsum("vik,vi->vk", solved, blocks[:, :6, -1])
    return _Parts(H, W, reduced, scores)


def _by_corner(calibration: Calibration, parts: _Parts, sigma: FloatArray) -> FloatArray:
    """HC2, view by view."""
    observations, shape, meat = calibration.observations, calibration.shape, np.zeros_like(sigma)
    for v, inverse in enumerate(np.linalg.inv(parts.H)):
        part = slice(observations.offsets[v], observations.offsets[v + 1])
        rows = observations.rows[part]
        by = corner_derivatives(
            calibration.camera, calibration.columns, calibration.cams_from_board[v],
            observations.board[rows] + shape.displacements[rows], shape.basis[rows],
            observations.roots[part], calibration.residuals[part],
        )  # fmt: skip
        by_shared = np.concatenate([by.by_params, by.by_shape], axis=2)
        scores = corner_scores(by.by_pose, by_shared, by.residuals, inverse, parts.W[v], sigma)
        meat += scores.T @ scores
    return sigma @ meat @ sigma
