"""A camera: model, image size and parameters."""

from __future__ import annotations

import dataclasses
import math
from typing import TypeAlias

import numpy as np
from jaxtyping import Float64

from sfm.core.arrays import Mask, Matrix3, Points2D, Points3D, Rays, Value, Vector, readonly
from sfm.core.cameras import _kernels
from sfm.core.cameras.models import CameraModel, model_by_name

_ByPoint: TypeAlias = Float64[np.ndarray, "N 2 3"]
_ByParams: TypeAlias = Float64[np.ndarray, "N 2 K"]


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

    @property
    def max_angle(self) -> float:
        """The angle from the optical axis, in radians, up to which rays and pixels correspond one to one.

        It is where the radial part of the distortion stops increasing; tangential and thin-prism terms, which are
        small, are judged point by point in `project`. A perspective model ends at π/2 at the latest, the others at π.
        """
        limit = float(_kernels.distortion_limit(self.model_info.model_id, self.params.copy()))
        if not self.model_info.is_fisheye:
            return math.atan(limit)
        if self.model == "EUCM":
            return _eucm_max_angle(*self.params[4:])
        return _double_sphere_max_angle(*self.params[4:]) if self.model == "DOUBLE_SPHERE" else min(limit, math.pi)

    @property
    def max_radius(self) -> float:
        """`max_angle` as the model measures it: tan θ for perspective models (inf without a limit), else θ."""
        if self.model_info.is_fisheye:
            return self.max_angle
        return float(_kernels.distortion_limit(self.model_info.model_id, self.params.copy()))

    def with_params(self, params: Vector) -> Camera:
        """The same camera with other parameters.

        Raises:
            ValueError: the number of parameters is not the model's.
        """
        return dataclasses.replace(self, params=params)

    def scaled(self, width: int, height: int) -> Camera:
        """The camera of the same image resampled to `width` × `height`; distortion is independent of the size.

        A model with one focal length scales it by the mean of both ratios, hence exactly only if the aspect is kept.

        Raises:
            ValueError: the size is not positive.
        """
        if width < 1 or height < 1:
            raise ValueError(f"expected a positive image size, got {width} x {height}")
        across, down = width / self.width, height / self.height
        ratio = {"f": (across + down) / 2, "fx": across, "cx": across, "w": across, "fy": down, "cy": down, "h": down}
        ratios = [ratio.get(name, 1.0) for name in self.model_info.param_names]
        return dataclasses.replace(self, width=width, height=height, params=self.params * np.array(ratios))

    def project(self, points3D: Points3D) -> tuple[Points2D, Mask]:
        """Pixels of points in the camera frame, and whether each has one.

        A point without a pixel is NaN and False: behind a perspective camera, at the centre of any, straight behind a
        fisheye, straight above or below a panorama, or beyond the range in which the model is one to one
        (`max_angle`). Fisheye models do see points behind their image plane within that range. The pixel may lie
        outside the image.
        """
        return _kernels.project(self.model_info.model_id, self.params.copy(), readonly(points3D, (None, 3)))

    def project_with_jacobians(self, points3D: Points3D) -> tuple[Points2D, _ByPoint, _ByParams, Mask]:
        """Pixels, their derivatives by the point and by the parameters, and validity.

        The derivatives of a point without a pixel are zero.
        """
        points2D, by_point, by_params, valid = _kernels.project_with_jacobians(
            self.model_info.model_id, self.params.copy(), readonly(points3D, (None, 3))
        )
        return points2D, by_point, by_params[:, :, : len(self.params)], valid

    def unproject(self, points2D: Points2D) -> tuple[Rays, Mask]:
        """Unit rays in the camera frame of pixels, and whether each has one.

        A pixel that no ray reaches (beyond the image of `max_angle`; above or below a panorama) is NaN and False.
        A panorama continues periodically to its left and right.
        """
        return _kernels.unproject(self.model_info.model_id, self.params.copy(), readonly(points2D, (None, 2)))


def _eucm_max_angle(alpha: float, beta: float) -> float:
    """Where z = −w d: the rim of the ellipsoid (α > ½) or the ray parallel to the image plane of m = 0."""
    w = (1 - alpha) / alpha if alpha > 0.5 else alpha / (1 - alpha)
    return math.atan2(math.sqrt(max(1 - w * w, 0.0)), -w * math.sqrt(beta))


def _double_sphere_max_angle(xi: float, alpha: float) -> float:
    """Where cos φ = −w on the second sphere, as `_eucm_max_angle` has it; with ξ > 1, where rays touch the first."""
    if abs(xi) > 1:
        return math.acos(-1 / xi) if xi > 1 else 0.0
    w = (1 - alpha) / alpha if alpha > 0.5 else alpha / (1 - alpha)
    sine2 = max(1 - w * w, 0.0)
    reach = math.sqrt(1 - xi * xi * sine2) - xi * w
    return math.atan2(reach * math.sqrt(sine2), -reach * w - xi)
