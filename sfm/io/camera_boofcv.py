"""BoofCV's calibration files, which are read only: pinhole cameras with Brown's distortion, and stereo pairs of them.

BoofCV does not say where it has the centre of a pixel; whole numbers are taken, as OpenCV has them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.io.camera_set import CameraSet, by_brown, camera_of, integer, matrix_of, numbers, pose_of_matrix


def is_boofcv(document: Mapping[str, Any]) -> bool:
    """Whether there is a table `pinhole` beside a model, or a pair of cameras with `rightToLeft`."""
    return ("pinhole" in document and "model" in document) or "rightToLeft" in document


def read_boofcv(document: Mapping[str, Any]) -> CameraSet:
    """The camera or the pair; translations are in whatever unit the board was.

    Raises:
        ValueError: something is missing or out of its range, or is a model that nothing here equals.
    """
    if "rightToLeft" not in document:
        return CameraSet(("camera",), (_camera(document),))
    sides = [_table(document, side) for side in ("left", "right")]
    motion = _table(document, "rightToLeft")
    rotation = matrix_of(motion.get("rotation"), "rotation", 3, 3)
    translation = numbers([motion.get(axis) for axis in "xyz"], "rightToLeft", 3)
    left_from_right = pose_of_matrix(np.column_stack([rotation, translation]), "rightToLeft")
    poses = Rigid3.stack([Rigid3.identity(), left_from_right.inverse()])
    return CameraSet(("left", "right"), (_camera(sides[0]), _camera(sides[1])), poses)


def _table(document: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    table = document.get(name)
    if not isinstance(table, Mapping):
        raise ValueError(f"has no table {name}")
    return table


def _camera(document: Mapping[str, Any]) -> Camera:
    pinhole, bent = _table(document, "pinhole"), document.get("radial_tangential") or {}
    fx, fy, cx, cy = numbers([pinhole.get(key) for key in ("fx", "fy", "cx", "cy")], "pinhole", 4)
    if pinhole.get("skew"):
        raise ValueError(f"has skew, {pinhole['skew']}, which no camera model here has")
    size = integer(pinhole.get("width"), "width"), integer(pinhole.get("height"), "height")
    radial = numbers(bent.get("radial") or [], "radial")
    tangential = numbers([bent.get("t1") or 0.0, bent.get("t2") or 0.0], "t1, t2", 2)
    model = document.get("model")
    if model == "omnidirectional_universal" and not any(radial) and not any(tangential):
        xi = numbers([document.get("mirror_offset")], "mirror_offset", 1)[0]
        params = [fx / (1 + xi), fy / (1 + xi), cx, cy, xi / (1 + xi), 1.0]
        return camera_of("EUCM", *size, params, pixel_center=0.0)
    if model not in ("pinhole", "pinhole_radial_tangential") or len(radial) > 3:
        raise ValueError(f"has the model {model!r} with {len(radial)} radial coefficients, which equals none here")
    k1, k2, k3 = [*radial, 0.0, 0.0, 0.0][:3]
    return by_brown(size, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), [k1, k2, *tangential, k3])
