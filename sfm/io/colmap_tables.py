"""The columns of a COLMAP model as its files hold them, and their way to and from a `Reconstruction`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sfm.core.cameras import Camera, CameraModel
from sfm.core.errors import FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Frame, Reconstruction, Rig, Tracks

_MAX_ID = 2**31 - 1
# Poses of images and of their frames that differ by more were not changed together; text of few digits differs less.
_POSE_TOLERANCE = 1e-3
_IDENTITY = Rigid3.identity()


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ImageTable:
    """images.bin or .txt, a row per image.

    `poses` (I, 7) are q wxyz and t; `keypoints` (K, 2) those of one image after the other.
    """

    image_ids: np.ndarray
    camera_ids: np.ndarray
    names: Sequence[str]
    poses: np.ndarray
    offsets: np.ndarray
    keypoints: np.ndarray


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class PointTable:
    """points3D.bin or .txt: a row per point, tracks in flat columns as in `Tracks`."""

    point_ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray
    errors: np.ndarray
    offsets: np.ndarray
    image_ids: np.ndarray
    feature_ids: np.ndarray


def colmap_model(camera: Camera) -> CameraModel:
    """The model of a camera that goes into one of COLMAP's files.

    Raises:
        FormatError: COLMAP does not have it.
    """
    model = camera.model_info
    if not model.is_in_colmap:
        nearest = "OPENCV_FISHEYE" if model.is_fisheye else "FULL_OPENCV"
        remedy = (
            f"fit a model that it has, and see how far it is off: calib convert FILE -o cameras.txt --fit {nearest}"
        )
        raise FormatError(f"COLMAP has no camera model {model.name}", remedy=remedy)
    return model


def pose_of(numbers: Sequence[float]) -> Rigid3:
    """The pose q wxyz, t.

    Raises:
        ValueError: there are not seven numbers, or q is not one that can be normalised.
    """
    values = np.array(numbers, np.float64)
    if values.shape != (7,):
        raise ValueError(f"a pose has 7 numbers, got {values.size}")
    return _poses_of(values)


def _poses_of(rows: np.ndarray) -> Rigid3:
    with np.errstate(over="ignore"):  # damaged files hold numbers whose square overflows; `Rotation3` refuses them
        return Rigid3(Rotation3(rows[..., :4]), rows[..., 4:])


def assemble(
    folder: Path,
    cameras: dict[int, Camera],
    images: ImageTable,
    points: PointTable,
    rigs: tuple[Rig, ...],
    frames: tuple[Frame, ...],
) -> Reconstruction:
    """A reconstruction from the columns of its files; trivial rigs and frames become empty tuples.

    Raises:
        FormatError: the files contradict each other.
    """
    images = _sorted_by_id(images)
    _check(folder, cameras, images, points)
    trivial = all(not rig.sensors_from_rig for rig in rigs) and all(len(frame.image_ids) == 1 for frame in frames)
    try:
        poses = _poses_of(images.poses)
        problem = _frames_problem(rigs, frames, images.image_ids, poses) if rigs else None
        if problem:
            raise ValueError(problem)
        return Reconstruction(
            cameras=cameras,
            image_ids=images.image_ids.astype(np.int32),
            image_names=tuple(images.names),
            image_camera_ids=images.camera_ids.astype(np.int32),
            cams_from_world=poses,
            keypoint_offsets=images.offsets,
            keypoints=images.keypoints,
            points3D=points.xyz,
            point_ids=points.point_ids,
            colors=points.rgb,
            errors=points.errors,
            tracks=Tracks(points.offsets, points.image_ids.astype(np.int32), points.feature_ids.astype(np.int32)),
            rigs=() if trivial else rigs,
            frames=() if trivial else frames,
        )
    except ValueError as error:
        raise FormatError(f"the model is not sound: {error}", path=folder) from error


def image_table(reconstruction: Reconstruction) -> ImageTable:
    """The columns of the images."""
    poses = reconstruction.cams_from_world
    return ImageTable(
        reconstruction.image_ids,
        reconstruction.image_camera_ids,
        reconstruction.image_names,
        np.concatenate([poses.rotation.wxyz, poses.translation], axis=1),
        reconstruction.keypoint_offsets,
        reconstruction.keypoints,
    )


def point_table(reconstruction: Reconstruction) -> PointTable:
    """The columns of the points."""
    tracks = reconstruction.tracks
    return PointTable(
        reconstruction.point_ids,
        reconstruction.points3D,
        reconstruction.colors,
        reconstruction.errors,
        tracks.offsets,
        tracks.image_ids,
        tracks.feature_ids,
    )


def keypoint_point_ids(reconstruction: Reconstruction) -> np.ndarray:
    """The id of each keypoint's point (K,), −1 where it has none.

    Raises:
        ValueError: a track names an image or a keypoint that is not there.
    """
    tracks = reconstruction.tracks
    out = np.full(len(reconstruction.keypoints), -1, np.int64)
    if not _in_range(reconstruction.image_ids, reconstruction.keypoint_offsets, tracks.image_ids, tracks.feature_ids):
        raise ValueError("a track names an image or a keypoint that is not there")
    rows = reconstruction.keypoint_offsets[_rows_of(reconstruction.image_ids, tracks.image_ids)] + tracks.feature_ids
    out[rows] = np.repeat(reconstruction.point_ids, tracks.lengths)
    return out


def rigs_and_frames(reconstruction: Reconstruction) -> tuple[tuple[Rig, ...], tuple[Frame, ...]]:
    """Those of the reconstruction, or trivial ones: a rig with the id of each camera, a frame with that of each image.

    Raises:
        ValueError: frames and images do not fit together, e.g. if the poses of the latter alone were changed.
    """
    if reconstruction.rigs:
        own = reconstruction.rigs, reconstruction.frames
        problem = _frames_problem(*own, reconstruction.image_ids, reconstruction.cams_from_world)
        if problem:
            raise ValueError(problem)
        return own
    rigs = tuple(Rig(camera_id, camera_id) for camera_id in reconstruction.cameras)
    columns = zip(reconstruction.image_ids.tolist(), reconstruction.image_camera_ids.tolist(), strict=True)
    poses = reconstruction.cams_from_world
    frames = tuple(
        Frame(image_id, camera_id, poses[row], {camera_id: image_id})
        for row, (image_id, camera_id) in enumerate(columns)
    )
    return rigs, frames


def _frames_problem(
    rigs: Sequence[Rig], frames: Sequence[Frame], image_ids: np.ndarray, cams_from_world: Rigid3
) -> str | None:
    """What keeps these frames from being those of the images; None where all is well.

    COLMAP takes the pose of an image from its frame and rig, so that another one beside the image would be lost.
    """
    by_id = {rig.rig_id: rig for rig in rigs}
    row_of = {image_id: row for row, image_id in enumerate(image_ids.tolist())}
    rows, sensors, bodies, framed = [], [], [], set()
    for frame in frames:
        rig = by_id.get(frame.rig_id)
        if rig is None:
            return f"frame {frame.frame_id} is of rig {frame.rig_id}, which is not there"
        for camera_id, image_id in frame.image_ids.items():
            if camera_id != rig.ref_camera_id and camera_id not in rig.sensors_from_rig:
                return f"frame {frame.frame_id} has an image of camera {camera_id}, which is not in its rig"
            framed.add(image_id)
            sensor = _IDENTITY if camera_id == rig.ref_camera_id else rig.sensors_from_rig[camera_id]
            if image_id in row_of and sensor is not None:
                rows.append(row_of[image_id])
                sensors.append(sensor)
                bodies.append(frame.rig_from_world)
    if not framed >= row_of.keys():
        return f"image {min(row_of.keys() - framed)} is in no frame"
    expected, actual = Rigid3.stack(sensors) @ Rigid3.stack(bodies), cams_from_world[np.array(rows, np.int64)]
    tolerance = _POSE_TOLERANCE * (1 + np.abs(expected.translation).max(-1, initial=0)[:, None, None])
    wrong = (np.abs(actual.matrix - expected.matrix) > tolerance).any((-2, -1))
    if wrong.any():
        return f"the pose of image {image_ids[rows[int(wrong.argmax())]]} is not that of its frame"
    return None


def _sorted_by_id(images: ImageTable) -> ImageTable:
    order: list[int] = np.argsort(images.image_ids, kind="stable").tolist()
    if order == list(range(len(order))):
        return images
    keypoints = [images.keypoints[images.offsets[row] : images.offsets[row + 1]] for row in order]
    return ImageTable(
        images.image_ids[order],
        images.camera_ids[order],
        [images.names[row] for row in order],
        images.poses[order],
        np.concatenate([[0], np.cumsum([len(part) for part in keypoints])]).astype(np.int64),
        np.concatenate(keypoints),
    )


def _check(folder: Path, cameras: dict[int, Camera], images: ImageTable, points: PointTable) -> None:
    def refuse(cause: str) -> FormatError:
        return FormatError(f"the model is not sound: {cause}", path=folder)

    ids = (*images.image_ids.tolist(), *images.camera_ids.tolist(), *cameras)
    if ids and not 0 <= min(ids) <= max(ids) <= _MAX_ID:
        raise refuse("an id is negative or beyond 2³¹ − 1")
    if not _in_range(images.image_ids, images.offsets, points.image_ids, points.feature_ids):
        raise refuse("a track names an image or a keypoint that is not there")


def _rows_of(image_ids: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The row of each wanted id in the sorted ids, through a table where the ids are dense enough for one."""
    top = int(image_ids[-1]) + 1 if len(image_ids) else 0
    if top <= 4 * len(wanted) + 4 * len(image_ids):
        table = np.full(top, -1, np.int64)
        table[image_ids] = np.arange(len(image_ids))
        return table[wanted]
    return np.searchsorted(image_ids, wanted)


def _in_range(image_ids: np.ndarray, offsets: np.ndarray, wanted: np.ndarray, feature_ids: np.ndarray) -> bool:
    """Whether each wanted image exists and has the keypoint."""
    if not len(wanted):
        return True
    if not len(image_ids) or wanted.min() < image_ids[0] or wanted.max() > image_ids[-1]:
        return False
    rows = _rows_of(image_ids, wanted)
    if rows.min() < 0 or not np.array_equal(image_ids[rows], wanted):
        return False
    return bool(feature_ids.min() >= 0 and np.all(feature_ids < np.diff(offsets)[rows]))
