"""Cameras in OpenCV's files (`cv2.FileStorage`: YAML, XML or JSON), centres of pixels at whole numbers.

One camera has `image_width`, `image_height`, `camera_matrix` and `distortion_coefficients`, as OpenCV's own sample
writes them, and `fisheye_model: 1` where the coefficients are those of `cv2.fisheye`. A stereo pair has M1, D1, M2, D2
and, as `cv2.stereoCalibrate` names them, R and T with  x_in_2 = R x_in_1 + T. Other names that are in use are read.
"""

from __future__ import annotations

import contextlib
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sfm.core.cameras import Camera
from sfm.core.errors import FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.io.camera_set import CameraSet, as_one_of, by_brown, by_kannala_brandt, integer, matrix_of, pose_of_matrix

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "intrinsic_matrix", "mtx", "K", "M")
_COEFFICIENTS = (
    "distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "distortion_coeffs", "dist", "D",
)  # fmt: skip
_WIDTH = ("image_width", "imageWidth", "img_width", "image_Width", "width")
_HEIGHT = ("image_height", "imageHeight", "img_height", "image_Height", "height")
_SIZE = ("image_size", "imageSize", "img_size", "resolution", "size")
_FISHEYE = ("fisheye_model", "is_fisheye", "fisheye")
_MODELS = ("PINHOLE", "OPENCV", "FULL_OPENCV", "FULL_OPENCV_THIN_PRISM", "OPENCV_FISHEYE")
_A_LINE = 4


def is_opencv(document: Mapping[str, Any]) -> bool:
    """Whether the document has a camera matrix by one of its names, or two."""
    return _first(document, _MATRIX) is not None or _first(document, _numbered(_MATRIX, 1)) is not None


def read_opencv(document: Mapping[str, Any], size: tuple[int, int] | None = None) -> CameraSet:
    """The camera, or the two of a stereo pair.

    Args:
        size: width and height where the file does not say, as files of `cv2.stereoCalibrate` do not.
    Raises:
        ValueError: something is missing or out of its range.
    """
    if _first(document, _MATRIX) is not None:
        return CameraSet(("camera",), (_camera(document, _MATRIX, _COEFFICIENTS, size),))
    cameras = tuple(
        _camera(document, _numbered(_MATRIX, k), _numbered(_COEFFICIENTS, k), size, document) for k in (1, 2)
    )
    names, R, T = ("left", "right"), document.get("R"), document.get("T")
    if R is None or T is None:
        return CameraSet(names, cameras)
    second = np.column_stack([matrix_of(R, "R", 3, 3), matrix_of(T, "T").ravel()[:3]])
    return CameraSet(names, cameras, Rigid3.stack([Rigid3.identity(), pose_of_matrix(second, "R")]))


def opencv_text(cameras: CameraSet) -> str:
    """The file as YAML.

    Raises:
        FormatError: there are more than two cameras, cameras of different kinds, or OpenCV lacks the model of one.
    """
    if len(cameras) > 2:
        raise FormatError(f"OpenCV's file of a stereo pair has no place for {len(cameras)} cameras")
    said = [as_one_of(camera, _MODELS, "OpenCV") for camera in cameras.cameras]
    fisheye = {camera.model_info.is_fisheye for camera in said}
    if len(fisheye) > 1:
        raise FormatError("one camera is a fisheye and one is not, which OpenCV's file of a stereo pair cannot say")
    if len({(camera.width, camera.height) for camera in said}) > 1:
        raise FormatError("the images have different sizes, which OpenCV's file of a stereo pair cannot say")
    lines = ["%YAML:1.0", "---", f"image_width: {said[0].width}", f"image_height: {said[0].height}"]
    lines += ["fisheye_model: 1"] if fisheye.pop() else []
    for k, camera in enumerate(said, 1):
        names = (f"M{k}", f"D{k}") if len(said) > 1 else ("camera_matrix", "distortion_coefficients")
        matrix, coefficients = opencv_numbers(camera)
        lines += [*_matrix_lines(names[0], matrix), *_matrix_lines(names[1], coefficients[None])]
    if len(said) > 1 and cameras.cams_from_rig is not None:
        second = cameras.cams_from_rig[1] @ cameras.cams_from_rig[0].inverse()
        lines += [*_matrix_lines("R", second.rotation.matrix), *_matrix_lines("T", second.translation[:, None])]
    return "\n".join(lines) + "\n"


def opencv_numbers(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """K with centres at whole numbers, and the coefficients in OpenCV's order, at least four: k1 k2 p1 p2 …"""
    matrix = camera.calibration_matrix
    matrix[:2, 2] -= 0.5
    coefficients = camera.params[4:]
    if camera.model == "FULL_OPENCV" and not coefficients[5:].any():
        coefficients = coefficients[:5]
    return matrix, coefficients if len(coefficients) else np.zeros(5)


def parse_opencv_xml(text: str) -> dict[str, Any]:
    """An XML file of `cv2.FileStorage` as `parse_yaml` has its YAML.

    Raises:
        ValueError: it is no XML.
    """
    try:
        root = ET.fromstring(text.strip())
    except ET.ParseError as error:
        raise ValueError(f"is no XML: {error}") from error
    value = _from_element(root)
    return value if isinstance(value, dict) else {}


def _from_element(element: ET.Element) -> Any:
    children = list(element)
    if element.get("type_id") == "opencv-matrix":
        fields = {child.tag: (child.text or "").split() for child in children}
        shape = {key: int(fields[key][0]) for key in ("rows", "cols") if fields.get(key)}
        return {**shape, "data": [float(word) for word in fields.get("data", [])]}
    if children:
        if all(child.tag == "_" for child in children):
            return [_from_element(child) for child in children]
        return {child.tag: _from_element(child) for child in children}
    values = [_from_word(word) for word in re.findall(r'"[^"]*"|\S+', element.text or "")]
    return values[0] if len(values) == 1 else values


def _from_word(word: str) -> Any:
    if word.startswith('"'):
        return word.strip('"')
    try:
        return int(word)
    except ValueError:
        with contextlib.suppress(ValueError):
            return float(word)
    return word


def _camera(
    document: Mapping[str, Any], matrix: Sequence[str], coefficients: Sequence[str], size: tuple[int, int] | None,
    whole: Mapping[str, Any] | None = None,
) -> Camera:  # fmt: skip
    K = _first(document, matrix)
    if K is None:
        raise ValueError(f"has no {matrix[0]}")
    D = _first(document, coefficients)
    values = [] if D is None else matrix_of(D, coefficients[0]).ravel().tolist()
    whole = document if whole is None else whole
    build = by_kannala_brandt if _first(whole, _FISHEYE) else by_brown
    return build(_size(whole, size), matrix_of(K, matrix[0], 3, 3), values)


def _size(document: Mapping[str, Any], given: tuple[int, int] | None) -> tuple[int, int]:
    both = _first(document, _SIZE)
    if isinstance(both, list) and len(both) == 2:
        return integer(both[0], "the width"), integer(both[1], "the height")
    width, height = _first(document, _WIDTH), _first(document, _HEIGHT)
    if width is None or height is None:
        if given is None:
            raise ValueError("has no image_width and image_height; give them with --size WIDTHxHEIGHT")
        return given
    return integer(width, "image_width"), integer(height, "image_height")


def _numbered(names: Sequence[str], k: int) -> tuple[str, ...]:
    side = ("left", "right")[k - 1]
    return tuple(form for name in names for form in (f"{name}{k}", f"{name}_{k}", f"{name}_{side}", f"{name}{side}"))


def _first(document: Mapping[str, Any], names: Sequence[str]) -> Any:
    return next((document[name] for name in names if document.get(name) is not None), None)


def _matrix_lines(name: str, matrix: np.ndarray) -> list[str]:
    words = [repr(float(value)) for value in matrix.ravel()]
    rows = [", ".join(words[k : k + _A_LINE]) for k in range(0, len(words), _A_LINE)]
    data = ",\n       ".join(rows)
    shape = [f"   rows: {matrix.shape[0]}", f"   cols: {matrix.shape[1]}", "   dt: d"]
    return [f"{name}: !!opencv-matrix", *shape, f"   data: [ {data} ]"]
