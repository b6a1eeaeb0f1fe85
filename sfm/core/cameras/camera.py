"""A camera: model, image size and parameters."""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.arrays import Mask, Matrix3, Points2D, Points3D, Rays, Value, Vector, readonly
from sfm.core.cameras import _kernels
from sfm.core.cameras.models import CameraModel, model_by_name


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Camera(Value):
    """Intrinsic calibration; `params` in the order of `CameraModel.param_names`, in px of the full image.

    Attributes:
        has_prior_focal_length: the focal length was measured or given, not guessed.

    Raises:
        ValueError: the model is unknown, or the number of parameters is not the model's.
    """

    model: str
    width: int
    height: int
    params: Vector
    has_prior_focal_length: bool = False

    def __post_init__(self) -> None:
        count = len(self.model_info.param_names)
        object.__setattr__(self, "params", readonly(self.params, (count,)))

    @property
    def model_info(self) -> CameraModel:
        """The row of the table of models."""
        return model_by_name(self.model)

    @property
    def focal_lengths(self) -> tuple[float, float]:
        """(fx, fy) in px; for EQUIRECTANGULAR the px per radian at the centre."""
        indices = self.model_info.focal_indices
        if not indices:
            return self.width / (2 * np.pi), self.height / np.pi
        return float(self.params[indices[0]]), float(self.params[indices[-1]])

    @property
    def mean_focal_length(self) -> float:
        """Mean of fx and fy in px."""
        return sum(self.focal_lengths) / 2

    @property
    def principal_point(self) -> tuple[float, float]:
        """(cx, cy) in px."""
        indices = self.model_info.principal_point_indices
        if not indices:
            return self.width / 2, self.height / 2
        return float(self.params[indices[0]]), float(self.params[indices[1]])

    @property
    def calibration_matrix(self) -> Matrix3:
        """K of the pinhole part."""
        (fx, fy), (cx, cy) = self.focal_lengths, self.principal_point
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    def project(self, points3D: Points3D) -> tuple[Points2D, Mask]:
        """Pixels of points in the camera frame, and whether each has one.

        A point without a pixel (behind a perspective camera, at its centre, beyond the model's valid radius) is
        NaN and False. The pixel may lie outside the image.
        """
        return _kernels.project(self.model_info.model_id, self.params, np.ascontiguousarray(points3D))

    def project_with_jacobians(
        self, points3D: Points3D
    ) -> tuple[Points2D, np.ndarray, np.ndarray, Mask]:
        """Pixels, their derivatives (N, 2, 3) by the point and (N, 2, K) by the parameters, and validity."""
        points2D, by_point, by_params, valid = _kernels.project_with_jacobians(
            self.model_info.model_id, self.params, np.ascontiguousarray(points3D)
        )
        return points2D, by_point, by_params[:, :, : len(self.params)], valid

    def unproject(self, points2D: Points2D) -> tuple[Rays, Mask]:
        """Unit rays in the camera frame of pixels, and whether each has one (NaN and False where not)."""
        return _kernels.unproject(self.model_info.model_id, self.params, np.ascontiguousarray(points2D))
