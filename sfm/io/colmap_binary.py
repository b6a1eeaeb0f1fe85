"""COLMAP models, binary: cameras.bin, images.bin, points3D.bin, and rigs.bin and frames.bin since version 3.12.

All numbers are little-endian and packed.

    cameras   count u64 · { id u32, model i32, width u64, height u64, parameters f64 … }
    rigs      count u64 · { id u32, sensors u32, reference (type i32, id u32),
                            the others { type i32, id u32, has_pose u8, [q wxyz, t f64] } }
    frames    count u64 · { id u32, rig u32, rig_from_world (q wxyz, t f64), n u32, { type i32, sensor u32, data u64 } }
    images    count u64 · { id u32, cam_from_world (q wxyz, t f64), camera u32, name and a zero byte,
                            n u64, { x, y f64, point u64 } }
    points3D  count u64 · { id u64, xyz f64, rgb u8, error f64, n u64, { image u32, keypoint u32 } }

The tracks are read from points3D.bin alone; the point of each keypoint in images.bin repeats them, and is 2⁶⁴ − 1
where there is none.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sfm.core.cameras import Camera, model_by_id
from sfm.core.errors import FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import Frame, Rig
from sfm.io import _kernels
from sfm.io.atomic import Chunks, os_errors
from sfm.io.colmap_tables import ImageTable, PointTable, colmap_model, pose_of

_POINT_HEAD = np.dtype([("point_id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
_LENGTH_AT = _POINT_HEAD.itemsize - 8
_TRACK_ITEM = np.dtype([("image_id", "<i4"), ("feature_id", "<i4")])
_CAMERA_SENSOR = 0


# Reading


class _Cursor:
    """A position in the bytes of a file; reading beyond the end is a `FormatError`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with os_errors(path):
            self.data = np.fromfile(path, np.uint8)
        self.position = 0
        self._view = self.data.data

    def take(self, layout: str) -> tuple[Any, ...]:
        layout = "<" + layout
        start = self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self._view, start)

    def skip(self, size: int) -> int:
        start = self.position
        if not 0 <= size <= len(self._view) - start:
            raise self.error(f"is cut short: {size} bytes are needed at byte {start}, {len(self._view) - start} left")
        self.position += size
        return start

    def array(self, dtype: Any, shape: tuple[int, ...]) -> np.ndarray:
        """A view; its memory need not be aligned."""
        size = int(np.prod(shape, dtype=object)) * np.dtype(dtype).itemsize
        return np.ndarray(shape, dtype, self._view, self.skip(size))

    def name(self) -> str:
        end = self.data[self.position : self.position + 4096] == 0
        if not end.any():
            raise self.error(f"holds no end of the name at byte {self.position}")
        length = int(end.argmax())
        raw = bytes(self._view[self.position : self.position + length])
        self.position += length + 1
        try:
            return raw.decode()
        except UnicodeDecodeError:
            raise self.error(f"holds a name that is no UTF-8 at byte {self.position - length - 1}") from None

    def count(self, record_size: int) -> int:
        """The number of records at the head of the file, each at least `record_size` bytes long."""
        (count,) = self.take("Q")
        if count > (len(self._view) - self.position) // record_size:
            raise self.error(f"is cut short or no COLMAP file: it claims {count} records")
        return count

    def finish(self) -> None:
        if self.position != len(self._view):
            raise self.error(f"has {len(self._view) - self.position} bytes too many")

    def error(self, cause: str) -> FormatError:
        return FormatError(cause, path=self.path)


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[_Cursor]:
    cursor = _Cursor(path)
    try:
        yield cursor
        cursor.finish()
    except ValueError as error:
        raise cursor.error(str(error)) from error


def read_cameras(path: Path) -> dict[int, Camera]:
    """The cameras by id; whether a focal length was a prior is not in the file."""
    cameras = {}
    with _reading(path) as cursor:
        for _ in range(cursor.count(24)):
            camera_id, model_id, width, height = cursor.take("IiQQ")
            model = model_by_id(model_id)
            params = cursor.array("<f8", (len(model.param_names),))
            cameras[camera_id] = Camera(model.name, width, height, params)
    return cameras


def read_rigs(path: Path) -> tuple[Rig, ...]:
    """The rigs; sensors that are no cameras are left out."""
    rigs = []
    with _reading(path) as cursor:
        for _ in range(cursor.count(8)):
            rig_id, sensors = cursor.take("II")
            if not sensors:
                continue
            kind, ref_id = cursor.take("iI")
            others = {}
            for _ in range(sensors - 1):
                other_kind, sensor_id, has_pose = cursor.take("iIB")
                pose = pose_of(cursor.take("7d")) if has_pose else None
                if other_kind == _CAMERA_SENSOR:
                    others[sensor_id] = pose
            if kind != _CAMERA_SENSOR:
                raise cursor.error(f"has rig {rig_id} whose reference sensor is no camera")
            rigs.append(Rig(rig_id, ref_id, others))
    return tuple(rigs)


def read_frames(path: Path) -> tuple[Frame, ...]:
    """The frames; data that are no images are left out."""
    frames = []
    with _reading(path) as cursor:
        for _ in range(cursor.count(68)):
            frame_id, rig_id, *pose, count = cursor.take("II7dI")
            data = [cursor.take("iIQ") for _ in range(count)]
            images = {sensor: image for kind, sensor, image in data if kind == _CAMERA_SENSOR}
            frames.append(Frame(frame_id, rig_id, pose_of(pose), images))
    return tuple(frames)


def read_images(path: Path) -> ImageTable:
    """The images with their poses and keypoints, in the order of the file."""
    ids, camera_ids, names, poses, keypoints = [], [], [], [], []
    with _reading(path) as cursor:
        for _ in range(cursor.count(73)):
            image_id, *pose, camera_id = cursor.take("I7dI")
            ids.append(image_id)
            camera_ids.append(camera_id)
            poses.append(pose)
            names.append(cursor.name())
            (count,) = cursor.take("Q")
            keypoints.append(cursor.array("<f8", (count, 3))[:, :2])
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in keypoints], dtype=np.int64)]).astype(np.int64)
    flat = np.empty((offsets[-1], 2))
    for start, part in zip(offsets[:-1].tolist(), keypoints, strict=True):
        flat[start : start + len(part)] = part
    return ImageTable(
        np.array(ids, np.int64), np.array(camera_ids, np.int64), names, np.array(poses).reshape(-1, 7), offsets, flat
    )


def read_points(path: Path) -> PointTable:
    """The points with their tracks, in the order of the file."""
    with _reading(path) as cursor:
        counts = np.empty(cursor.count(_POINT_HEAD.itemsize), np.int64)
        records = cursor.data[cursor.position :]
        head, item = _POINT_HEAD.itemsize, _TRACK_ITEM.itemsize
        end = int(_kernels.measure_records(records, head, _LENGTH_AT, item, counts))
        if end < 0:
            raise cursor.error(f"is cut short: record {-1 - end} of {len(counts)} goes beyond its end")
        cursor.skip(end)
    offsets = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=offsets[1:])
    heads = np.empty((len(counts), head), np.uint8)
    tails = np.empty(offsets[-1] * item, np.uint8)
    _kernels.split_records(records, offsets, item, heads, tails)
    point, track = heads.view(_POINT_HEAD)[:, 0], tails.view(_TRACK_ITEM)
    return PointTable(
        point["point_id"], point["xyz"], point["rgb"], point["error"], offsets, track["image_id"], track["feature_id"]
    )


# Writing


def cameras_chunks(cameras: dict[int, Camera]) -> Chunks:
    """The content of cameras.bin.

    Raises:
        FormatError: COLMAP lacks the model of one.
    """
    yield struct.pack("<Q", len(cameras))
    for camera_id, camera in cameras.items():
        yield struct.pack("<IiQQ", camera_id, colmap_model(camera).model_id, camera.width, camera.height)
        yield camera.params.astype("<f8").tobytes()


def rigs_chunks(rigs: Iterable[Rig]) -> Chunks:
    """The content of rigs.bin."""
    rigs = tuple(rigs)
    yield struct.pack("<Q", len(rigs))
    for rig in rigs:
        yield struct.pack("<IIiI", rig.rig_id, 1 + len(rig.sensors_from_rig), _CAMERA_SENSOR, rig.ref_camera_id)
        for camera_id, pose in sorted(rig.sensors_from_rig.items()):
            yield struct.pack("<iIB", _CAMERA_SENSOR, camera_id, pose is not None)
            if pose is not None:
                yield _pose_bytes(pose)


def frames_chunks(frames: Iterable[Frame]) -> Chunks:
    """The content of frames.bin."""
    frames = tuple(frames)
    yield struct.pack("<Q", len(frames))
    for frame in frames:
        yield struct.pack("<II", frame.frame_id, frame.rig_id)
        yield _pose_bytes(frame.rig_from_world)
        yield struct.pack("<I", len(frame.image_ids))
        for camera_id, image_id in sorted(frame.image_ids.items()):
            yield struct.pack("<iIQ", _CAMERA_SENSOR, camera_id, image_id)


def images_chunks(images: ImageTable, keypoint_point_ids: np.ndarray) -> Chunks:
    """The content of images.bin; `keypoint_point_ids` (K,) is −1 where a keypoint has no point."""
    yield struct.pack("<Q", len(images.names))
    ids, camera_ids, offsets = images.image_ids.tolist(), images.camera_ids.tolist(), images.offsets.tolist()
    for row, name in enumerate(images.names):
        part = slice(offsets[row], offsets[row + 1])
        record = np.empty((offsets[row + 1] - offsets[row], 3))
        record[:, :2] = images.keypoints[part]
        record.view(np.int64)[:, 2] = keypoint_point_ids[part]
        pose = images.poses[row].astype("<f8").tobytes()
        yield struct.pack("<I", ids[row]) + pose + struct.pack("<I", camera_ids[row]) + name.encode() + b"\0"
        yield struct.pack("<Q", len(record))
        yield record.astype("<f8", copy=False)


def points_chunks(points: PointTable) -> Chunks:
    """The content of points3D.bin."""
    heads = np.empty((len(points.point_ids), 1), _POINT_HEAD)
    heads["point_id"][:, 0], heads["xyz"][:, 0], heads["rgb"][:, 0] = points.point_ids, points.xyz, points.rgb
    heads["error"][:, 0], heads["length"][:, 0] = points.errors, np.diff(points.offsets)
    track = np.empty(len(points.image_ids), _TRACK_ITEM)
    track["image_id"], track["feature_id"] = points.image_ids, points.feature_ids
    head_bytes = heads.view(np.uint8).reshape(len(heads), _POINT_HEAD.itemsize)
    data = np.empty(heads.nbytes + track.nbytes, np.uint8)
    _kernels.join_records(head_bytes, points.offsets, _TRACK_ITEM.itemsize, track.view(np.uint8), data)
    yield struct.pack("<Q", len(heads))
    yield data


def _pose_bytes(pose: Rigid3) -> bytes:
    return np.concatenate([pose.rotation.wxyz, pose.translation]).astype("<f8").tobytes()
