"""The table of camera models, with COLMAP's names, ids and order of parameters where it has them.

Models that COLMAP lacks have ids from 10000 on; its own end at 17. Its files and databases cannot hold them.
"""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True, slots=True)
class CameraModel:
    """One row of the table.

    Attributes:
        model_id: as in COLMAP's files; from `FIRST_OWN_ID` on for a model that COLMAP lacks.
        param_names: in the order of `Camera.params`.
        focal_indices, principal_point_indices, extra_indices: positions among the parameters.
    """

    name: str
    model_id: int
    param_names: tuple[str, ...]
    is_fisheye: bool = False

    @property
    def is_in_colmap(self) -> bool:
        """Whether COLMAP has the model."""
        return self.model_id < FIRST_OWN_ID

    @property
    def focal_indices(self) -> tuple[int, ...]:
        """Positions of f, or of fx and fy; empty for a model without focal length."""
        return tuple(k for k, name in enumerate(self.param_names) if name in ("f", "fx", "fy"))

    @property
    def principal_point_indices(self) -> tuple[int, ...]:
        """Positions of cx and cy; empty for a model without principal point."""
        return tuple(k for k, name in enumerate(self.param_names) if name in ("cx", "cy"))

    @property
    def extra_indices(self) -> tuple[int, ...]:
        """Positions of the distortion parameters."""
        fixed = (*self.focal_indices, *self.principal_point_indices)
        return tuple(k for k, name in enumerate(self.param_names) if k not in fixed and name not in ("w", "h"))


FIRST_OWN_ID = 10000

_F, _FXY = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")

MODELS: tuple[CameraModel, ...] = (
    CameraModel("SIMPLE_PINHOLE", 0, _F),
    CameraModel("PINHOLE", 1, _FXY),
    CameraModel("SIMPLE_RADIAL", 2, (*_F, "k")),
    CameraModel("RADIAL", 3, (*_F, "k1", "k2")),
    CameraModel("OPENCV", 4, (*_FXY, "k1", "k2", "p1", "p2")),
    CameraModel("OPENCV_FISHEYE", 5, (*_FXY, "k1", "k2", "k3", "k4"), is_fisheye=True),
    CameraModel("FULL_OPENCV", 6, (*_FXY, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    CameraModel("SIMPLE_RADIAL_FISHEYE", 8, (*_F, "k"), is_fisheye=True),
    CameraModel("RADIAL_FISHEYE", 9, (*_F, "k1", "k2"), is_fisheye=True),
    CameraModel("THIN_PRISM_FISHEYE", 10, (*_FXY, "k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"), is_fisheye=True),
    CameraModel("EUCM", 16, (*_FXY, "alpha", "beta"), is_fisheye=True),
    CameraModel("EQUIRECTANGULAR", 17, ("w", "h"), is_fisheye=True),
    CameraModel(
        "FULL_OPENCV_THIN_PRISM",
        10001,
        (*_FXY, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"),
    ),
    CameraModel("DOUBLE_SPHERE", 10002, (*_FXY, "xi", "alpha"), is_fisheye=True),
)

COLMAP_MODELS: tuple[CameraModel, ...] = tuple(model for model in MODELS if model.is_in_colmap)
"""Those that COLMAP's files can hold."""

_BY_NAME = {model.name: model for model in MODELS}
_BY_ID = {model.model_id: model for model in MODELS}


def model_by_name(name: str) -> CameraModel:
    """The model called `name`.

    Raises:
        ValueError: there is none.
    """
    if name not in _BY_NAME:
        raise ValueError(f"unknown camera model {name!r}; known are {', '.join(_BY_NAME)}")
    return _BY_NAME[name]


def model_by_id(model_id: int) -> CameraModel:
    """The model with the number `model_id`, COLMAP's where it has the model.

    Raises:
        ValueError: Parallax does not have it.
    """
    if model_id not in _BY_ID:
        raise ValueError(f"camera model {model_id} is not supported; known are {sorted(_BY_ID)}")
    return _BY_ID[model_id]
