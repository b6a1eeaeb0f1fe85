"""What a camera file may hold beside its camera: where it comes from, how certain it is, the board, what is wrong.

[calibration]                     # each key is optional
command = "calib camera photos --board chessboard:9x6:25mm -o camera.toml"
date = "2026-11-23T10:15:00Z"
version = "0.1.0"
lens = "opencv4"
kind = "photos"                   # or corners that were found before
photos = 14                       # of which views were used
photos_digest = "…"               # of their contents
views = 14
corners = 756
rms_px = 0.1679                   # root of the mean squared length of residuals
sigma_px = 0.1262                 # of one coordinate
holdout_rms_px = 0.1735           # as rms_px, of views that were held out
holdout_flat_px = 0.1735          # the same with the board taken for flat
split_half_px = 0.9               # difference of the cameras of two halves of the views, over the image
uncertainty_px = 0.4              # standard deviation of a pixel far away, over the image, by views if they are enough
converged = true
would_bring = "a free board shape would bring …"   # what was not taken though it predicts photos better

[uncertainty]
free = ["fx", "fy", …]            # the parameters that were estimated
sigma = [0.4, …]                  # their standard deviations if all residuals are independent,
sigma_by_view = [0.9, …]          # optional: if only views are
covariance = [[0.16, …], …]       # of the first kind

[board]
spec = "chessboard:9x6:25mm"
shape = "free"
displacements = [[1e-5, 0.0, 2e-5], …]     # metres from where the corners were designed to be, by their ids

[[finding]]
cause = "few_tilts"
detail = "only 2 of 14 boards are tilted by more than 20°, and 3 should be"
remedy = "tilt the board by 30° to 45°"
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from sfm.core.arrays import Points3D, Value, Vector, readonly
from sfm.core.cameras import CameraModel
from sfm.core.errors import FormatError

Fact: TypeAlias = str | int | float | bool
_FACTS: dict[type, tuple[str, ...]] = {
    str: ("command", "date", "version", "lens", "kind", "photos_digest", "would_bring"),
    int: ("photos", "views", "corners"),
    float: ("rms_px", "sigma_px", "holdout_rms_px", "holdout_flat_px", "split_half_px", "uncertainty_px"),
    bool: ("converged",),
}
FACTS: Mapping[str, type] = MappingProxyType({key: kind for kind, keys in _FACTS.items() for key in keys})
"""Keys of [calibration]."""
TABLES = ("calibration", "uncertainty", "board", "finding")
_ASYMMETRY = 1e-9


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ParameterCovariance(Value):
    """How certain the parameters of a camera are.

    Attributes:
        free: names of those that were estimated, in the model's order.
        covariance: (K, K) of these, where all residuals are taken for independent.
        sigma_by_view: (K,) standard deviations where only views are; NaN where they are not known.
    """

    free: tuple[str, ...]
    covariance: Float64[np.ndarray, "K K"]
    sigma_by_view: Vector

    def __post_init__(self) -> None:
        count = len(self.free)
        object.__setattr__(self, "covariance", readonly(self.covariance, (count, count)))
        object.__setattr__(self, "sigma_by_view", readonly(self.sigma_by_view, (count,)))

    @property
    def sigma(self) -> Vector:
        """(K,) standard deviations where all residuals are taken for independent."""
        return np.sqrt(np.diag(self.covariance))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BoardRecord(Value):
    """The board that was photographed: in one word, and how its corners lie off their design, (P, 3) metres by id."""

    spec: str
    shape: str
    displacements: Points3D


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CameraRecord(Value):
    """What a file holds beside its camera; `findings` are (cause, detail, remedy)."""

    facts: Mapping[str, Fact] = dataclasses.field(default_factory=dict)
    uncertainty: ParameterCovariance | None = None
    board: BoardRecord | None = None
    findings: tuple[tuple[str, str, str], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "facts", MappingProxyType(dict(self.facts)))

    def number(self, fact: str) -> float:
        """A number of [calibration]; NaN where it is not there."""
        value = self.facts.get(fact, math.nan)
        return float(value) if isinstance(value, int | float) else math.nan


def record_from_document(document: Mapping[str, Any], model: CameraModel, path: Path) -> CameraRecord:
    """The tables of a file.

    Args:
        model: of the camera in the file.
        path: of the file, for errors.
    Raises:
        FormatError: a key is unknown, missing, or out of its range.
    """
    facts = _table(document, "calibration", path)
    for key, value in facts.items():
        kind = FACTS.get(key)
        if kind is None:
            raise FormatError(f"[calibration] unknown key {key!r}; known are {', '.join(FACTS)}", path=path)
        if type(value) is not kind and not (kind is float and type(value) is int):
            raise FormatError(f"[calibration] {key} must be {kind.__name__}, got {value!r}", path=path)
    findings = document.get("finding", [])
    if not isinstance(findings, list):
        raise FormatError("findings are tables [[finding]]", path=path)
    return CameraRecord(
        facts,
        _uncertainty(_table(document, "uncertainty", path), model, path),
        _board(_table(document, "board", path), path),
        tuple(_finding(finding, path) for finding in findings),
    )


def record_lines(record: CameraRecord) -> Iterator[str]:
    """The tables as TOML; every number reads back as it is."""
    if record.facts:
        yield from ("", "[calibration]")
        yield from (f"{key} = {_written(record.facts[key])}" for key in FACTS if key in record.facts)
    if record.uncertainty is not None:
        yield from ("", "[uncertainty]", f"free = {_written(list(record.uncertainty.free))}")
        yield f"sigma = {_written(record.uncertainty.sigma.tolist())}  # if all residuals are independent"
        if np.isfinite(record.uncertainty.sigma_by_view).all():
            yield f"sigma_by_view = {_written(record.uncertainty.sigma_by_view.tolist())}  # if only views are"
        yield from ("covariance = [", *(f"  {_written(row)}," for row in record.uncertainty.covariance.tolist()), "]")
    if record.board is not None:
        yield from ("", "[board]", f"spec = {_written(record.board.spec)}", f"shape = {_written(record.board.shape)}")
        if record.board.displacements.any():
            rows = (f"  {_written(row)}," for row in record.board.displacements.tolist())
            yield from ("displacements = [", *rows, "]")
    for words in record.findings:
        pairs = zip(("cause", "detail", "remedy"), words, strict=True)
        yield from ("", "[[finding]]", *(f"{key} = {_written(word)}" for key, word in pairs))


def _written(value: Fact | list[Any]) -> str:
    """TOML of a value; JSON's words for text, truth and lists are TOML's, those for numbers are Python's."""
    if isinstance(value, list):
        return f"[{', '.join(map(_written, value))}]"
    if isinstance(value, float):
        return repr(value) if math.isfinite(value) else str(value)
    return json.dumps(value, ensure_ascii=False)


def _table(document: Mapping[str, Any], name: str, path: Path) -> dict[str, Any]:
    table = document.get(name, {})
    if not isinstance(table, dict):
        raise FormatError(f"[{name}] must be a table", path=path)
    return table


def _uncertainty(table: dict[str, Any], model: CameraModel, path: Path) -> ParameterCovariance | None:
    if not table:
        return None
    _known(table, ("free", "sigma", "sigma_by_view", "covariance"), "[uncertainty]", path)
    free = table.get("free")
    if not isinstance(free, list) or free != [name for name in model.param_names if name in free]:
        names = ", ".join(model.param_names)
        raise FormatError(f"[uncertainty] free must name parameters of {model.name} in order: {names}", path=path)
    covariance = _numbers(table.get("covariance"), (len(free), len(free)), "[uncertainty] covariance", path)
    if np.any(np.diag(covariance) < 0) or np.abs(covariance - covariance.T).max(initial=0.0) > _ASYMMETRY * np.abs(
        covariance
    ).max(initial=0.0):
        raise FormatError("[uncertainty] covariance must be symmetric, with no negative variance", path=path)
    for key in ("sigma", "sigma_by_view"):
        if key in table:
            _numbers(table[key], (len(free),), f"[uncertainty] {key}", path)
    by_view = np.array(table.get("sigma_by_view", [math.nan] * len(free)), np.float64)
    return ParameterCovariance(tuple(free), covariance, by_view)


def _board(table: dict[str, Any], path: Path) -> BoardRecord | None:
    if not table:
        return None
    _known(table, ("spec", "shape", "displacements"), "[board]", path)
    for key in ("spec", "shape"):
        if not isinstance(table.get(key), str):
            raise FormatError(f"[board] needs {key} (text), got {table.get(key)!r}", path=path)
    moved = table.get("displacements", [])
    count = len(moved) if isinstance(moved, list) else 0
    return BoardRecord(table["spec"], table["shape"], _numbers(moved, (count, 3), "[board] displacements", path))


def _finding(table: Any, path: Path) -> tuple[str, str, str]:
    keys = ("cause", "detail", "remedy")
    if not isinstance(table, dict) or not all(isinstance(table.get(key), str) for key in keys):
        raise FormatError("[[finding]] needs cause, detail and remedy (text)", path=path)
    _known(table, keys, "[[finding]]", path)
    return table["cause"], table["detail"], table["remedy"]


def _numbers(values: Any, shape: tuple[int, ...], what: str, path: Path) -> np.ndarray:
    try:
        array = np.array(values, np.float64).reshape(shape)
        if np.shape(values) not in (shape, (0,)) or not np.isfinite(array).all():
            raise ValueError
    except (ValueError, TypeError) as error:
        raise FormatError(f"{what} must be {' × '.join(map(str, shape))} finite numbers", path=path) from error
    return array


def _known(table: Mapping[str, Any], keys: tuple[str, ...], where: str, path: Path) -> None:
    unknown = sorted(set(table) - set(keys))
    if unknown:
        raise FormatError(f"{where} unknown key {unknown[0]!r}; known are {', '.join(keys)}", path=path)
