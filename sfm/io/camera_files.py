"""Calibrations on disk: COLMAP's cameras.txt or .bin, files of other programs, and the files of Parallax.

Rig files are told in `rig_files`; a camera file is

[camera]
name = "left"                     # optional
model = "OPENCV"                  # a model of COLMAP, FULL_OPENCV_THIN_PRISM or DOUBLE_SPHERE
width = 4000
height = 3000
pixel_center = 0.5                # where the centre of the first pixel is: 0.5 (default), or 0.0 as in OpenCV
params = [3200.0, 3200.0, 2000.0, 1500.0, 0.01, 0.0, 0.0, 0.0]      # fx, fy, cx, cy, k1, k2, p1, p2

and further tables where it was calibrated: see `camera_records`.
"""

from __future__ import annotations

import json
from pathlib import Path

from sfm.core.cameras import Camera
from sfm.core.errors import FormatError
from sfm.io import colmap_binary, colmap_text
from sfm.io.atomic import write_text
from sfm.io.camera_bounds import out_of_bounds
from sfm.io.camera_foreign import FOREIGN_SUFFIXES, read_foreign_cameras
from sfm.io.camera_records import TABLES, CameraRecord, record_from_document, record_lines
from sfm.io.camera_tables import camera_from_table, check_keys, toml_document
from sfm.io.rig_files import is_rig_file, read_rig_file


def read_intrinsics(path: Path | str) -> dict[int, Camera]:
    """The cameras of a calibration file by id; one camera alone is meant for all images.

    Their focal lengths count as measured (`has_prior_focal_length`).

    Raises:
        InputError: the file cannot be opened.
        FormatError: it is not what its suffix promises, or holds no camera, or one that cannot be; a key of the camera
            file is unknown, missing or out of its range.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".toml" if is_rig_file(path):
            cameras = dict(enumerate(read_rig_file(path).rig.cameras, 1))
        case ".toml":
            cameras = {1: read_camera_file(path)[0]}
        case ".bin":
            cameras = colmap_binary.read_cameras(path)
        case ".txt":
            cameras = colmap_text.read_cameras(path)
        case _:
            cameras = dict(enumerate(read_foreign_cameras(path).cameras, 1))
    if not cameras:
        raise FormatError("holds no camera", path=path)
    for camera_id, camera in cameras.items():
        if why := out_of_bounds(camera.model_info, camera.width, camera.height, camera.params):
            raise FormatError(f"camera {camera_id}: {why}", path=path)
    return {
        camera_id: Camera(camera.model, camera.width, camera.height, camera.params, has_prior_focal_length=True)
        for camera_id, camera in cameras.items()
    }


def camera_names(path: Path | str) -> dict[int, str]:
    """What the file of a rig calls the cameras that `read_intrinsics` gives, by the same ids; nothing for other files.

    Raises:
        SfmError: as `read_intrinsics`.
    """
    path = Path(path)
    if path.suffix.lower() == ".toml" and is_rig_file(path):
        return dict(enumerate(read_rig_file(path).rig.names, 1))
    if path.suffix.lower() in FOREIGN_SUFFIXES:
        cameras = read_foreign_cameras(path)
        return dict(enumerate(cameras.names, 1)) if cameras.cams_from_rig is not None else {}
    return {}


def write_camera_toml(
    path: Path | str, camera: Camera, *, name: str = "", record: CameraRecord = CameraRecord()
) -> None:
    """Writes one camera and what is known about it; every number reads back as it is.

    Raises:
        InputError: the system refuses.
    """
    lines = [
        "[camera]",
        *([f"name = {json.dumps(name, ensure_ascii=False)}"] if name else []),
        f'model = "{camera.model}"',
        f"width = {camera.width}",
        f"height = {camera.height}",
        "pixel_center = 0.5",
        f"params = {camera.params.tolist()}  # {', '.join(camera.model_info.param_names)}",
        *record_lines(record),
    ]
    write_text(Path(path), "\n".join(lines) + "\n")


def read_camera_file(path: Path | str) -> tuple[Camera, CameraRecord]:
    """The camera of a camera file, and what is known about it.

    Raises:
        InputError: the file cannot be opened.
        FormatError: it is no TOML, or a table or key is unknown, missing or out of its range.
    """
    path = Path(path)
    document = toml_document(path)
    if "rig" in document:
        remedy = f"take one out: calib convert {path} -o camera.toml --camera NAME"
        raise FormatError("is the file of a rig, one camera is needed", path=path, remedy=remedy)
    check_keys(document, ("camera", *TABLES), path)
    table = document.get("camera")
    if not isinstance(table, dict):
        raise FormatError("has no table [camera]", path=path)
    camera = camera_from_table(table, path)
    return camera, record_from_document(document, camera.model_info, path)
