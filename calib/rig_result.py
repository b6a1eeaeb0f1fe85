"""What a calibration of a rig is asked for, and what it gives."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float64

from calib.refine import Calibration
from calib.refine_board import BoardShape, ShapeKind
from calib.refine_fit import CalibrationConfig
from calib.refine_reject import RejectedView
from calib.refine_views import Observations
from calib.rig_alone import AloneCamera
from calib.rig_estimate import RigEstimate
from calib.rig_reject import RigFit
from calib.rig_system import RigSystem
from calib.rig_views import RigObservations
from sfm.core.arrays import Value, Vector
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RigConfig:
    """How a rig is calibrated."""

    refine_intrinsics: bool = True
    """Cameras that were calibrated here are refined together with the rig, which is the most probable solution;
    otherwise they stay as each of them says alone."""
    refine_known: bool = False
    """Cameras that were given are refined as well."""
    shape: ShapeKind = "flat"
    """What the board may be; see `refine_board`."""
    weigh_cameras: bool = True
    """Corners of a camera weigh by the noise that it has alone. Otherwise a pixel is a pixel, as in OpenCV."""
    min_frames: int = 3
    """That two cameras must share to be connected; below it a wrong one could not be told."""
    reject: bool = True
    """Leave out corners and views that do not fit."""
    min_corners: int = 6
    """In a view."""
    reject_beyond_sigma: float = 5.0
    """A corner farther off starts the rejection."""
    keep_within_sigma: float = 4.0
    """What rejection then cuts at."""
    max_iterations: int = 500
    relative_cost_tolerance: float = 1e-12
    keep_invertible: bool = True
    """No corner may lie where a distortion turns back."""

    def alone(self, lens: str) -> CalibrationConfig:
        """For the calibration of one camera alone."""
        return CalibrationConfig(
            lens=lens,
            shape=self.shape,
            reject=self.reject,
            min_corners=self.min_corners,
            reject_beyond_sigma=self.reject_beyond_sigma,
            keep_within_sigma=self.keep_within_sigma,
            max_iterations=self.max_iterations,
            relative_cost_tolerance=self.relative_cost_tolerance,
            keep_invertible=self.keep_invertible,
        )


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CameraOfRig(Value):
    """One camera of a rig with what it saw; residuals (n, 2) are projected − observed, px."""

    camera: Camera
    observations: Observations
    residuals: Float64[np.ndarray, "n 2"]

    @property
    def view_rms_px(self) -> Vector:
        """(V,) of each view."""
        squares = np.sum(self.residuals**2, axis=1)
        counts = np.bincount(self.observations.view_of, minlength=len(self.observations))
        return np.sqrt(np.bincount(self.observations.view_of, squares, len(counts)) / np.maximum(counts, 1))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigCalibration(Value):
    """Cameras and how they stand, with what they were made from.

    Attributes:
        names: of the cameras; the rig's frame is that of the first.
        cams_from_rig: batch (N,), in the board's unit; the first is the identity.
        rigs_from_board: batch (F,), of the frames of `observations`.
        free_names: of each camera the parameters that were estimated.
        observations: of the views and corners that were used. Their weights contain those of the cameras.
        residuals: of each camera (n, 2) projected − observed, px.
        alone: each camera by itself.
        turned: of each camera the frames in which it reads the board from another end than it was given with.
        rejected_views: by camera.
        rejected_corners: by camera, as (name of the view, row of the board's point).
        rms_px: root of the mean squared length of residuals over all corners.
        sigma_px: standard deviation of one whitened coordinate, √(Σ r² / (2 n − parameters)).
        fallbacks: what rests on little, in words.
        converged: another step, undamped, promises less than a billionth of the cost.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    cams_from_rig: Rigid3
    rigs_from_board: Rigid3
    shape: BoardShape
    free_names: tuple[tuple[str, ...], ...]
    observations: RigObservations
    residuals: tuple[Float64[np.ndarray, "_ 2"], ...]
    alone: tuple[AloneCamera, ...]
    turned: tuple[tuple[str, ...], ...]
    rejected_views: tuple[tuple[RejectedView, ...], ...]
    rejected_corners: tuple[tuple[tuple[str, int], ...], ...]
    rms_px: float
    sigma_px: float
    fallbacks: tuple[str, ...]
    converged: bool
    iterations: int
    cost: float

    @property
    def estimate(self) -> RigEstimate:
        """As the solver wants it."""
        mounts, frames = self.cams_from_rig, self.rigs_from_board
        return RigEstimate(
            self.cameras, mounts.rotation.matrix, np.array(mounts.translation), frames.rotation.matrix,
            np.array(frames.translation), self.shape,
        )  # fmt: skip

    @property
    def columns(self) -> list[np.ndarray]:
        """Of each camera the positions of its free parameters."""
        return [
            np.flatnonzero([name in free for name in camera.model_info.param_names])
            for camera, free in zip(self.cameras, self.free_names, strict=True)
        ]

    @property
    def camera_rms_px(self) -> tuple[float, ...]:
        """As `rms_px`, of each camera."""
        return tuple(math.sqrt(float(np.mean(np.sum(r**2, axis=1)))) for r in self.residuals)

    def one_camera(self, camera: int) -> CameraOfRig:
        """What the rig says of one of its cameras."""
        return CameraOfRig(self.cameras[camera], self.observations.cameras[camera], self.residuals[camera])

    @property
    def fit(self) -> RigFit:
        """To fit again, with other views."""
        return RigFit(True, 500, 1e-12, math.inf, math.inf, 0, math.inf, tuple(self.columns))

    @property
    def calibrations(self) -> tuple[Calibration | None, ...]:
        """Of each camera alone; None where it was known."""
        return tuple(one.calibration for one in self.alone)

    def system(self) -> RigSystem:
        """The problem at its solution."""
        free_shape = len(self.shape.coefficients) > 0
        return RigSystem(self.observations, self.estimate, self.columns, free_shape=free_shape)
