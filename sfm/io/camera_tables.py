"""Cameras as tables of TOML files."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from sfm.core.cameras import MODELS, Camera, model_by_name
from sfm.core.errors import FormatError
from sfm.io.atomic import os_errors
from sfm.io.camera_bounds import out_of_bounds

_REQUIRED = ("model", "width", "height", "params")
_KEYS = ("name", *_REQUIRED, "pixel_center")
_HUGE = 1e300
"""Whole numbers of TOML may be larger than any float."""


def toml_document(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        InputError: the file cannot be opened.
        FormatError: it is no TOML.
    """
    with os_errors(path):
        content = path.read_bytes()
    try:
        return tomllib.loads(content.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FormatError(f"is no TOML: {error}", path=path) from error


def check_keys(table: dict[str, Any], known: tuple[str, ...], path: Path) -> None:
    """Raises FormatError for a key that is not known, with the nearest one that is."""
    for key in table:
        if key not in known:
            raise FormatError(f"unknown key {key!r}{_nearest(key, known)}", path=path)


def camera_from_table(table: dict[str, Any], path: Path, *, further: tuple[str, ...] = ()) -> Camera:
    """The camera of a table [camera] of a TOML file.

    Args:
        path: of the file, for errors.
        further: keys that are allowed beside those of a camera.
    Raises:
        FormatError: a key is unknown, missing or out of its range.
    """
    check_keys(table, (*_KEYS, *further), path)
    missing = [key for key in _REQUIRED if key not in table]
    if missing:
        raise FormatError(f"[camera] lacks {', '.join(missing)}", path=path)
    return _camera(table, path)


def _camera(table: dict[str, Any], path: Path) -> Camera:
    if table["model"] not in (model.name for model in MODELS):
        raise FormatError(
            f"unknown model {table['model']!r}{_nearest(table['model'], [m.name for m in MODELS])}", path=path
        )
    if not isinstance(table.get("name", ""), str):
        raise FormatError(f"name must be text, got {table['name']!r}", path=path)
    for key in ("width", "height"):
        if type(table[key]) is not int or table[key] <= 0:
            raise FormatError(f"{key} must be a positive integer, got {table[key]!r}", path=path)
    if table.get("pixel_center", 0.5) not in (0, 0.5):
        raise FormatError(f"pixel_center must be 0.5 or 0.0, got {table['pixel_center']!r}", path=path)
    model = model_by_name(table["model"])
    params = _params(table["params"], model.param_names, path)
    params[list(model.principal_point_indices)] += 0.5 - table.get("pixel_center", 0.5)
    if why := out_of_bounds(model, table["width"], table["height"], params):
        raise FormatError(f"[camera] {why}", path=path)
    return Camera(model.name, table["width"], table["height"], params)


def _params(values: Any, names: tuple[str, ...], path: Path) -> np.ndarray:
    is_list = isinstance(values, list) and all(type(value) in (int, float) for value in values)
    if not is_list or len(values) != len(names) or not all(abs(value) < _HUGE for value in values):
        raise FormatError(f"params must be {len(names)} finite numbers: {', '.join(names)}", path=path)
    return np.array(values, np.float64)


def _nearest(word: Any, known: Any) -> str:
    close = difflib.get_close_matches(str(word), list(known), n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else f"; known are {', '.join(known)}"
