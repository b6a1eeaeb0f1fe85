"""Points that a person marked in photos, as points of a model for the time of its adjustment."""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.arrays import FloatArray
from sfm.core.errors import InputError, Rejected
from sfm.core.geometry.triangulation import triangulate_many
from sfm.core.scene import Reconstruction, Tracks
from sfm.evaluation.compare import match_names
from sfm.io.measurements import ControlPoints, Marks


def with_marks(
    model: Reconstruction, control: ControlPoints, marks: Marks
) -> tuple[Reconstruction, ControlPoints, int]:
    """The model with the control points that two of its images mark, last of its points and of their keypoints.

    Returns:
        The model; the control points under the ids that they have in it; how many are not marked in two images whose
        rays meet.
    Raises:
        InputError: none is.
    """
    rows = _image_rows(model, marks)
    found = []
    for k, label in enumerate(control.labels):
        seen = [m for m in range(len(rows)) if marks.labels[m] == label and rows[m] >= 0]
        point = _triangulated(model, rows[seen], marks.points2D[seen])
        if point is not None:
            found.append((k, seen, point))
    if not found:
        remedy = "a control point needs the same label in both tables, and marks in two photos of the model"
        raise InputError("no control point is marked in two images of the model", remedy=remedy)
    first_id = int(model.point_ids.max(initial=0)) + 1
    ids = np.arange(first_id, first_id + len(found))
    kept = [k for k, _, _ in found]
    named = ControlPoints(tuple(str(point_id) for point_id in ids), control.positions[kept], control.sigmas[kept])
    points3D = np.array([point for _, _, point in found])
    return (
        _with_points(model, ids, points3D, [(rows[seen], marks.points2D[seen]) for _, seen, _ in found]),
        named,
        (len(control.labels) - len(found)),
    )


def without_marks(model: Reconstruction, original: Reconstruction) -> Reconstruction:
    """The model with the points and keypoints of the original, and its own poses, cameras and places of points."""
    count = len(original.points3D)
    return dataclasses.replace(
        model,
        keypoint_offsets=original.keypoint_offsets,
        keypoints=original.keypoints,
        points3D=model.points3D[:count],
        point_ids=original.point_ids,
        colors=original.colors,
        errors=model.errors[:count],
        tracks=original.tracks,
    )


def _image_rows(model: Reconstruction, marks: Marks) -> np.ndarray:
    """The image of each mark, −1 where the model lacks it."""
    names = tuple(dict.fromkeys(marks.names))
    rows, named = match_names(model.image_names, names)
    row_of = {names[n]: int(row) for row, n in zip(rows, named, strict=True)}
    return np.array([row_of.get(name, -1) for name in marks.names], np.int64)


def _triangulated(model: Reconstruction, rows: np.ndarray, points2D: FloatArray) -> FloatArray | None:
    rays, reached = np.zeros((len(rows), 3)), np.zeros(len(rows), bool)
    for k, row in enumerate(rows):
        camera = model.cameras[int(model.image_camera_ids[row])]
        ray, valid = camera.unproject(points2D[k : k + 1])
        rays[k], reached[k] = ray[0], valid[0]
    if reached.sum() < 2:
        return None
    point = triangulate_many(model.cams_from_world[rows[reached]], rays[reached])
    return None if isinstance(point, Rejected) else point


def _with_points(
    model: Reconstruction, ids: np.ndarray, points3D: FloatArray, seen: list[tuple[np.ndarray, FloatArray]]
) -> Reconstruction:
    """Appends points that are seen in rows of images at places, each at a keypoint of its own."""
    image_rows = np.concatenate([rows for rows, _ in seen])
    places = np.concatenate([points2D for _, points2D in seen])
    counts = np.diff(model.keypoint_offsets)
    order = np.argsort(image_rows, kind="stable")
    firsts = np.searchsorted(image_rows[order], image_rows[order])
    feature_ids = np.empty(len(order), np.int32)
    feature_ids[order] = counts[image_rows[order]] + np.arange(len(order)) - firsts
    added = np.bincount(image_rows, minlength=len(counts))
    tracks, lengths = model.tracks, [len(rows) for rows, _ in seen]
    return dataclasses.replace(
        model,
        keypoint_offsets=np.concatenate([[0], np.cumsum(counts + added)]),
        keypoints=np.insert(model.keypoints, model.keypoint_offsets[image_rows[order] + 1], places[order], axis=0),
        points3D=np.concatenate([model.points3D, points3D]),
        point_ids=np.concatenate([model.point_ids, ids]),
        colors=np.concatenate([model.colors, np.zeros((len(ids), 3), np.uint8)]),
        errors=np.concatenate([model.errors, np.full(len(ids), -1.0)]),
        tracks=Tracks(
            np.concatenate([tracks.offsets, tracks.offsets[-1] + np.cumsum(lengths)]),
            np.concatenate([tracks.image_ids, model.image_ids[image_rows]]),
            np.concatenate([tracks.feature_ids, feature_ids]),
        ),
    )
