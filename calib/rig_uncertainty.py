"""How uncertain a calibrated rig is, and what it says of frames that it has not seen.

With unit noise the covariance of what frames share is Σ = S⁻¹ (see `rig_system`). Every corner speaks for itself, by
its own residual, as in `uncertainty`; here the pose that is projected out is that of the frame, which the corners of
several cameras share. It takes residuals for independent; `by_frame` takes only the frames for independent, by leaving
out each in turn with one Newton step, as `uncertainty` does with views.

The tangent of the pose of camera 2 relative to camera 1, T = T_2 T_1⁻¹, is  δ_2 − Ad(T) δ_1.  With T = (R, t) and
δ = (ω, υ) its translation moves by ω × t + υ, and the baseline |t| by υ · t / |t|.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from calib.rig_result import RigCalibration
from calib.rig_system import RigSystem
from calib.rig_views import RigObservations
from calib.uncertainty_corners import corner_derivatives, corner_scores, jackknife
from sfm.core.arrays import FloatArray, Value, readonly
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import skew
from sfm.core.optim.levenberg_marquardt import StopRules, minimize

_POSES = StopRules(max_iterations=50, relative_cost_tolerance=1e-10, gradient_tolerance=0.0)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigCovariance(Value):
    """Covariances of what was estimated.

    Attributes:
        shared: (K, K) of mounts, then free parameters of one camera after the other, then the board's coefficients;
            infinite by frame, on the diagonal, for those of the board that one frame fewer leaves open.
        mounts: (N, 6, 6) of the tangents (ω, υ) of `cams_from_rig`; zero for the first.
        sigma_params: of each camera by the names of its free parameters.
        variance: σ² of one whitened coordinate, px², already in all of them.
    """

    shared: Float64[np.ndarray, "K K"]
    mounts: Float64[np.ndarray, "N 6 6"]
    sigma_params: tuple[dict[str, float], ...]
    variance: float
    mount_slices: tuple[slice, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "shared", readonly(self.shared, (None, None)))
        object.__setattr__(self, "mounts", readonly(self.mounts, (None, 6, 6)))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RelativeUncertainty(Value):
    """How well the pose of one camera relative to another is known.

    Attributes:
        covariance: (6, 6) of the tangent (ω, υ), radians and the board's unit.
        baseline, sigma_baseline: distance of the cameras, in the board's unit.
        sigma_rotation: (3,) of turns about the axes of camera 2, radians.
        sigma_translation: (3,) of the translation.
    """

    cam2_from_cam1: Rigid3
    covariance: Float64[np.ndarray, "6 6"]
    baseline: float
    sigma_baseline: float
    sigma_rotation: Float64[np.ndarray, " 3"]
    sigma_translation: Float64[np.ndarray, " 3"]


def rig_covariance(found: RigCalibration, *, by_frame: bool = False, alike: bool = False) -> RigCovariance | Rejected:
    """Covariances at the solution, each corner as uncertain as its residual tells.

    Args:
        by_frame: by leaving out each frame in turn, which holds however residuals of one frame are correlated; it needs
            many more frames than shared parameters to be accurate itself.
        alike: takes all corners of a camera for equally certain.
    Returns:
        `undetermined_parameters` where the frames leave a combination of them open.
    """
    system = found.system()
    unit = system.shared_inverse()
    if unit is None:
        return Rejected("undetermined_parameters", "the frames leave a combination of parameters open")
    variance = found.sigma_px**2
    if by_frame:
        without = jackknife(*system.by_frame(), system.param_slices[-1].stop)
        if without is None:
            return Rejected("undetermined_parameters", "without one of the frames a combination of parameters is open")
        shared, left_open = without
        shared[left_open, left_open] = np.inf
    else:
        shared = variance * unit if alike else _by_corner(found, system, unit)
    mounts = np.zeros((len(found.names), 6, 6))
    for c, at in enumerate(system.mount_slices):
        if at.stop > at.start:
            mounts[c] = shared[at, at]
    deviations = np.sqrt(np.diag(shared))
    return RigCovariance(
        shared=shared,
        mounts=mounts,
        sigma_params=tuple(
            dict(zip(names, deviations[at].tolist(), strict=True))
            for names, at in zip(found.free_names, system.param_slices, strict=True)
        ),
        variance=variance,
        mount_slices=tuple(system.mount_slices),
    )


def relative_uncertainty(
    found: RigCalibration, covariances: RigCovariance, camera1: int, camera2: int
) -> RelativeUncertainty:
    """Of two cameras by their positions in the rig."""
    motion = found.cams_from_rig[camera2] @ found.cams_from_rig[camera1].inverse()
    count = covariances.mount_slices[-1].stop
    J = np.zeros((6, count))
    # The mount of the first camera is held: its slice is empty.
    one, two = covariances.mount_slices[camera1], covariances.mount_slices[camera2]
    J[:, one] = -motion.adjoint()[:, : one.stop - one.start]
    J[:, two] += np.eye(6)[:, : two.stop - two.start]
    covariance = J @ covariances.shared[:count, :count] @ J.T
    t = np.array(motion.translation)
    baseline = float(np.linalg.norm(t))
    along = t / max(baseline, 1e-300)
    by_tangent = np.concatenate([-skew(t), np.eye(3)], axis=1)
    return RelativeUncertainty(
        cam2_from_cam1=motion,
        covariance=covariance,
        baseline=baseline,
        sigma_baseline=math.sqrt(max(float(along @ covariance[3:, 3:] @ along), 0.0)),
        sigma_rotation=np.sqrt(np.maximum(np.diag(covariance)[:3], 0.0)),
        sigma_translation=np.sqrt(np.maximum(np.diag(by_tangent @ covariance @ by_tangent.T), 0.0)),
    )


def _by_corner(found: RigCalibration, system: RigSystem, sigma: FloatArray) -> FloatArray:
    """HC2, view by view; with what rejection has hidden."""
    equations, meat = system.normal_equations(), np.zeros_like(sigma)
    inverses, W = np.linalg.inv(equations.H), equations.W[:, :, :-1]
    for c, o in enumerate(found.observations.cameras):
        mount = found.cams_from_rig[c]
        for v, f in enumerate(found.observations.frame_of[c].tolist()):
            part = slice(o.offsets[v], o.offsets[v + 1])
            rows = o.rows[part]
            by = corner_derivatives(
                found.cameras[c], found.columns[c], mount @ found.rigs_from_board[f], found.shape.points3D[rows],
                found.shape.basis[rows], o.roots[part], found.residuals[c][part],
            )  # fmt: skip
            by_shared = np.zeros((len(rows), 2, len(sigma)))
            held = slice(0, system.mount_slices[c].stop - system.mount_slices[c].start)
            by_shared[:, :, system.mount_slices[c]] = by.by_pose[:, :, held]
            by_shared[:, :, system.param_slices[c]] = by.by_params
            by_shared[:, :, system.param_slices[-1].stop :] = by.by_shape
            scores = corner_scores(by.by_pose @ mount.adjoint(), by_shared, by.residuals, inverses[f], W[f], sigma)
            meat += scores.T @ scores
    return sigma @ meat @ sigma


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigHeldOut(Value):
    """Errors of frames that were held out.

    Attributes:
        frames: those that two cameras or more saw.
        squares: (S,) mean squared length of the residuals of each, px², with the rig of the other frames and its own
            pose.
        counts: (S,) corners.
        training_rms_px: of the same frames in the fit that knew them.
    """

    frames: tuple[str, ...]
    squares: Float64[np.ndarray, " S"]
    counts: Float64[np.ndarray, " S"]
    training_rms_px: float

    @property
    def rms_px(self) -> float:
        """Over all corners."""
        return math.sqrt(float(self.squares @ self.counts / self.counts.sum()))


def hold_out_frames(found: RigCalibration, *, folds: int = 5, rng: np.random.Generator) -> RigHeldOut | Rejected:
    """Errors of the frames of a rig, each held out once, at the corners that it kept.

    Returns:
        `too_few_frames` where the others do not determine the rig.
    """
    observations, estimate = found.observations, found.estimate
    shared = np.flatnonzero(observations.views_per_frame > 1)
    folds = min(folds, len(shared))
    if folds < 2:
        return Rejected("too_few_frames", f"{len(shared)} frames seen by two cameras")
    order, fit = rng.permutation(shared), found.fit
    squares, counts = np.zeros(len(observations.frames)), np.zeros(len(observations.frames))
    for fold in range(folds):
        held = np.sort(order[fold::folds])
        rest = np.setdiff1d(np.arange(len(observations.frames)), held)
        some, left = observations.of_frames(rest.tolist())
        system, _ = fit.solve(some, estimate.of_frames(left))
        if not math.isfinite(system.newton_decrement()):
            return Rejected("too_few_frames", f"without {len(held)} of {len(shared)} frames a camera is lost")
        rig = system.estimate
        there, left = observations.of_frames(held.tolist())
        placed = dataclasses.replace(
            estimate.of_frames(left), cameras=rig.cameras, mount_rotations=rig.mount_rotations,
            mount_translations=rig.mount_translations, shape=rig.shape,
        )  # fmt: skip
        none = [np.zeros(0, np.int64)] * len(rig.cameras)
        judge = RigSystem(there, placed, none, free_mounts=False)
        minimize(judge, _POSES)
        sums, known = frame_sums(there, judge.residuals())
        squares[left], counts[left] = sums, known
    trained, known = frame_sums(observations, found.residuals)
    return RigHeldOut(
        frames=tuple(observations.frames[f] for f in shared),
        squares=squares[shared] / counts[shared],
        counts=counts[shared],
        training_rms_px=math.sqrt(float(trained[shared].sum() / known[shared].sum())),
    )


def frame_sums(observations: RigObservations, residuals: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Of each frame the sum of squared lengths of residuals, px², and the number of corners."""
    sums, counts = np.zeros(len(observations.frames)), np.zeros(len(observations.frames))
    for r, camera, frames in zip(residuals, observations.cameras, observations.frame_of, strict=True):
        of_corner = frames[camera.view_of]
        sums += np.bincount(of_corner, np.sum(r**2, axis=1), len(sums))
        counts += np.bincount(of_corner, minlength=len(sums))
    return sums, counts
