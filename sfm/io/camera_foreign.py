"""Calibration files of other programs, told apart by what they hold: YAML, XML or JSON.

OpenCV, ROS camera_info, Kalibr camchain, EuRoC sensor.yaml, BoofCV, nerfstudio and instant-ngp transforms.json.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sfm.core.errors import FormatError
from sfm.io.atomic import os_errors
from sfm.io.camera_boofcv import is_boofcv, read_boofcv
from sfm.io.camera_kalibr import is_kalibr, read_kalibr
from sfm.io.camera_nerfstudio import is_nerfstudio, read_nerfstudio
from sfm.io.camera_opencv import is_opencv, parse_opencv_xml, read_opencv
from sfm.io.camera_ros import is_ros, read_ros
from sfm.io.camera_set import CameraSet
from sfm.io.yaml_text import parse_yaml

FOREIGN_SUFFIXES = (".yaml", ".yml", ".xml", ".json")
_READERS = (
    ("ros", is_ros, read_ros),
    ("kalibr", is_kalibr, read_kalibr),
    ("boofcv", is_boofcv, read_boofcv),
    ("nerfstudio", is_nerfstudio, read_nerfstudio),
)
_STATED = ("avg_reprojection_error", "reprojection_error", "rms", "RMS")
_KNOWN = (
    "known are OpenCV (YAML, XML), ROS camera_info, Kalibr camchain, EuRoC, BoofCV, nerfstudio transforms.json, "
    "COLMAP cameras.txt or .bin, and the .toml files of Parallax"
)


def read_foreign_cameras(path: Path | str, size: tuple[int, int] | None = None) -> CameraSet:
    """The cameras of a file.

    Args:
        size: of the images where the file does not say.
    Raises:
        InputError: the file cannot be opened.
        FormatError: it is not what its suffix promises, of no known program, or has no equal among our models.
    """
    path = Path(path)
    if path.suffix.lower() not in FOREIGN_SUFFIXES:
        raise FormatError("is no calibration file", path=path, remedy=_KNOWN)
    try:
        document = _document(path)
        return _cameras(document, size)
    except FormatError as error:
        raise FormatError(error.cause, path=path, remedy=error.remedy) from error
    except (ValueError, UnicodeDecodeError) as error:
        raise FormatError(str(error), path=path) from error


def foreign_format(path: Path | str) -> str:
    """Which program a file comes from: opencv, ros, kalibr, boofcv or nerfstudio; "" where it is none of them."""
    try:
        document = _document(Path(path))
    except ValueError:
        return ""
    return _format(document) if isinstance(document, Mapping) else ""


def stated_error_px(path: Path | str) -> float:
    """Rms error of calibration that a file of OpenCV states, px; NaN where it does not."""
    try:
        document = _document(Path(path))
    except ValueError:
        return math.nan
    known = document if isinstance(document, Mapping) else {}
    for name in _STATED:
        if isinstance(known.get(name), (int, float)):
            return float(known[name])
    return math.nan


def _document(path: Path) -> Any:
    with os_errors(path):
        text = path.read_bytes().decode("utf-8-sig")
    if text.lstrip().startswith("<"):
        return parse_opencv_xml(text)
    if path.suffix.lower() == ".json" or text.lstrip().startswith("{"):
        try:
            return json.loads(text)
        except (json.JSONDecodeError, RecursionError) as error:
            raise ValueError(f"is no JSON: {error}") from error
    return parse_yaml(text)


def _format(document: Mapping[str, Any]) -> str:
    for name, is_theirs, _ in _READERS:
        if is_theirs(document):
            return name
    return "opencv" if is_opencv(document) else ""


def _cameras(document: Any, size: tuple[int, int] | None) -> CameraSet:
    name = _format(document) if isinstance(document, Mapping) else ""
    if not name:
        raise FormatError("holds no calibration that is known here", remedy=_KNOWN)
    for reader, _, read in _READERS:
        if reader == name:
            return read(document)
    return read_opencv(document, size)
