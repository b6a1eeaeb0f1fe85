"""Calibrated rigs on disk: several cameras and how they stand to one another.

[rig]
reference = "left"                # the camera whose frame is the rig's
unit = "m"                        # of translations
rms_px = 0.18                     # optional
[rig.provenance]                  # optional: texts and numbers that say where the file comes from
command = "calib stereo left right --board chessboard:9x6:25mm -o rig.toml"

[[camera]]                        # keys as in a camera file, see `camera_files`; each camera needs a name
name = "left"
model = "OPENCV"
width = 640
height = 480
pixel_center = 0.5
params = [534.0, 534.0, 342.0, 235.0, -0.27, -0.04, 0.001, 0.0]
rotation = [1.0, 0.0, 0.0, 0.0]   # cam_from_rig: unit quaternion w, x, y, z,
translation = [0.0, 0.0, 0.0]     # and  x_in_cam = R x_in_rig + t
sigma_params = [0.3, …]           # optional standard deviations, 0 of what was not estimated:
sigma_rotation = [1e-4, …]        # of turns about the camera's axes, radians
sigma_translation = [2e-5, …]     # of the translation
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from sfm.core.arrays import Value, Vector, readonly
from sfm.core.cameras import Camera
from sfm.core.errors import FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import CameraRig
from sfm.io.atomic import write_text
from sfm.io.camera_tables import camera_from_table, toml_document

Fact: TypeAlias = str | int | float | bool
_FURTHER = ("rotation", "translation", "sigma_params", "sigma_rotation", "sigma_translation")
_NOT_UNIT = 1e-3
"""Quaternions are written with few digits by hand; farther from unit length they are something else."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MountedSigmas(Value):
    """Standard deviations of one camera of a rig; 0 for what was not estimated.

    Attributes:
        params: (K,) of the camera's parameters.
        rotation: of turns of `cam_from_rig` about the camera's axes, radians.
        translation: of its translation, in the rig's unit.
    """

    params: Vector
    rotation: Float64[np.ndarray, " 3"]
    translation: Float64[np.ndarray, " 3"]

    def __post_init__(self) -> None:
        for name, shape in (("params", (None,)), ("rotation", (3,)), ("translation", (3,))):
            object.__setattr__(self, name, readonly(getattr(self, name), shape))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigFile(Value):
    """What a rig file holds.

    Attributes:
        rms_px: of the calibration, NaN where it is not known.
        sigmas: for each camera, or none at all.
        provenance: texts and numbers by name.
    """

    rig: CameraRig
    rms_px: float = math.nan
    sigmas: tuple[MountedSigmas, ...] = ()
    provenance: Mapping[str, Fact] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.sigmas and len(self.sigmas) != len(self.rig):
            raise ValueError(f"{len(self.sigmas)} standard deviations for {len(self.rig)} cameras")
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))


def is_rig_file(path: Path | str) -> bool:
    """Whether a calibration file is that of a rig.

    Raises:
        InputError: the file cannot be opened.
        FormatError: it is no TOML.
    """
    return "rig" in toml_document(Path(path))


def read_rig_file(path: Path | str) -> RigFile:
    """The rig of a `.toml`; focal lengths count as measured.

    Raises:
        InputError: the file cannot be opened.
        FormatError: it is no TOML, or a table or key is unknown, missing or out of its range.
    """
    path = Path(path)
    document = toml_document(path)
    _known(document, ("rig", "camera"), "", path)
    head, tables = document.get("rig"), document.get("camera")
    if not isinstance(head, dict) or not isinstance(tables, list) or not tables:
        raise FormatError("has no table [rig] or no [[camera]]", path=path)
    _known(head, ("reference", "unit", "rms_px", "provenance"), "[rig] ", path)
    cameras = tuple(_camera(table, path) for table in tables)
    try:
        rig = CameraRig(
            names=tuple(table["name"] for table in tables),
            cameras=cameras,
            cams_from_rig=Rigid3.stack([_pose(table, path) for table in tables]),
            reference=_text(head, "reference", path),
            unit=_text(head, "unit", path),
        )
    except ValueError as error:
        raise FormatError(str(error), path=path) from error
    sigmas = tuple(_sigmas(table, camera, path) for table, camera in zip(tables, cameras, strict=True))
    rms = head.get("rms_px", math.nan)
    if type(rms) not in (int, float):
        raise FormatError(f"[rig] rms_px must be a number, got {rms!r}", path=path)
    known = tuple(one for one in sigmas if one is not None)
    return RigFile(rig, float(rms), known if len(known) == len(sigmas) else (), _provenance(head, path))


def write_rig_file(path: Path | str, file: RigFile) -> None:
    """Writes a rig; every number reads back as it is.

    Raises:
        InputError: the system refuses.
    """
    rig = file.rig
    lines = ["[rig]", f"reference = {_quoted(rig.reference)}", f"unit = {_quoted(rig.unit)}"]
    lines += [f"rms_px = {file.rms_px!r}"] if math.isfinite(file.rms_px) else []
    if file.provenance:
        lines += ["", "[rig.provenance]"]
        lines += [f"{_key(name)} = {_written(fact)}" for name, fact in file.provenance.items()]
    for k, (name, camera) in enumerate(zip(rig.names, rig.cameras, strict=True)):
        pose = rig.cams_from_rig[k]
        lines += [
            "",
            "[[camera]]",
            f"name = {_quoted(name)}",
            f'model = "{camera.model}"',
            f"width = {camera.width}",
            f"height = {camera.height}",
            "pixel_center = 0.5",
            f"params = {camera.params.tolist()}  # {', '.join(camera.model_info.param_names)}",
            f"rotation = {pose.rotation.wxyz.tolist()}  # cam_from_rig: w, x, y, z",
            f"translation = {pose.translation.tolist()}  # {rig.unit}",
        ]
        if file.sigmas:
            sigma = file.sigmas[k]
            lines += [
                f"sigma_params = {sigma.params.tolist()}",
                f"sigma_rotation = {sigma.rotation.tolist()}  # radians, about the camera's axes",
                f"sigma_translation = {sigma.translation.tolist()}",
            ]
    write_text(Path(path), "\n".join(lines) + "\n")


def _camera(table: Any, path: Path) -> Camera:
    if not isinstance(table, dict) or not table.get("name"):
        raise FormatError("[[camera]] lacks a name", path=path)
    camera = camera_from_table(table, path, further=_FURTHER)
    return dataclasses.replace(camera, has_prior_focal_length=True)


def _pose(table: Mapping[str, Any], path: Path) -> Rigid3:
    wxyz = _numbers(table, "rotation", 4, path)
    if not abs(np.linalg.norm(wxyz) - 1) < _NOT_UNIT:
        raise FormatError(f"rotation must be a unit quaternion w, x, y, z, got {wxyz.tolist()}", path=path)
    return Rigid3(Rotation3(wxyz), _numbers(table, "translation", 3, path))


def _sigmas(table: Mapping[str, Any], camera: Camera, path: Path) -> MountedSigmas | None:
    counts = {"sigma_params": len(camera.params), "sigma_rotation": 3, "sigma_translation": 3}
    if not any(key in table for key in counts):
        return None
    values = [_numbers(table, key, count, path) for key, count in counts.items()]
    if min(part.min() for part in values) < 0:
        raise FormatError("standard deviations must not be negative", path=path)
    return MountedSigmas(*values)


def _provenance(head: Mapping[str, Any], path: Path) -> dict[str, Fact]:
    facts = head.get("provenance", {})
    if not isinstance(facts, dict) or any(not isinstance(fact, str | int | float) for fact in facts.values()):
        raise FormatError("[rig.provenance] must hold texts and numbers", path=path)
    return facts


def _numbers(table: Mapping[str, Any], key: str, count: int, path: Path) -> np.ndarray:
    values: Any = table.get(key)
    is_list = isinstance(values, list) and all(type(value) in (int, float) for value in values)
    if not is_list or len(values) != count or not np.isfinite(values).all():
        raise FormatError(f"[[camera]] {table['name']}: {key} must be {count} finite numbers, got {values}", path=path)
    return np.array(values, np.float64)


def _text(head: Mapping[str, Any], key: str, path: Path) -> str:
    if not isinstance(head.get(key), str) or not head[key]:
        raise FormatError(f"[rig] needs {key} (text), got {head.get(key)!r}", path=path)
    return head[key]


def _known(table: Mapping[str, Any], keys: tuple[str, ...], where: str, path: Path) -> None:
    unknown = sorted(set(table) - set(keys))
    if unknown:
        raise FormatError(f"{where}unknown key {unknown[0]!r}; known are {', '.join(keys)}", path=path)


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _quoted(name)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _written(fact: Fact) -> str:
    if isinstance(fact, bool):
        return str(fact).lower()
    return _quoted(fact) if isinstance(fact, str) else repr(fact)
