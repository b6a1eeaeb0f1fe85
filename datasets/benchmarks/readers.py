"""Readers of the truth that published image sets come with.

Each gives a `Reconstruction` without points. The file formats differ in two things that are easily got wrong:

| set | pose in the file | pixel of the principal point |
|---|---|---|
| Strecha `.camera` | R camera→world and the camera's centre, metres | not documented |
| Middlebury `_par.txt` | R, t world→camera, metres | not documented ("origin is top-left") |
| IMC `.h5` | R, T world→camera, scale arbitrary | (w/2, h/2): corner origin, as ours |
| KITTI `poses.txt` | 3×4 camera→world of camera 0, metres | not documented |
| Bundler `.out` | R, t world→camera, camera looking along −z with y up | image centre |

Ours is the corner origin: the centre of the first pixel is (0.5, 0.5). Where a set does not say, K is taken as given
(`pixel_origin="corner"`); `pixel_origin="center"` reads it as counted from the first pixel's centre and adds ½ to
cx and cy. Where K is given to a reconstruction and held, the choice turns every camera by the same atan(½√2 / f),
0.015° at the 2760 px of Strecha's cameras and 0.057° at KITTI's 707 px; where K is estimated it does not matter.
Measured with pycolmap 4.2.1 and K held, "corner" fits a little better: fountain-P11 has a median rotation error of
0.028° against 0.034°, Herz-Jesus-P8 0.099° against 0.109°, AUC(1°) gains 0.1 and 0.3 points.

References:
    Strecha, von Hansen, Van Gool, Fua & Thoennessen, On benchmarking camera calibration and multi-view stereo, 2008.
    Seitz, Curless, Diebel, Scharstein & Szeliski, A comparison of multi-view stereo algorithms, CVPR 2006.
    Snavely, Bundler v0.4 user's manual.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from sfm.core.cameras import Camera
from sfm.core.errors import FormatError, InputError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Reconstruction, Tracks

PixelOrigin = Literal["corner", "center"]

_IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".ppm", ".pgm"}


def read_strecha(folder: Path, *, pixel_origin: PixelOrigin = "corner") -> Reconstruction:
    """Cameras of Strecha's sets: a folder of `NAME.camera`, or one that has it as `gt_dense_cameras`."""
    nested = folder / "gt_dense_cameras"
    paths = sorted((nested if nested.is_dir() else folder).glob("*.camera"))
    if not paths:
        raise InputError("no .camera files here", path=folder)
    cameras, poses = [], []
    for path in paths:
        numbers = _numbers(path, 9 + 3 + 9 + 3 + 2)
        world_from_cam = Rigid3(_rotation(numbers[12:21]), numbers[21:24])
        width, height = int(numbers[24]), int(numbers[25])
        cameras.append(_pinhole(numbers[:9].reshape(3, 3), width, height, pixel_origin))
        poses.append(world_from_cam.inverse())
    return _reconstruction([path.name.removesuffix(".camera") for path in paths], cameras, poses)


def read_middlebury(
    path: Path, *, pixel_origin: PixelOrigin = "corner", turned: Collection[str] = ()
) -> Reconstruction:
    """Cameras of a `NAME_par.txt` of Middlebury's multi-view sets; the images lie beside it.

    Args:
        turned: names of images that this copy of the set holds turned by 180°, so that the object stands the same way
            up in all of them; the original has those of positive latitude upside down.
    """
    lines = _lines(path)
    count = int(lines[0])
    if len(lines) - 1 != count:
        raise FormatError(f"{count} cameras announced, {len(lines) - 1} found", path=path)
    names, cameras, poses = [], [], []
    for line in lines[1:]:
        name, *words = line.split()
        numbers = np.array(words, dtype=np.float64)
        if len(numbers) != 21:
            raise FormatError(f"expected 21 numbers after {name}, got {len(numbers)}", path=path)
        camera = _pinhole(numbers[:9].reshape(3, 3), *_image_size(path.parent / name), pixel_origin)
        pose = Rigid3(_rotation(numbers[9:18]), numbers[18:])
        names.append(name)
        cameras.append(_half_turn(camera) if name in turned else camera)
        poses.append(_HALF_TURN @ pose if name in turned else pose)
    return _reconstruction(names, cameras, poses)


def read_imc(folder: Path, *, images: Path | None = None) -> Reconstruction:
    """Cameras of an Image Matching Challenge scene: `calibration_NAME.h5` files and the images they belong to.

    Args:
        folder: of the files.
        images: folder of the photos; by default any folder beside `folder` that holds them.
    """
    import h5py

    paths = sorted(folder.glob("calibration_*.h5"))
    if not paths:
        raise InputError("no calibration_*.h5 files here", path=folder)
    photos = _images_below(images or folder.parent)
    names, cameras, poses = [], [], []
    for path in paths:
        stem = path.stem.removeprefix("calibration_")
        if stem not in photos:
            raise InputError(f"no image called {stem}", path=images or folder.parent)
        with h5py.File(path) as file:
            matrix, rotation, translation = (np.asarray(file[key], dtype=np.float64) for key in ("K", "R", "T"))
        names.append(photos[stem].name)
        cameras.append(_pinhole(matrix, *_image_size(photos[stem]), "corner"))
        poses.append(Rigid3(_rotation(rotation), translation.reshape(3)))
    return _reconstruction(names, cameras, poses)


def read_kitti(folder: Path, *, pixel_origin: PixelOrigin = "corner") -> Reconstruction:
    """Left camera of a KITTI odometry clip: `poses.txt`, `calib.txt` (its first row is P0) and `image_l`."""
    rows = _numbers(folder / "poses.txt", None).reshape(-1, 12)
    projection = _numbers(folder / "calib.txt", None)[:12].reshape(3, 4)
    paths = sorted(_images_below(folder / "image_l").values())
    if len(paths) != len(rows):
        raise FormatError(f"{len(rows)} poses for {len(paths)} images", path=folder / "poses.txt")
    camera = _pinhole(projection[:, :3], *_image_size(paths[0]), pixel_origin)
    poses = [Rigid3(_rotation(row[:, :3]), row[:, 3]).inverse() for row in rows.reshape(-1, 3, 4)]
    return _reconstruction([path.name for path in paths], [camera] * len(paths), poses)


def read_bundler(path: Path, *, images: Path | None = None) -> Reconstruction:
    """Cameras of a `bundle.out`; those with focal length 0 were not reconstructed and are absent.

    With y up and z backwards, Bundler's point (X, Y, Z) is (X, −Y, −Z) here, and its radial terms are unchanged.

    Args:
        images: folder of the photos, whose sorted names are the cameras' order; by default the nearest folder
            upwards of `path` that holds any.
    """
    lines = _lines(path)
    if not lines[0].startswith("# Bundle file"):
        raise FormatError("not a Bundler file", path=path)
    count = int(lines[1].split()[0])
    block = np.array([[float(word) for word in line.split()] for line in lines[2 : 2 + 5 * count]])
    if block.shape != (5 * count, 3):
        raise FormatError(f"{count} cameras announced, {len(block) / 5:g} found", path=path)
    photos = _image_order(path, images, count)
    flip = np.diag([1.0, -1.0, -1.0])
    names, cameras, poses = [], [], []
    for photo, rows in zip(photos, block.reshape(count, 5, 3), strict=True):
        focal, k1, k2 = rows[0]
        if focal == 0:
            continue
        width, height = _image_size(photo)
        names.append(photo.name)
        params = np.array([focal, width / 2, height / 2, k1, k2])
        cameras.append(Camera("RADIAL", width, height, params, has_prior_focal_length=True))
        poses.append(Rigid3(_rotation(flip @ rows[1:4]), flip @ rows[4]))
    return _reconstruction(names, cameras, poses)


def _reconstruction(names: Sequence[str], cameras: Sequence[Camera], poses: Sequence[Rigid3]) -> Reconstruction:
    """A model without points; equal cameras become one."""
    camera_ids: dict[tuple[object, ...], int] = {}
    keys = [(camera.model, camera.width, camera.height, *camera.params.tolist()) for camera in cameras]
    for key in keys:
        camera_ids.setdefault(key, len(camera_ids) + 1)
    by_id = {camera_ids[key]: camera for key, camera in zip(keys, cameras, strict=True)}
    count = len(names)
    return Reconstruction(
        cameras=by_id,
        image_ids=np.arange(1, count + 1, dtype=np.int32),
        image_names=tuple(names),
        image_camera_ids=np.array([camera_ids[key] for key in keys], dtype=np.int32),
        cams_from_world=Rigid3.stack(list(poses)),
        keypoint_offsets=np.zeros(count + 1, dtype=np.int64),
        keypoints=np.zeros((0, 2)),
        points3D=np.zeros((0, 3)),
        point_ids=np.zeros(0, dtype=np.int64),
        colors=np.zeros((0, 3), dtype=np.uint8),
        errors=np.zeros(0),
        tracks=Tracks.empty(),
    )


def _pinhole(matrix: np.ndarray, width: int, height: int, pixel_origin: PixelOrigin) -> Camera:
    """A PINHOLE camera of K; its skew must be zero."""
    if abs(matrix[0, 1]) > 1e-9 * matrix[0, 0]:
        raise InputError(f"a camera has skew {matrix[0, 1]:g}, which no camera model here expresses")
    half = 0.5 if pixel_origin == "center" else 0.0
    params = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2] + half, matrix[1, 2] + half])
    return Camera("PINHOLE", width, height, params, has_prior_focal_length=True)


_HALF_TURN = Rigid3(Rotation3(np.array([0.0, 0.0, 0.0, 1.0])), np.zeros(3))
"""A camera's frame after its image was turned by 180°: x and y change sign."""


def _half_turn(camera: Camera) -> Camera:
    """The PINHOLE camera of the image turned by 180°."""
    fx, fy, cx, cy = camera.params
    return dataclasses.replace(camera, params=np.array([fx, fy, camera.width - cx, camera.height - cy]))


def _rotation(matrix: np.ndarray) -> Rotation3:
    """The rotation nearest to nine printed numbers."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64).reshape(3, 3))
    return Rotation3.from_matrix(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)


def _lines(path: Path) -> list[str]:
    if not path.is_file():
        raise InputError("no such file", path=path)
    return [line.strip() for line in path.read_text().splitlines() if line.strip()]


def _numbers(path: Path, count: int | None) -> np.ndarray:
    numbers = np.array([float(word) for line in _lines(path) for word in line.split()])
    if count is not None and len(numbers) != count:
        raise FormatError(f"expected {count} numbers, got {len(numbers)}", path=path)
    return numbers


def _images_below(folder: Path) -> dict[str, Path]:
    """Images anywhere below a folder, by stem."""
    return {path.stem: path for path in sorted(folder.rglob("*")) if path.suffix.lower() in _IMAGE_SUFFIXES}


def _image_order(path: Path, images: Path | None, count: int) -> list[Path]:
    folders = [images] if images else list(path.resolve().parents)[:3]
    for folder in folders:
        photos = [photo for photo in sorted(folder.iterdir()) if photo.suffix.lower() in _IMAGE_SUFFIXES]
        if len(photos) == count:
            return photos
    raise InputError(f"no folder with its {count} images found", path=path, remedy="name it")


def _image_size(path: Path) -> tuple[int, int]:
    with Image.open(path) as image:
        return image.size
