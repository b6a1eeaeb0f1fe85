"""From a folder to the images and cameras of the database.

Every run looks at the folder anew. Images keep their ids as long as their names stay, new ones come after, and those
that are gone are forgotten with all that depends on them. A file is read again when its size or time has changed.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from sfm.core.cameras import Camera
from sfm.core.cameras.priors import infer_camera
from sfm.core.errors import ImageError, InputError
from sfm.core.events import ImageRead, Note, Observer, StageFinished, StageStarted
from sfm.core.execution import ordered_map
from sfm.io.bookkeeping import Decision, ImageSource
from sfm.io.camera_files import camera_names, read_intrinsics
from sfm.io.database import Database
from sfm.io.exif import ImageInfo, prior_focal_px, read_image_info
from sfm.io.images import check_size, list_images, read_image_bytes
from sfm.io.masks import check_mask_size, find_masks, masks_folder, photos_among
from sfm.pipeline.config import CameraConfig
from sfm.pipeline.image_features import MaskFile, SceneImage
from sfm.pipeline.intrinsics import assigned_cameras
from sfm.pipeline.keys import file_digest

_STAGE = "images"
_NAMED_AT_MOST = 5


@dataclasses.dataclass(frozen=True, slots=True)
class Scene:
    """The usable images by id, and the files that are not, each with its reason."""

    images: Mapping[int, SceneImage]
    skipped: Mapping[str, str]


@dataclasses.dataclass(frozen=True, slots=True)
class _Photo:
    name: str
    path: Path
    info: ImageInfo
    source: ImageSource


def read_scene(
    database: Database, folder: Path, config: CameraConfig, *, threads: int, observer: Observer, masks: str = ""
) -> Scene:
    """Looks at the photos, gives each a camera and its mask, and brings the database up to date.

    Args:
        masks: as `PipelineConfig.masks`.
    Raises:
        InputError: there are no usable photos, or masks that do not fit them.
        ConfigError: the given intrinsics do not fit them.
    """
    listing, masks_in = list_images(folder), masks_folder(folder, masks)
    names = photos_among(listing.names, folder, masks_in)
    observer(StageStarted(stage=_STAGE, total=len(names) + len(listing.skipped)))
    skipped = dict(listing.skipped)
    for name, reason in skipped.items():
        observer(ImageRead(name=name, reason=reason))
    photos: list[_Photo] = []
    known = {row.name: row.image_id for row in database.images()}
    sources = database.sources()

    def look(name: str) -> _Photo | ImageError:
        return _look(folder, name, sources.get(known.get(name, -1)))

    for name, photo in zip(names, ordered_map(look, names, threads=threads), strict=True):
        if isinstance(photo, ImageError):
            skipped[name] = photo.cause
        else:
            photos.append(photo)
        observer(ImageRead(name=name, reason=skipped.get(name, "")))
    if not photos:
        raise _no_photos(folder, skipped)
    if skipped:
        observer(Note(message=f"skipped {_named(skipped)}", level="warning"))
    groups = _given_groups(photos, config) if config.intrinsics else _groups(photos, config, observer)
    masks_of: dict[str, MaskFile] = {}
    if masks_in:
        try:
            masks_of = _masks(photos, folder, masks_in, observer)
        except InputError as error:
            # A folder beside the photos that nobody has named may belong to something else.
            if masks or masks_in.absolute().is_relative_to(folder.absolute()) or isinstance(error, ImageError):
                raise
            observer(Note(message=f"{masks_in} is left alone: {error.cause}", level="warning"))
    with database.transaction():
        images = _synchronize(database, photos, groups)
        database.clear_ledger(_STAGE)
        database.record(
            *(Decision(_STAGE, name, "usable", None, None, "skipped", why) for name, why in skipped.items())
        )
    cameras = len({image.camera_id for image in images.values()})
    told = f", skipped: {len(skipped)}" if skipped else ""
    observer(StageFinished(stage=_STAGE, summary=f"photos: {len(photos)}, cameras: {cameras}{told}"))
    images = {k: dataclasses.replace(image, mask=masks_of.get(image.name)) for k, image in images.items()}
    return Scene(images, dict(sorted(skipped.items())))


def _masks(photos: Sequence[_Photo], folder: Path, masks_in: Path, observer: Observer) -> dict[str, MaskFile]:
    """The mask of each photo that has one, in the size of the photo."""
    found = find_masks([photo.name for photo in photos], folder, masks_in)
    masks: dict[str, MaskFile] = {}
    for photo in photos:
        if photo.name in found:
            path = found[photo.name]
            check_mask_size(path, photo.name, photo.info.width, photo.info.height)
            masks[photo.name] = MaskFile(path, file_digest(path))
    without = [photo.name for photo in photos if photo.name not in masks]
    told = f"; without one: {_listed(without)}" if without else ""
    observer(Note(message=f"masks from {masks_in}: {len(masks)}{told}", level="warning" if without else "info"))
    return masks


def _look(folder: Path, name: str, known: ImageSource | None) -> _Photo | ImageError:
    """Facts and content of one file; a complete reading only where it is new or changed."""
    path = folder / name
    try:
        status = path.stat()
        info = read_image_info(path)
        check_size(info.width, info.height, path)
        if known and (known.size, known.mtime_ns) == (status.st_size, status.st_mtime_ns):
            return _Photo(name, path, info, known)
        digest = hashlib.blake2b(read_image_bytes(path), digest_size=16).hexdigest()
    except ImageError as error:
        return error
    except OSError as error:
        return ImageError((error.strerror or str(error)).lower(), path=path)
    return _Photo(name, path, info, ImageSource(digest, status.st_size, status.st_mtime_ns, info.orientation))


def _groups(photos: Sequence[_Photo], config: CameraConfig, observer: Observer) -> list[tuple[Camera, list[str]]]:
    """Photos that share a camera, and what is known of it beforehand."""
    members: dict[Hashable, list[_Photo]] = {}
    for photo in photos:
        members.setdefault((_sharing_key(photo, config.sharing), photo.info.width, photo.info.height), []).append(photo)
    if config.sharing == "single" and len(members) > 1:
        sizes = ", ".join(f"{width}×{height}" for _, width, height in members)  # type: ignore[misc]
        message = f"the photos differ in size ({sizes} px): one camera for each size, not a single one"
        observer(Note(message=message, level="warning"))
    return [(_inferred_camera(group, config.model), [photo.name for photo in group]) for group in members.values()]


def _sharing_key(photo: _Photo, sharing: str) -> Hashable:
    info = photo.info
    match sharing:
        case "single":
            return ""
        case "folder":
            return str(PurePosixPath(photo.name).parent)
        case "image":
            return photo.name
    return info.make, info.model, info.focal_mm, info.focal_35mm


def _inferred_camera(group: Sequence[_Photo], model: str) -> Camera:
    info = group[0].info
    focals = [focal for photo in group if (focal := prior_focal_px(photo.info))]
    return infer_camera(model, info.width, info.height, float(np.median(focals)) if focals else None)


def _given_groups(photos: Sequence[_Photo], config: CameraConfig) -> list[tuple[Camera, list[str]]]:
    """Photos by given camera; one that serves several sizes is a camera for each."""
    cameras = read_intrinsics(config.intrinsics)
    sizes = [(photo.name, photo.info.width, photo.info.height) for photo in photos]
    groups: dict[Hashable, tuple[Camera, list[str]]] = {}
    assigned = assigned_cameras(cameras, sizes, config.intrinsics, camera_names(config.intrinsics))
    for name, (camera_id, camera) in assigned.items():
        groups.setdefault((camera_id, camera.width, camera.height), (camera, []))[1].append(name)
    return list(groups.values())


def _synchronize(
    database: Database, photos: Sequence[_Photo], groups: Sequence[tuple[Camera, list[str]]]
) -> dict[int, SceneImage]:
    """Makes the database's images and cameras those of the folder."""
    by_name = {photo.name: photo for photo in photos}
    for row in database.images():
        if row.name not in by_name:
            database.delete_image(row.image_id)
    rows = {row.name: row for row in database.images()}
    camera_of = _camera_ids(database, groups, {name: row.camera_id for name, row in rows.items()})
    cameras = database.cameras()
    images: dict[int, SceneImage] = {}
    for name, photo in by_name.items():
        camera_id = camera_of[name]
        if name not in rows:
            image_id = database.add_image(name, camera_id)
        else:
            image_id = rows[name].image_id
            if rows[name].camera_id != camera_id:
                database.assign_camera(image_id, camera_id)
        database.write_source(image_id, photo.source)
        images[image_id] = SceneImage(image_id, name, photo.path, photo.source.digest, camera_id, cameras[camera_id])
    database.delete_unused_cameras()
    return dict(sorted(images.items()))


def _camera_ids(
    database: Database, groups: Sequence[tuple[Camera, list[str]]], camera_ids: Mapping[str, int]
) -> dict[str, int]:
    """The camera of each photo; a group keeps the camera that its first known photo has had."""
    result: dict[str, int] = {}
    taken: set[int] = set()
    for camera, names in groups:
        camera_id = next((camera_ids[name] for name in names if name in camera_ids), None)
        if camera_id is None or camera_id in taken:
            camera_id = database.add_camera(camera)
        else:
            database.update_camera(camera_id, camera)
        taken.add(camera_id)
        result |= dict.fromkeys(names, camera_id)
    return result


def _no_photos(folder: Path, skipped: Mapping[str, str]) -> InputError:
    if not skipped:
        return InputError("there are no photos in this folder", path=folder, remedy="name the folder that holds them")
    return InputError(f"none of {len(skipped)} files is a usable photo ({_named(skipped)})", path=folder)


def _listed(names: Sequence[str]) -> str:
    more = f", +{len(names) - _NAMED_AT_MOST} more" if len(names) > _NAMED_AT_MOST else ""
    return ", ".join(names[:_NAMED_AT_MOST]) + more


def _named(skipped: Mapping[str, str]) -> str:
    named = "; ".join(f"{name}: {why}" for name, why in list(skipped.items())[:_NAMED_AT_MOST])
    return named + (f"; +{len(skipped) - _NAMED_AT_MOST} more, see the log" if len(skipped) > _NAMED_AT_MOST else "")
