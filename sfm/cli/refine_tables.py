"""What `sfm refine` writes beside an adjusted model: its frame, and standard deviations of poses and points.

    frame.json          how the model came into the frame of its measurements
    pose_sigmas.csv     name,sx,sy,sz,rx_deg,ry_deg,rz_deg: of the centre along the axes of the world in units of the
                        scene, and of rotations about the axes of the camera (x right, y down, z forward)
    point_sigmas.csv    id,sx,sy,sz

Zero is what was held, an empty cell what the observations leave open.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sfm.io.atomic import os_errors, write_text
from sfm.pipeline.refined_model import Uncertainty

if TYPE_CHECKING:
    from sfm.core.arrays import FloatArray
    from sfm.pipeline.refined_model import RefinedModel

FRAME, POSES, POINTS = "frame.json", "pose_sigmas.csv", "point_sigmas.csv"


def write_tables(refined: RefinedModel, folder: Path, *, overwrite: bool) -> None:
    """Writes all that there is to tell.

    Args:
        overwrite: tables of the model that was there before, which are not told now, go with it.
    """
    model, files = refined.reconstruction, {}
    if refined.frame is not None:
        files[FRAME] = json.dumps(refined.frame.to_json(), indent=2) + "\n"
    if isinstance(refined.uncertainty, Uncertainty):
        poses = np.hstack(refined.pose_sigmas)
        files[POSES] = _table(("name", "sx", "sy", "sz", "rx_deg", "ry_deg", "rz_deg"), model.image_names, poses)
        files[POINTS] = _table(("id", "sx", "sy", "sz"), model.point_ids.tolist(), refined.point_sigmas)
    for name in (FRAME, POSES, POINTS):
        if name in files:
            write_text(folder / name, files[name])
        elif overwrite:
            with os_errors(folder / name):
                (folder / name).unlink(missing_ok=True)


def _table(header: Sequence[str], keys: Iterable[str | int], sigmas: FloatArray) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    for key, row in zip(keys, sigmas.tolist(), strict=True):
        writer.writerow([key, *("" if value != value else f"{value:.6g}" for value in row)])
    return out.getvalue()
