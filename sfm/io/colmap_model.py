"""COLMAP models on disk: a folder with binary or text files.

    read_model("sparse/0")                            binary is preferred where both are there
    write_model(reconstruction, "sparse/0")           with rigs and frames, as COLMAP ≥ 3.12 writes them

The same reconstruction gives the same bytes. A folder without rigs and frames, from an older program, reads as well.
Not kept, since the files have no place for it: `Camera.has_prior_focal_length`.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from sfm.core.errors import InputError
from sfm.core.scene import Reconstruction
from sfm.io import colmap_binary, colmap_text
from sfm.io.atomic import write_folder
from sfm.io.colmap_tables import assemble, image_table, keypoint_point_ids, point_table, rigs_and_frames

_REQUIRED = ("cameras", "images", "points3D")
_FILES = (*_REQUIRED, "rigs", "frames")


def model_format(folder: Path | str) -> str | None:
    """`"bin"` or `"txt"`, whichever model is complete in the folder, binary first; None where neither is."""
    for suffix in ("bin", "txt"):
        if all((Path(folder) / f"{name}.{suffix}").is_file() for name in _REQUIRED):
            return suffix
    return None


def read_model(folder: Path | str) -> Reconstruction:
    """Reads a model.

    Raises:
        InputError: the folder holds no model.
        FormatError: a file is cut short, holds something else, or contradicts another.
    """
    folder = Path(folder)
    suffix = model_format(folder)
    if suffix is None:
        raise InputError(
            "there is no COLMAP model in this folder",
            path=folder,
            remedy="name the folder that holds cameras, images and points3D, as .bin or .txt; often `sparse/0`",
        )
    reader = _module(suffix)
    with_rigs = all((folder / f"{name}.{suffix}").is_file() for name in ("rigs", "frames"))
    return assemble(
        folder,
        reader.read_cameras(folder / f"cameras.{suffix}"),
        reader.read_images(folder / f"images.{suffix}"),
        reader.read_points(folder / f"points3D.{suffix}"),
        reader.read_rigs(folder / f"rigs.{suffix}") if with_rigs else (),
        reader.read_frames(folder / f"frames.{suffix}") if with_rigs else (),
    )


def write_model(reconstruction: Reconstruction, folder: Path | str, *, text: bool = False) -> None:
    """Writes a model in place of one that is there, in either format; other files in the folder stay.

    Raises:
        InputError: the system refuses.
        ValueError: tracks name what is not there, or the poses of images and of their frames differ.
    """
    suffix = "txt" if text else "bin"
    writer = _module(suffix)
    rigs, frames = rigs_and_frames(reconstruction)
    points = point_table(reconstruction)
    point_ids = keypoint_point_ids(reconstruction)
    contents = {
        "rigs": writer.rigs_chunks(rigs),
        "cameras": writer.cameras_chunks(dict(reconstruction.cameras)),
        "frames": writer.frames_chunks(frames),
        "images": writer.images_chunks(image_table(reconstruction), point_ids),
        "points3D": writer.points_chunks(points),
    }
    other = "bin" if text else "txt"
    write_folder(
        Path(folder),
        {f"{name}.{suffix}": chunks for name, chunks in contents.items()},
        obsolete=[f"{name}.{other}" for name in _FILES],
    )


def _module(suffix: str) -> ModuleType:
    return colmap_binary if suffix == "bin" else colmap_text
