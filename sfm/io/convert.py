"""A model from one format to another: COLMAP binary ↔ text, and to a PLY point cloud."""

from __future__ import annotations

import os
from pathlib import Path

from sfm.core.errors import InputError
from sfm.io.colmap_model import model_format, read_model, write_model
from sfm.io.ply import write_ply


def convert(source: Path | str, target: Path | str, *, text: bool | None = None, overwrite: bool = False) -> str:
    """Converts the model in the folder `source`.

    A target that ends in `.ply` becomes a point cloud (positions and colours; cameras and tracks have no place in
    one). Any other is a folder with a model: text if `text`, binary if not, and left open the one that `source` is not.

    Returns:
        What was written, `"ply"`, `"txt"` or `"bin"`.
    Raises:
        InputError: `source` holds no model, `target` is the same folder, or holds something and not `overwrite`.
        FormatError: a file of `source` is damaged.
    """
    source, target = Path(source), Path(target)
    if is_point_cloud(source):
        raise InputError("a point cloud has no cameras to convert", path=source, remedy="name the folder of a model")
    if os.path.realpath(source) == os.path.realpath(target):
        raise InputError("is both source and target", path=target, remedy="name another folder as the target")
    to_ply = is_point_cloud(target)
    taken = target.exists() if to_ply else model_format(target) is not None
    if taken and not overwrite:
        raise InputError("is there already", path=target, remedy="choose another target, or --overwrite it")
    reconstruction = read_model(source)
    if to_ply:
        write_ply(target, reconstruction.points3D, reconstruction.colors)
        return "ply"
    as_text = model_format(source) == "bin" if text is None else text
    write_model(reconstruction, target, text=as_text)
    return "txt" if as_text else "bin"


def is_point_cloud(path: Path) -> bool:
    """Whether a path names a PLY file."""
    return path.suffix.lower() == ".ply"
