"""COLMAP models, text: the files of `colmap_binary` as lines of numbers.

Numbers are written with as many digits as it takes to read the same float64 back. Lines that start with # are
comments. In images.txt every image has two lines, and the second, its keypoints, may be empty. An image's name is the
rest of its line, so that it may hold spaces; COLMAP itself reads such a name only up to the first one, and is better
served with a binary model.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import TypeVar

import numpy as np

from sfm.core.cameras import Camera
from sfm.core.errors import FormatError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import Frame, Rig
from sfm.io.atomic import Chunks, os_errors
from sfm.io.colmap_tables import ImageTable, PointTable, colmap_model, pose_of

Item = TypeVar("Item")
_CAMERA = "CAMERA"
_ID_END = 2**31


# Reading


def read_cameras(path: Path) -> dict[int, Camera]:
    """The cameras by id; whether a focal length was a prior is not in the file."""
    return dict(_records(path, _camera))


def read_rigs(path: Path) -> tuple[Rig, ...]:
    """The rigs; sensors that are no cameras are left out."""
    return tuple(rig for rig in _records(path, _rig) if rig is not None)


def read_frames(path: Path) -> tuple[Frame, ...]:
    """The frames; data that are no images are left out."""
    return tuple(_records(path, _frame))


def read_images(path: Path) -> ImageTable:
    """The images with their poses and keypoints, in the order of the file."""
    ids, camera_ids, names, poses, keypoints = [], [], [], [], []
    with _lines(path) as lines:
        for line in lines:
            if not line or line.startswith("#"):
                continue
            image_id, *pose, camera_id, name = _words(line, 10)
            ids.append(_integer(image_id, _ID_END))
            poses.append([float(word) for word in pose])
            camera_ids.append(_integer(camera_id, _ID_END))
            names.append(name)
            words = next(lines, "").split()
            keypoints.append(np.array(words, np.float64).reshape(-1, 3)[:, :2])
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in keypoints])]).astype(np.int64)
    flat = np.concatenate([np.empty((0, 2)), *keypoints])
    return ImageTable(
        np.array(ids, np.int64), np.array(camera_ids, np.int64), names, np.array(poses).reshape(-1, 7), offsets, flat
    )


def read_points(path: Path) -> PointTable:
    """The points with their tracks, in the order of the file."""
    records = list(_records(path, _point))
    ids, xyz, rgb, errors, tracks = zip(*records, strict=True) if records else ((), (), (), (), ())
    offsets = np.concatenate([[0], np.cumsum([len(track) // 2 for track in tracks])]).astype(np.int64)
    flat = np.fromiter(chain.from_iterable(tracks), np.int64, int(2 * offsets[-1])).reshape(-1, 2)
    return PointTable(
        np.array(ids, np.int64),
        np.array(xyz, np.float64).reshape(-1, 3),
        np.array(rgb, np.uint8).reshape(-1, 3),
        np.array(errors, np.float64),
        offsets,
        flat[:, 0],
        flat[:, 1],
    )


def _camera(words: Sequence[str]) -> tuple[int, Camera]:
    camera_id, model, width, height, *params = words
    return _integer(camera_id, _ID_END), Camera(model, int(width), int(height), np.array(params, np.float64))


def _rig(words: Sequence[str]) -> Rig | None:
    rest = iter(words)
    rig_id, sensors = int(next(rest)), int(next(rest))
    if not sensors:
        return None
    kind, ref_id = next(rest), int(next(rest))
    if kind != _CAMERA:
        raise ValueError("the reference sensor is no camera")
    others = {}
    for _ in range(sensors - 1):
        kind, sensor_id, has_pose = next(rest), int(next(rest)), int(next(rest))
        pose = _pose([next(rest) for _ in range(7)]) if has_pose else None
        if kind == _CAMERA:
            others[sensor_id] = pose
    return Rig(rig_id, ref_id, others)


def _frame(words: Sequence[str]) -> Frame:
    frame_id, rig_id, *pose, count = words[:10]
    data = words[10:]
    if len(data) != 3 * int(count):
        raise ValueError(f"{count} data of three words each are announced, {len(data)} words follow")
    triples = zip(data[0::3], data[1::3], data[2::3], strict=True)
    images = {int(sensor): int(image) for kind, sensor, image in triples if kind == _CAMERA}
    return Frame(int(frame_id), int(rig_id), _pose(pose), images)


def _point(words: Sequence[str]) -> tuple[int, list[float], list[int], float, list[int]]:
    point_id, x, y, z, r, g, b, error, *track = words
    if len(track) % 2:
        raise ValueError("a track is not made of pairs")
    xyz, rgb = [float(x), float(y), float(z)], [_integer(channel, 256) for channel in (r, g, b)]
    return _integer(point_id, 2**63), xyz, rgb, float(error), [_integer(word, _ID_END) for word in track]


def _pose(words: Iterable[str]) -> Rigid3:
    return pose_of([float(word) for word in words])


def _words(line: str, count: int) -> list[str]:
    """The words of a line, of which the last may hold spaces."""
    words = line.split(maxsplit=count - 1)
    if len(words) != count:
        raise ValueError(f"{count} words are needed, {len(words)} are there")
    return words


def _integer(word: str, below: int) -> int:
    number = int(word)
    if not 0 <= number < below:
        raise ValueError(f"{number} is not in [0, {below})")
    return number


def _records(path: Path, parse: Callable[[Sequence[str]], Item]) -> Iterator[Item]:
    """What `parse` makes of the words of each line that is neither empty nor a comment."""
    with _lines(path) as lines:
        for line in lines:
            if not line or line.startswith("#"):
                continue
            try:
                record = parse(line.split())
            except StopIteration:
                raise ValueError("it ends too early") from None
            yield record


@contextlib.contextmanager
def _lines(path: Path) -> Iterator[Iterator[str]]:
    """The lines of a file, stripped; an error that is raised on the way names the line."""
    number = 0

    def numbered(lines: Iterable[str]) -> Iterator[str]:
        nonlocal number
        for line in lines:
            number += 1
            yield line.strip()

    with os_errors(path), path.open(encoding="utf-8") as file:
        try:
            yield numbered(file)
        except UnicodeDecodeError as error:
            raise FormatError("is no text file", path=path) from error
        except (ValueError, OverflowError) as error:
            raise FormatError(f"line {number} cannot be read: {error}", path=path) from error


# Writing


def cameras_chunks(cameras: dict[int, Camera]) -> Chunks:
    """The content of cameras.txt.

    Raises:
        FormatError: COLMAP lacks the model of one.
    """
    yield _header("Camera list: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", len(cameras), "cameras")
    for camera_id, camera in cameras.items():
        words = f"{camera_id} {colmap_model(camera).name} {camera.width} {camera.height} {_numbers(camera.params)}"
        yield f"{words}\n".encode()


def rigs_chunks(rigs: Iterable[Rig]) -> Chunks:
    """The content of rigs.txt."""
    rigs = tuple(rigs)
    sensors = "SENSORS[] as (SENSOR_TYPE, SENSOR_ID, HAS_POSE, [QW, QX, QY, QZ, TX, TY, TZ])"
    yield _header(f"Rig list: RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, {sensors}", len(rigs), "rigs")
    for rig in rigs:
        words = [f"{rig.rig_id} {1 + len(rig.sensors_from_rig)} {_CAMERA} {rig.ref_camera_id}"]
        for camera_id, pose in sorted(rig.sensors_from_rig.items()):
            words.append(f"{_CAMERA} {camera_id} " + ("0" if pose is None else f"1 {_pose_words(pose)}"))
        yield (" ".join(words) + "\n").encode()


def frames_chunks(frames: Iterable[Frame]) -> Chunks:
    """The content of frames.txt."""
    frames = tuple(frames)
    data = "NUM_DATA_IDS, DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)"
    columns = f"FRAME_ID, RIG_ID, RIG_FROM_WORLD[QW, QX, QY, QZ, TX, TY, TZ], {data}"
    yield _header(f"Frame list: {columns}", len(frames), "frames")
    for frame in frames:
        words = [f"{frame.frame_id} {frame.rig_id} {_pose_words(frame.rig_from_world)} {len(frame.image_ids)}"]
        words += [f"{_CAMERA} {camera_id} {image_id}" for camera_id, image_id in sorted(frame.image_ids.items())]
        yield (" ".join(words) + "\n").encode()


def images_chunks(images: ImageTable, keypoint_point_ids: np.ndarray) -> Chunks:
    """The content of images.txt; `keypoint_point_ids` (K,) is −1 where a keypoint has no point.

    Raises:
        ValueError: a name holds a line break.
    """
    columns = "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME and a line POINTS2D[] as (X, Y, POINT3D_ID)"
    yield _header(f"Image list: {columns}", len(images.names), "images")
    for row, name in enumerate(images.names):
        if name.splitlines() != [name]:
            raise ValueError(f"an image's name cannot be written as text: {name!r}")
        part = slice(images.offsets[row], images.offsets[row + 1])
        keypoints = zip(images.keypoints[part].tolist(), keypoint_point_ids[part].tolist(), strict=True)
        yield f"{images.image_ids[row]} {_numbers(images.poses[row])} {images.camera_ids[row]} {name}\n".encode()
        yield (" ".join(f"{x!r} {y!r} {point_id}" for (x, y), point_id in keypoints) + "\n").encode()


def points_chunks(points: PointTable) -> Chunks:
    """The content of points3D.txt."""
    columns = "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    yield _header(f"3D point list: {columns}", len(points.point_ids), "points")
    offsets = points.offsets.tolist()
    track = np.column_stack([points.image_ids, points.feature_ids]).ravel().tolist()
    rows = zip(points.point_ids.tolist(), points.xyz.tolist(), points.rgb.tolist(), points.errors.tolist(), strict=True)
    for row, (point_id, (x, y, z), (r, g, b), error) in enumerate(rows):
        items = " ".join(map(str, track[2 * offsets[row] : 2 * offsets[row + 1]]))
        yield f"{point_id} {x!r} {y!r} {z!r} {r} {g} {b} {error!r} {items}\n".encode()


def _header(columns: str, count: int, what: str) -> bytes:
    return f"# {columns}\n# Number of {what}: {count}\n".encode()


def _numbers(values: np.ndarray) -> str:
    return " ".join(map(repr, values.tolist()))


def _pose_words(pose: Rigid3) -> str:
    return f"{_numbers(pose.rotation.wxyz)} {_numbers(pose.translation)}"
