"""Cameras on their way between the files of different programs, and what all readers of such files need."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sfm.core.arrays import FloatArray, Value
from sfm.core.cameras import Camera, model_by_name
from sfm.core.cameras.conversion import converted
from sfm.core.errors import FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.io.camera_bounds import out_of_bounds

_ROTATION_TOLERANCE = 1e-3
"""Of RᵀR − 1: files have few digits; what is farther off is no rotation."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CameraSet(Value):
    """Cameras in our convention of pixels, and how they stand to one another where a file tells.

    Attributes:
        names: all different.
        cams_from_rig: batch (N,), the first mostly the identity; None where it is not known.
        unit: of translations, "" where the file does not say.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    cams_from_rig: Rigid3 | None = None
    unit: str = ""

    def __post_init__(self) -> None:
        if len(set(self.names)) < len(self.names) or len(self.names) != len(self.cameras):
            raise ValueError(f"cameras need names of their own, got {', '.join(self.names)}")

    def __len__(self) -> int:
        """Number of cameras."""
        return len(self.cameras)


def camera_of(model: str, width: int, height: int, params: Sequence[float], *, pixel_center: float) -> Camera:
    """A camera whose principal point is as a program counts that has the first pixel's centre at `pixel_center`.

    Raises:
        ValueError: a number is not finite, or focal length, size or centre are none that a camera has.
    """
    info, values = model_by_name(model), np.array(params, np.float64)
    if why := out_of_bounds(info, width, height, values):
        raise ValueError(why)
    values[list(info.principal_point_indices)] += 0.5 - pixel_center
    return Camera(model, width, height, values, has_prior_focal_length=True)


def by_brown(
    size: tuple[int, int], matrix: FloatArray, coefficients: Sequence[float], *, pixel_center: float = 0.0
) -> Camera:
    """OpenCV's pinhole camera with 0, 4, 5, 8, 12 or 14 coefficients: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 τx τy.

    It gets the smallest model that has a place for all that is not zero among the coefficients behind the fourth.

    Raises:
        ValueError: there are as many as OpenCV never has, the pixels are skewed, or the sensor is tilted.
    """
    values = [float(value) for value in coefficients]
    if len(values) not in (0, 4, 5, 8, 12, 14):
        raise ValueError(f"OpenCV has 4, 5, 8, 12 or 14 distortion coefficients, got {len(values)}")
    values += [0.0] * (14 - len(values))
    if any(values[12:]):
        raise ValueError("the sensor is tilted (CALIB_TILTED_MODEL), which no camera model here is")
    if any(values[8:]):
        model, count = "FULL_OPENCV_THIN_PRISM", 12
    elif any(values[4:]):
        model, count = "FULL_OPENCV", 8
    else:
        model, count = ("OPENCV", 4) if any(values) else ("PINHOLE", 0)
    return camera_of(model, *size, [*focal_and_center(matrix), *values[:count]], pixel_center=pixel_center)


def by_kannala_brandt(
    size: tuple[int, int], matrix: FloatArray, coefficients: Sequence[float], *, pixel_center: float = 0.0
) -> Camera:
    """OpenCV's fisheye camera: k1 … k4 of θ.

    Raises:
        ValueError: there are not four, or the pixels are skewed.
    """
    if len(coefficients) != 4:
        raise ValueError(f"a fisheye has 4 distortion coefficients, got {len(coefficients)}")
    params = [*focal_and_center(matrix), *coefficients]
    return camera_of("OPENCV_FISHEYE", *size, params, pixel_center=pixel_center)


def focal_and_center(matrix: FloatArray) -> list[float]:
    """fx, fy, cx, cy of a camera matrix.

    Raises:
        ValueError: it is none, or has skew.
    """
    if matrix.shape != (3, 3):
        raise ValueError(f"the camera matrix is {' x '.join(map(str, matrix.shape))}")
    if matrix[2, 2] != 1.0 or np.any(matrix[[1, 2, 2], [0, 0, 1]] != 0):
        raise ValueError("the camera matrix is not upper triangular with 1 in its corner")
    if matrix[0, 1] != 0.0:
        raise ValueError(f"the camera matrix has skew, {matrix[0, 1]:.3g}, which no camera model here has")
    return [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])]


def numbers(value: Any, what: str, count: int | None = None) -> list[float]:
    """A list of finite numbers.

    Raises:
        ValueError: it is none, or has another length.
    """
    is_list = isinstance(value, list) and all(type(item) in (int, float) for item in value)
    if not is_list or (count is not None and len(value) != count):
        raise ValueError(f"{what} must be {count if count is not None else 'a list of'} numbers, got {str(value)[:60]}")
    if not all(math.isfinite(item) for item in value):
        raise ValueError(f"{what} holds what is not finite")
    return [float(item) for item in value]


def matrix_of(value: Any, what: str, rows: int | None = None, columns: int | None = None) -> FloatArray:
    """A matrix that is written with `rows`, `cols` and `data`, as lists of rows, or flat.

    Raises:
        ValueError: it is none, or has another shape.
    """
    if isinstance(value, Mapping):
        r, c = value.get("rows"), value.get("cols")
        if type(r) is not int or type(c) is not int:
            raise ValueError(f"{what} has no rows and cols")
        found = np.array(numbers(value.get("data"), what, r * c)).reshape(r, c)
    elif isinstance(value, list) and value and isinstance(value[0], list):
        lines = [numbers(line, what) for line in value]
        if len({len(line) for line in lines}) != 1:
            raise ValueError(f"{what} has rows of different lengths")
        found = np.array(lines)
    else:
        flat = np.array(numbers(value, what))
        found = flat.reshape(rows, columns) if rows and columns and flat.size == rows * columns else flat[:, None]
    if (rows and found.shape[0] != rows) or (columns and found.shape[1] != columns):
        raise ValueError(f"{what} must be {rows} x {columns}, got {' x '.join(map(str, found.shape))}")
    return found


def pose_of_matrix(matrix: FloatArray, what: str) -> Rigid3:
    """The motion of a 4 × 4 or 3 × 4 matrix.

    Raises:
        ValueError: its left part is no rotation.
    """
    R, t = matrix[:3, :3], matrix[:3, 3]
    if np.abs(R.T @ R - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError(f"{what} holds no rotation")
    return Rigid3(Rotation3.from_matrix(R), t)


def integer(value: Any, what: str) -> int:
    """A whole number, also where it is written as 640.0.

    Raises:
        ValueError: it is none.
    """
    if type(value) not in (int, float) or not math.isfinite(value) or int(value) != value:
        raise ValueError(f"{what} must be a whole number, got {value!r}")
    return int(value)


def as_one_of(camera: Camera, models: Sequence[str], program: str) -> Camera:
    """The camera as the first of these models that it equals exactly.

    Raises:
        FormatError: it is none of them; what is in the way, and the nearest way out.
    """
    for model in models:
        same = converted(camera, model)
        if isinstance(same, Camera):
            return same
    family = [name for name in models if model_by_name(name).is_fisheye == camera.model_info.is_fisheye]
    nearest = family[-1] if family else models[-1]
    why = converted(camera, nearest)
    raise FormatError(
        f"{program} cannot say what this {camera.model} is: {'' if isinstance(why, Camera) else why.detail}",
        remedy=f"--fit {nearest} takes the nearest camera that it has, and tells by how much it is off",
    )
