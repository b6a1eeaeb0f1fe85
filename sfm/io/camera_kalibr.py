"""Cameras and rigs as Kalibr's camchain has them, and EuRoC's sensor.yaml, which is read only.

| camera_model | intrinsics | distortion_model |
|---|---|---|
| pinhole | fu fv pu pv | none, radtan (k1 k2 p1 p2), equidistant (k1 … k4) |
| omni | ξ fu fv pu pv | none |
| eucm | α β fu fv pu pv | none |
| ds | ξ α fu fv pu pv | none |

`T_cn_cnm1` of each camera but the first is its pose from the camera before it, in metres. Kalibr does not say where it
has the centre of a pixel; it starts with (w − 1)/2, so that whole numbers are taken, as OpenCV's corners have them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.io.camera_set import (
    CameraSet,
    as_one_of,
    by_brown,
    by_kannala_brandt,
    camera_of,
    integer,
    matrix_of,
    numbers,
    pose_of_matrix,
)  # fmt: skip

_CAMERA = re.compile(r"cam(\d+)$")
_MODELS = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "EUCM", "DOUBLE_SPHERE")
_RADTAN = ("radtan", "radial-tangential", "radtan4", "plumb_bob")
_EQUIDISTANT = ("equidistant", "equi", "equi4")
_NONE = ("none", "None", "")


def is_kalibr(document: Mapping[str, Any]) -> bool:
    """Whether there are tables cam0, … with intrinsics, or the intrinsics of one EuRoC sensor."""
    return bool(_tables(document)) or ("intrinsics" in document and "resolution" in document)


def read_kalibr(document: Mapping[str, Any]) -> CameraSet:
    """The cameras, and how they stand to one another where all tell.

    Raises:
        ValueError: something is missing or out of its range, or is a model that nothing here equals.
    """
    tables = _tables(document)
    if not tables:
        return _sensor(document)
    names, cameras, poses = [], [], [Rigid3.identity()]
    for k, (key, table) in enumerate(tables.items()):
        names.append(_name(key, table))
        try:
            cameras.append(_camera(table))
            if k and "T_cn_cnm1" in table:
                matrix = matrix_of(table["T_cn_cnm1"], "T_cn_cnm1", 4, 4)
                poses.append(pose_of_matrix(matrix, "T_cn_cnm1") @ poses[-1])
        except ValueError as error:
            raise ValueError(f"{key}: {error}") from error
    names = names if len(set(names)) == len(names) else list(tables)
    known = len(poses) == len(cameras) > 1
    return CameraSet(tuple(names), tuple(cameras), Rigid3.stack(poses) if known else None, "m" if known else "")


def kalibr_text(cameras: CameraSet) -> str:
    """A camchain, in which each camera stands to the one before it.

    Raises:
        FormatError: Kalibr lacks the model of one.
    """
    lines: list[str] = []
    for k, (name, camera) in enumerate(zip(cameras.names, cameras.cameras, strict=True)):
        lines.append(f"cam{k}:")
        if k and cameras.cams_from_rig is not None:
            step = cameras.cams_from_rig[k] @ cameras.cams_from_rig[k - 1].inverse()
            rows = np.vstack([step.matrix, [0, 0, 0, 1]])
            lines += ["  T_cn_cnm1:", *(f"  - {_listed(row)}" for row in rows)]
        model, intrinsics, distortion, coefficients = _said(as_one_of(camera, _MODELS, "Kalibr"))
        others = ", ".join(str(other) for other in range(len(cameras)) if other != k)
        topic = re.sub(r"[^A-Za-z0-9_]", "_", name)
        lines += [
            f"  cam_overlaps: [{others}]",
            f"  camera_model: {model}",
            f"  distortion_coeffs: {_listed(coefficients)}",
            f"  distortion_model: {distortion}",
            f"  intrinsics: {_listed(intrinsics)}",
            f"  resolution: [{camera.width}, {camera.height}]",
            f"  rostopic: /{topic}/image_raw",
        ]
    return "\n".join(lines) + "\n"


def _tables(document: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """The tables cam0, cam1, … in the order of their numbers."""
    found = {
        int(match.group(1)): (key, table)
        for key, table in document.items()
        if (match := _CAMERA.match(key)) and isinstance(table, Mapping) and "intrinsics" in table
    }
    return {key: table for _, (key, table) in sorted(found.items())}


def _sensor(document: Mapping[str, Any]) -> CameraSet:
    """EuRoC: `T_BS` is body_from_camera; the body is taken for the rig, in metres."""
    name = str(document.get("camera_id") or "camera")
    pose = None
    if "T_BS" in document:
        body_from_cam = pose_of_matrix(matrix_of(document["T_BS"], "T_BS", 4, 4), "T_BS")
        pose = Rigid3.stack([body_from_cam.inverse()])
    return CameraSet((name,), (_camera(document),), pose, "m" if pose is not None else "")


def _name(key: str, table: Mapping[str, Any]) -> str:
    topic = str(table.get("rostopic") or "").strip("/").split("/")[0]
    return topic or key


def _camera(table: Mapping[str, Any]) -> Camera:
    model = str(table.get("camera_model", table.get("proj_model", "pinhole")))
    distortion = str(table.get("distortion_model", table.get("dist_model")) or "none")
    coefficients = numbers(table.get("distortion_coeffs", table.get("distortion_coefficients")) or [], "distortion")
    width, height = (integer(side, "resolution") for side in numbers(table.get("resolution"), "resolution", 2))
    size, intrinsics = (width, height), table.get("intrinsics")
    if model == "pinhole":
        fu, fv, pu, pv = numbers(intrinsics, "intrinsics", 4)
        K = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]])
        if distortion in _EQUIDISTANT:
            return by_kannala_brandt(size, K, coefficients)
        if distortion in (*_RADTAN, *_NONE):
            return by_brown(size, K, coefficients if distortion in _RADTAN else [])
        raise ValueError(f"pinhole with the distortion {distortion!r}; known are none, radtan and equidistant")
    if distortion not in _NONE and any(coefficients):
        raise ValueError(f"{model} with the distortion {distortion!r} equals no camera model here")
    if model == "omni":
        xi, fu, fv, pu, pv = numbers(intrinsics, "intrinsics", 5)
        # (x, y) / (z + ξ d) is the unified camera with α = ξ / (1 + ξ), but for the factor 1 + ξ.
        params = [fu / (1 + xi), fv / (1 + xi), pu, pv, xi / (1 + xi), 1.0]
        return camera_of("EUCM", *size, params, pixel_center=0.0)
    if model in ("eucm", "ds"):
        first, second, *rest = numbers(intrinsics, "intrinsics", 6)
        name = "EUCM" if model == "eucm" else "DOUBLE_SPHERE"
        return camera_of(name, *size, [*rest, first, second], pixel_center=0.0)
    raise ValueError(f"has the camera model {model!r}; known are pinhole, omni, eucm and ds")


def _said(camera: Camera) -> tuple[str, list[float], str, list[float]]:
    """Model, intrinsics, distortion model and its coefficients in Kalibr's words."""
    (fx, fy), (cx, cy) = camera.focal_lengths, camera.principal_point
    pinhole, extra = [fx, fy, cx - 0.5, cy - 0.5], camera.params[4:].tolist()
    match camera.model:
        case "EUCM":
            return "eucm", [*extra, *pinhole], "none", []
        case "DOUBLE_SPHERE":
            return "ds", [*extra, *pinhole], "none", []
        case "OPENCV_FISHEYE":
            return "pinhole", pinhole, "equidistant", extra
        case "OPENCV":
            return "pinhole", pinhole, "radtan", extra
    return "pinhole", pinhole, "none", []


def _listed(values: Any) -> str:
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"
