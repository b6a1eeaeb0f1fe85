"""Calibrations from one format to another, each export read again and compared.

A format is known by name: parallax (`.toml`), colmap (`.txt`, `.bin`), opencv, ros, kalibr, nerfstudio.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sfm.core.cameras.conversion import Difference, difference
from sfm.core.errors import ConfigError, FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import CameraRig
from sfm.io import colmap_binary, colmap_text
from sfm.io.atomic import atomic_path, write_chunks, write_text
from sfm.io.camera_files import read_camera_file, read_intrinsics, write_camera_toml
from sfm.io.camera_foreign import FOREIGN_SUFFIXES, foreign_format, read_foreign_cameras
from sfm.io.camera_kalibr import kalibr_text
from sfm.io.camera_nerfstudio import nerfstudio_text
from sfm.io.camera_opencv import opencv_text
from sfm.io.camera_records import CameraRecord
from sfm.io.camera_ros import ros_text
from sfm.io.camera_set import CameraSet
from sfm.io.camera_tables import toml_document
from sfm.io.colmap_rigs import has_place_for_poses, read_rig_beside, write_rig_beside
from sfm.io.rig_files import RigFile, is_rig_file, read_rig_file, write_rig_file

_BY_SUFFIX = {".toml": "parallax", ".txt": "colmap", ".bin": "colmap", ".json": "nerfstudio"}
_TEXTS: dict[str, Callable[[CameraSet], str]] = {
    "opencv": opencv_text,
    "ros": ros_text,
    "kalibr": kalibr_text,
    "nerfstudio": nerfstudio_text,
}
_SUFFIXES = {
    "parallax": (".toml",),
    "colmap": (".txt", ".bin"),
    "opencv": (".yml", ".yaml"),
    "ros": (".yaml", ".yml"),
    "kalibr": (".yaml", ".yml"),
    "nerfstudio": (".json",),
}
FORMATS = tuple(_SUFFIXES)
TOLERANCE_PX = 1e-6
"""What an export may be off after it is read again; decimals lose about 1e-12."""


@dataclasses.dataclass(frozen=True, slots=True)
class Reread:
    """One camera of an export that was read again: how far it is from what was to be written.

    `motion` is the largest difference of an entry of its pose; 0 where the file has no poses.
    """

    name: str
    apart: Difference
    motion: float


def read_camera_set(path: Path | str, size: tuple[int, int] | None = None) -> tuple[str, CameraSet]:
    """The format of a file, and its cameras.

    Args:
        size: of the images where the file does not say.
    Raises:
        InputError: the file cannot be opened.
        FormatError: it is not what its suffix promises, of no known program, or has no equal among our models; a key of
            a `.toml` is unknown, missing or out of its range.
    """
    path = Path(path)
    if path.suffix.lower() in FOREIGN_SUFFIXES:
        cameras = read_foreign_cameras(path, size)
        return foreign_format(path), cameras
    if path.suffix.lower() == ".toml":
        return "parallax", _read_toml(path)
    cameras = read_intrinsics(path)
    names = tuple(f"camera{k}" for k in cameras) if len(cameras) > 1 else ("camera",)
    return "colmap", CameraSet(names, tuple(cameras.values()), read_rig_beside(path, cameras))


def format_of(path: Path | str, named: str = "") -> str:
    """The format that a file is to be written in: the named one, or what its suffix says.

    Raises:
        ConfigError: the suffix leaves it open, or does not fit.
    """
    suffix = Path(path).suffix.lower()
    name = named or _BY_SUFFIX.get(suffix, "")
    if not name:
        told = f"{suffix or 'no suffix'} may be the file of several programs" if suffix in FOREIGN_SUFFIXES else ""
        cause = told or f"the suffix {suffix!r} is that of no calibration file"
        raise ConfigError(cause, path=path, remedy=f"say which with --to {'|'.join(FORMATS)}")
    if name not in _SUFFIXES:
        raise ConfigError(f"there is no format {name!r}", remedy=f"known are {', '.join(FORMATS)}")
    if suffix not in _SUFFIXES[name]:
        raise ConfigError(f"a file of {name} ends in {' or '.join(_SUFFIXES[name])}", path=path)
    return name


def read_history(path: Path | str) -> CameraRecord | RigFile | None:
    """What a `.toml` tells of how its cameras were calibrated: of a camera a record, of a rig the whole file.

    None for files of other programs.

    Raises:
        SfmError: as `read_camera_set`.
    """
    path = Path(path)
    if path.suffix.lower() != ".toml":
        return None
    return read_rig_file(path) if is_rig_file(path) else read_camera_file(path)[1]


def write_camera_set(
    path: Path | str, cameras: CameraSet, name: str, history: CameraRecord | RigFile | None = None
) -> tuple[Reread, ...]:
    """Writes cameras in a format, and reads them again before the file takes its place.

    Args:
        history: of these very cameras, for the files of Parallax; see `read_history`.
    Raises:
        InputError: the system refuses.
        FormatError: the format has no place for these cameras, or what is read again is not what was written.
    """
    path = Path(path)
    try:
        with atomic_path(path) as temporary:
            # The reader goes by the suffix.
            staged = temporary.with_suffix(path.suffix)
            try:
                _write(staged, cameras, name, history)
                found = _compared(cameras, read_camera_set(staged)[1])
            finally:
                if staged.exists():
                    staged.replace(temporary)
            _check(found)
    except (FormatError, ConfigError) as error:
        raise FormatError(error.cause, path=path, remedy=error.remedy) from error
    return found


def write_poses_beside(path: Path | str, cameras: CameraSet, name: str) -> tuple[Path, ...]:
    """Writes what the format keeps of poses in files of their own, beside the cameras; returns their paths.

    Raises:
        InputError: the system refuses.
        FormatError: what is read again is not what was written.
    """
    path = Path(path)
    if name != "colmap" or cameras.cams_from_rig is None or len(cameras) < 2 or not has_place_for_poses(path):
        return ()
    return write_rig_beside(path, cameras)


def _write(path: Path, cameras: CameraSet, name: str, history: CameraRecord | RigFile | None) -> None:
    if name in _TEXTS:
        write_text(path, _TEXTS[name](cameras))
    elif name == "colmap":
        writer = colmap_binary if path.suffix.lower() == ".bin" else colmap_text
        write_chunks(path, writer.cameras_chunks(dict(enumerate(cameras.cameras, 1))))
    elif isinstance(history, RigFile):
        write_rig_file(path, history)
    elif len(cameras) == 1:
        write_camera_toml(path, cameras.cameras[0], name=cameras.names[0], record=history or CameraRecord())
    elif cameras.cams_from_rig is None:
        raise FormatError(
            f"a .toml has one camera or a rig, and these {len(cameras)} cameras have no poses",
            remedy="choose one with --camera NAME, or write a cameras.txt",
        )
    else:
        poses, first = cameras.cams_from_rig, cameras.cams_from_rig[0].inverse()
        about_first = Rigid3.stack([Rigid3.identity(), *(poses[k] @ first for k in range(1, len(cameras)))])
        rig = CameraRig(cameras.names, cameras.cameras, about_first, cameras.names[0], cameras.unit or "unknown")
        write_rig_file(path, RigFile(rig))


def _compared(cameras: CameraSet, again: CameraSet) -> tuple[Reread, ...]:
    """Camera by camera in their order; poses relative to the first."""
    motions = [0.0] * len(cameras)
    if len(cameras) != len(again):
        raise FormatError(f"{len(cameras)} cameras were written, and {len(again)} are read again")
    if cameras.cams_from_rig is not None and again.cams_from_rig is not None:
        both = [[c[k] @ c[0].inverse() for k in range(len(c))] for c in (cameras.cams_from_rig, again.cams_from_rig)]
        scale = max(1.0, max(float(np.abs(pose.translation).max()) for pose in both[0]))
        motions = [float(np.abs(a.matrix - b.matrix).max()) / scale for a, b in zip(*both, strict=True)]
    return tuple(
        Reread(name, difference(camera, other), motion)
        for name, camera, other, motion in zip(cameras.names, cameras.cameras, again.cameras, motions, strict=True)
    )


def _check(found: tuple[Reread, ...]) -> None:
    for one in found:
        px = one.apart.largest_px
        if not px <= TOLERANCE_PX or one.apart.uncovered > 0 or one.motion > TOLERANCE_PX:
            raise FormatError(
                f"{one.name}: what is read again differs by up to {px:.2g} px, its pose by {one.motion:.2g}, and does "
                f"not see {one.apart.uncovered:.1%} of the image"
            )


def _read_toml(path: Path) -> CameraSet:
    """A rig file, or a camera file with the name that it gives its camera."""
    document = toml_document(path)
    if "rig" in document:
        rig = read_rig_file(path).rig
        return CameraSet(rig.names, rig.cameras, rig.cams_from_rig, rig.unit)
    (camera,) = read_intrinsics(path).values()
    return CameraSet((str(document["camera"].get("name") or "camera"),), (camera,))
