"""The intrinsics of nerfstudio's (and instant-ngp's) transforms.json; the centre of the first pixel at (½, ½).

Perspective cameras have k1, k2, k3 of one polynomial and p1, p2, fisheyes k1 … k4. Numbers stand at the top, or in each
frame; those at the top count where both are.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from sfm.core.cameras import Camera
from sfm.core.errors import FormatError
from sfm.io.camera_set import CameraSet, as_one_of, camera_of, integer

_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
_MODELS = ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")
_RATIONAL = ("k4", "k5", "k6")
"""OpenCV's denominator; nerfstudio's k4 is something else."""
_KEYS = (
    "camera_model", "is_fisheye", "fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2",
    "camera_angle_x", "camera_angle_y",
)  # fmt: skip


def is_nerfstudio(document: Mapping[str, Any]) -> bool:
    """Whether there is a focal length or a field of view as only these files call it, or frames that may have one."""
    return any(key in document for key in ("fl_x", "camera_angle_x")) or isinstance(document.get("frames"), list)


def read_nerfstudio(document: Mapping[str, Any]) -> CameraSet:
    """The camera, or the different ones of the frames, in their order.

    Raises:
        ValueError: something is missing or out of its range, or is a model that nothing here equals.
    """
    top = {key: document[key] for key in _KEYS if document.get(key) is not None}
    frames = document.get("frames") or []
    seen: dict[str, dict[str, Any]] = {}
    for frame in frames if isinstance(frames, list) else []:
        if isinstance(frame, Mapping):
            own = {key: frame[key] for key in _KEYS if frame.get(key) is not None} | top
            seen.setdefault(json.dumps(own, sort_keys=True, default=str), own)
    cameras = [_camera(values) for values in (seen.values() or [top])]
    names = [f"camera{k}" for k in range(1, len(cameras) + 1)] if len(cameras) > 1 else ["camera"]
    return CameraSet(tuple(names), tuple(cameras))


def nerfstudio_text(cameras: CameraSet) -> str:
    """A transforms.json without frames: its intrinsics are to be copied into one with frames.

    Raises:
        FormatError: there are several cameras, or nerfstudio lacks the model.
    """
    if len(cameras) != 1:
        raise FormatError(
            f"transforms.json has one camera at its top, and here are {len(cameras)}: {', '.join(cameras.names)}",
            remedy="choose one with --camera NAME",
        )
    camera = as_one_of(cameras.cameras[0], _MODELS, "nerfstudio")
    values = dict(zip(camera.model_info.param_names, camera.params.tolist(), strict=True))
    if camera.model == "FULL_OPENCV":
        if any(values[name] for name in _RATIONAL):
            as_one_of(camera, ("PINHOLE", "OPENCV", "OPENCV_FISHEYE"), "nerfstudio")
        values = {name: value for name, value in values.items() if name not in _RATIONAL}
    values["fl_x"], values["fl_y"] = values.pop("fx"), values.pop("fy")
    model = "OPENCV" if camera.model == "FULL_OPENCV" else camera.model
    document = {"camera_model": model, "w": camera.width, "h": camera.height, **values, "frames": []}
    return json.dumps(document, indent=2) + "\n"


def _camera(values: Mapping[str, Any]) -> Camera:
    def number(key: str, usual: float = 0.0) -> float:
        value = values.get(key, usual)
        if type(value) not in (int, float):
            raise ValueError(f"{key} must be a number, got {value!r}")
        return float(value)

    def by_angle(key: str, side: int) -> float:
        angle = number(key)
        if not 0 < angle < math.pi:
            raise ValueError(f"{key} must be an angle between 0 and pi, got {angle:g}")
        return side / 2 / math.tan(angle / 2)

    width, height = integer(values.get("w"), "w"), integer(values.get("h"), "h")
    if "fl_x" in values:
        fx = number("fl_x")
    elif "camera_angle_x" in values:
        fx = by_angle("camera_angle_x", width)
    else:
        raise ValueError("has neither fl_x nor camera_angle_x")
    usual = by_angle("camera_angle_y", height) if "camera_angle_y" in values else fx
    fy = number("fl_y", usual)
    head = [fx, fy, number("cx", width / 2), number("cy", height / 2)]
    model = str(values.get("camera_model") or ("OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV"))
    k1, k2, k3, k4, p1, p2 = (number(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model == "OPENCV_FISHEYE":
        return camera_of(model, width, height, [*head, k1, k2, k3, k4], pixel_center=0.5)
    if model not in _PERSPECTIVE:
        raise ValueError(f"has the camera model {model!r}; known are {', '.join((*_PERSPECTIVE, 'OPENCV_FISHEYE'))}")
    if k4:
        raise ValueError("has k4, the fourth term of a polynomial that no perspective model here has")
    if k3:
        return camera_of("FULL_OPENCV", width, height, [*head, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0], pixel_center=0.5)
    bent = any((k1, k2, p1, p2))
    params = [*head, k1, k2, p1, p2] if bent else head
    return camera_of("OPENCV" if bent else "PINHOLE", width, height, params, pixel_center=0.5)
