"""Calibrated rigs for COLMAP ≥ 3.12: poses beside a cameras.txt or .bin, and what its `rig_configurator` is given.

    cameras.txt        the cameras, numbered from 1
    rigs.txt           one rig of them all: sensor_from_rig, the first camera being the reference
    rig_config.json    for `colmap rig_configurator --rig_config_path`, before a reconstruction: the same poses, and
                       that images of a camera lie in a folder of its name

A file of cameras alone has no place for poses; COLMAP reads the others by their names only.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np

from sfm.core.cameras import Camera
from sfm.core.errors import FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import Rig
from sfm.io import colmap_binary, colmap_text
from sfm.io.atomic import write_chunks, write_text
from sfm.io.camera_set import CameraSet

_CAMERAS, _RIGS, _CONFIG = "cameras", "rigs", "rig_config.json"
_NOT_AS_WRITTEN = 1e-9
"""Largest difference of an entry of a pose after it is read again, over the rig's size."""


def has_place_for_poses(path: Path) -> bool:
    """Whether COLMAP would look for rigs beside this file of cameras."""
    return path.stem == _CAMERAS


def write_rig_beside(path: Path, cameras: CameraSet) -> tuple[Path, Path]:
    """Writes rigs.txt or .bin and rig_config.json beside a file of these cameras, and returns their paths.

    Raises:
        InputError: the system refuses.
        FormatError: poses are not read again as they were written.
    """
    assert cameras.cams_from_rig is not None
    first = cameras.cams_from_rig[0].inverse()
    poses = {k: cameras.cams_from_rig[k - 1] @ first for k in range(2, len(cameras) + 1)}
    rigs, config = path.with_name(f"{_RIGS}{path.suffix.lower()}"), path.with_name(_CONFIG)
    write_chunks(rigs, _module(path).rigs_chunks([Rig(1, 1, poses)]))
    again = read_rig_beside(path, dict(enumerate(cameras.cameras, 1)))
    size = max(1.0, *(float(np.abs(pose.translation).max()) for pose in poses.values()))
    for k, pose in poses.items():
        if again is None or not np.abs(again[k - 1].matrix - pose.matrix).max() <= _NOT_AS_WRITTEN * size:
            raise FormatError(f"the pose of {cameras.names[k - 1]} is not read again as it was written", path=rigs)
    write_text(config, _configuration(cameras, poses))
    return rigs, config


def read_rig_beside(path: Path, cameras: Mapping[int, Camera]) -> Rigid3 | None:
    """cams_from_rig of these cameras, in their order, from the rigs beside their file.

    None where there is no such file, or no rig with poses of them all.

    Raises:
        FormatError: the file of rigs is broken.
    """
    rigs = path.with_name(f"{_RIGS}{path.suffix.lower()}")
    if not has_place_for_poses(path) or not rigs.is_file():
        return None
    for rig in _module(path).read_rigs(rigs):
        poses = {rig.ref_camera_id: Rigid3.identity(), **rig.sensors_from_rig}
        known = [poses.get(camera_id) for camera_id in cameras]
        found = [pose for pose in known if pose is not None]
        if len(found) == len(cameras) > 1:
            return Rigid3.stack(found)
    return None


def _configuration(cameras: CameraSet, poses: Mapping[int, Rigid3]) -> str:
    """The text of rig_config.json."""
    entries = []
    for k, (name, camera) in enumerate(zip(cameras.names, cameras.cameras, strict=True), 1):
        entry: dict[str, object] = {
            "image_prefix": f"{name}/",
            "camera_model_name": camera.model,
            "camera_params": camera.params.tolist(),
        }
        if k in poses:
            entry["cam_from_rig_rotation"] = poses[k].rotation.wxyz.tolist()
            entry["cam_from_rig_translation"] = poses[k].translation.tolist()
        else:
            entry["ref_sensor"] = True
        entries.append(entry)
    return json.dumps([{"cameras": entries}], indent=2, ensure_ascii=False) + "\n"


def _module(path: Path) -> ModuleType:
    return colmap_binary if path.suffix.lower() == ".bin" else colmap_text
