"""Cameras as ROS's `camera_info` files and messages have them, centres of pixels at whole numbers.

plumb_bob             k1 k2 p1 p2 k3            rational_polynomial   k1 k2 p1 p2 k3 k4 k5 k6
equidistant           k1 k2 k3 k4 of OpenCV's fisheye, which some call fisheye
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from sfm.core.errors import FormatError
from sfm.io.camera_opencv import opencv_numbers
from sfm.io.camera_set import CameraSet, as_one_of, by_brown, by_kannala_brandt, integer, matrix_of

_BROWN = {"plumb_bob": 5, "rational_polynomial": 8}
_FISHEYE = ("equidistant", "fisheye")
_MODELS = ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE")


def is_ros(document: Mapping[str, Any]) -> bool:
    """Whether the document has what only ROS calls so."""
    return "distortion_model" in document and any(key in document for key in ("camera_matrix", "K", "k"))


def read_ros(document: Mapping[str, Any]) -> CameraSet:
    """The camera of a file, or of a message that was printed.

    Raises:
        ValueError: something is missing or out of its range.
    """
    size = tuple(
        integer(document.get(f"image_{side}", document.get(side)), f"image_{side}") for side in ("width", "height")
    )
    K = matrix_of(_one(document, "camera_matrix", "K", "k"), "camera_matrix", 3, 3)
    D = _one(document, "distortion_coefficients", "D", "d")
    values = matrix_of(D, "distortion_coefficients").ravel().tolist() if D else []
    kind = str(document["distortion_model"])
    if kind not in (*_BROWN, *_FISHEYE, "", "none", "None"):
        raise ValueError(f"has the distortion model {kind!r}; known are {', '.join((*_BROWN, *_FISHEYE))}")
    build = by_kannala_brandt if kind in _FISHEYE else by_brown
    return CameraSet((str(document.get("camera_name") or "camera"),), (build((size[0], size[1]), K, values),))


def ros_text(cameras: CameraSet) -> str:
    """The file of one camera, as `camera_calibration` writes it; not rectified: R is 1 and P is [K 0].

    Raises:
        FormatError: there are several cameras, or ROS lacks the model.
    """
    if len(cameras) != 1:
        raise FormatError(
            f"ROS has a file for each camera, and here are {len(cameras)}: {', '.join(cameras.names)}",
            remedy="choose one with --camera NAME",
        )
    camera = as_one_of(cameras.cameras[0], _MODELS, "ROS")
    K, D = opencv_numbers(camera)
    if camera.model_info.is_fisheye:
        kind = "equidistant"
    else:
        kind = "plumb_bob" if len(D) <= 5 else "rational_polynomial"
        D = np.pad(D, (0, _BROWN[kind] - len(D)))
    name = re.sub(r"[^A-Za-z0-9_]", "_", cameras.names[0])
    lines = [f"image_width: {camera.width}", f"image_height: {camera.height}", f"camera_name: {name}"]
    lines += _lines("camera_matrix", K)
    lines += [f"distortion_model: {kind}", *_lines("distortion_coefficients", D[None])]
    lines += [*_lines("rectification_matrix", np.eye(3)), *_lines("projection_matrix", np.pad(K, ((0, 0), (0, 1))))]
    return "\n".join(lines) + "\n"


def _one(document: Mapping[str, Any], *names: str) -> Any:
    return next((document[name] for name in names if document.get(name) is not None), None)


def _lines(name: str, matrix: np.ndarray) -> list[str]:
    data = ", ".join(repr(float(value)) for value in matrix.ravel())
    return [f"{name}:", f"  rows: {matrix.shape[0]}", f"  cols: {matrix.shape[1]}", f"  data: [{data}]"]
