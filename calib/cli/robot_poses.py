"""Poses of a robot's hand from a table, and which photo each of them belongs to.

    name,x,y,z,qw,qx,qy,qz
    photo01.png,0.412,-0.105,0.337,0.0123,0.9997,0.0181,-0.0034

The first line names the columns, in any order; further columns are passed over. The pose is base_from_hand: x, y, z is
where the hand is in the frame of the base, the quaternion (qw is its real part) how it is turned.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath

import numpy as np

from calib.refine_reject import RejectedView
from calib.refine_views import BoardView
from sfm.core.errors import FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.io.atomic import os_errors

COLUMNS = ("name", "x", "y", "z", "qw", "qx", "qy", "qz")
_NOT_UNIT = 0.01


def read_robot_poses(path: Path, unit_m: float = 1.0) -> dict[str, Rigid3]:
    """base_from_hand by the name in the table, in metres.

    Args:
        unit_m: of x, y, z in the table.
    Raises:
        InputError: the file cannot be opened.
        FormatError: a column is missing, a value is no number, a quaternion is none, or a name is there twice.
    """
    with os_errors(path):
        content = path.read_bytes()
    try:
        lines = content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise FormatError("is no text in UTF-8", path=path) from error
    rows = csv.reader(line for line in lines if line.strip() and not line.lstrip().startswith("#"))
    header = [word.strip().lower() for word in next(rows, [])]
    missing = [column for column in COLUMNS if column not in header]
    if missing:
        raise FormatError(
            f"has no column {', '.join(missing)}", path=path, remedy=f"the first line must be {','.join(COLUMNS)}"
        )
    at = [header.index(column) for column in COLUMNS]
    poses: dict[str, Rigid3] = {}
    for number, row in enumerate(rows, 2):
        name, values = _row(row, at, path, number)
        if name in poses:
            raise FormatError(f"has {name} twice", path=path)
        poses[name] = Rigid3(Rotation3(values[3:]), unit_m * values[:3])
    if not poses:
        raise FormatError("holds no pose", path=path)
    return poses


def _row(row: Sequence[str], at: Sequence[int], path: Path, number: int) -> tuple[str, np.ndarray]:
    try:
        name = row[at[0]].strip()
        values = np.array([float(row[k]) for k in at[1:]])
    except (ValueError, IndexError) as error:
        raise FormatError(f"row {number} is not a name and seven numbers: {','.join(row)}", path=path) from error
    if not np.isfinite(values).all() or abs(np.linalg.norm(values[3:]) - 1) > _NOT_UNIT:
        raise FormatError(f"row {number} ({name}) has no unit quaternion, or a number that is not finite", path=path)
    return name, values


def poses_of_photos(
    views: Sequence[BoardView], table: Mapping[str, Rigid3], path: Path
) -> tuple[list[BoardView], Rigid3, tuple[RejectedView, ...]]:
    """Views with a pose, these poses (V,), and the views without one.

    A photo's name in the table may lack folder and suffix, or have others.

    Raises:
        FormatError: no photo has a pose, or without folder and suffix several rows or several photos are called alike.
    """
    names = _rows_of([view.name for view in views], list(table), path)
    found = [(view, table[name] if name else None) for view, name in zip(views, names, strict=True)]
    kept = [(view, pose) for view, pose in found if pose is not None]
    if not kept:
        told = f"{next(iter(table))} in the table, {views[0].name} among the photos"
        raise FormatError(f"names no photo that shows the board: {told}", path=path)
    alone = tuple(RejectedView(view.name, "no_pose", "the table has none") for view, pose in found if pose is None)
    return [view for view, _ in kept], Rigid3.stack([pose for _, pose in kept]), alone


def _rows_of(photos: Sequence[str], rows: Sequence[str], path: Path) -> list[str]:
    """The name in the table of each photo, empty where there is none; what names a photo in full is no other's."""
    known = set(rows)
    named = {photo: photo for photo in photos if photo in known}
    free = dict.fromkeys(row for row in rows if row not in named)
    stems: dict[str, list[str]] = {}
    for row in free:
        stems.setdefault(PurePath(row).stem, []).append(row)
    owner: dict[str, str] = {}
    for photo in photos:
        whole = str(PurePath(photo).with_suffix(""))
        alike = [whole] if whole in free else stems.get(PurePath(photo).stem, [])
        if photo in named or not alike:
            continue
        if len(alike) > 1:
            told = f"{photo} may be {alike[0]} or {alike[1]} in the table"
            raise FormatError(told, path=path, remedy="name each photo there with its folder and suffix")
        if alike[0] in owner:
            told = f"{alike[0]} in the table may be the photo {owner[alike[0]]} or {photo}"
            raise FormatError(told, path=path, remedy="name each photo there with its folder and suffix")
        owner[alike[0]], named[photo] = photo, alike[0]
    return [named.get(photo, "") for photo in photos]
