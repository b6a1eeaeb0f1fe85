"""Given intrinsics: which camera of a file took which image, and cameras of a resized image.

A file with one camera stands for all images. Cameras of a rig have names: an image in a folder that is called as one of
them, or whose own name begins so (left/07.png, left07.png), takes that one. Otherwise a file with several serves by
size: an image takes the camera of its own size, or failing that the one whose size is a pure multiple of its own. Where
several cameras fit alike, their number must be that of the images, and they are taken in order: camera ids ascending,
image names sorted as text.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePosixPath

from sfm.core.cameras import Camera
from sfm.core.errors import ConfigError


def assigned_cameras(
    cameras: Mapping[int, Camera], images: Sequence[tuple[str, int, int]], path: str, names: Mapping[int, str] = {}
) -> dict[str, tuple[int, Camera]]:
    """For each image its camera's id in the file, and the camera at the image's size.

    Args:
        cameras: by id, not empty.
        images: name, width and height in px.
        path: the file, for messages.
        names: of the cameras by id, where the file tells them.
    Raises:
        ConfigError: no camera fits an image, or several do; or a focal length is not positive.
    """
    for camera_id, camera in cameras.items():
        if min(camera.focal_lengths) <= 0:
            raise ConfigError(f"camera {camera_id} has a focal length that is not positive", path=path)
    called = {name: k for name, _, _ in images if (k := _called(name, names)) is not None}
    if called:
        return {
            name: (called[name], _resized(cameras[called[name]], name, width, height, path))
            if name in called
            else _by_size(cameras, name, width, height, path, names)
            for name, width, height in images
        }
    fits = [len(_fitting(cameras, width, height)) for _, width, height in images]
    if len(cameras) != len(images) or max(fits, default=1) == 1:
        return {name: _by_size(cameras, name, width, height, path, names) for name, width, height in images}
    in_order = zip(sorted(images), sorted(cameras.items()), strict=True)
    return {
        name: (camera_id, _resized(camera, name, width, height, path))
        for (name, width, height), (camera_id, camera) in in_order
    }


def resized_camera(camera: Camera, width: int, height: int) -> Camera | None:
    """The camera of images that were resized to `width` × `height` px as a whole; None where they cannot have been."""
    if (width, height) == (camera.width, camera.height):
        return camera
    if not _is_multiple(camera, width, height):
        return None
    return camera.scaled(width, height)


def _is_multiple(camera: Camera, width: int, height: int) -> bool:
    """Whether one factor, with each side rounded to whole px, leads from the camera's size to the image's."""
    lowest = max((width - 1) / camera.width, (height - 1) / camera.height)
    highest = min((width + 1) / camera.width, (height + 1) / camera.height)
    return lowest < highest


def _fitting(cameras: Mapping[int, Camera], width: int, height: int) -> list[tuple[int, Camera]]:
    """The cameras of an image's size, or failing that, those whose size is a multiple of it, resized."""
    exact = [(k, camera) for k, camera in cameras.items() if (camera.width, camera.height) == (width, height)]
    return exact or [(k, r) for k, camera in cameras.items() if (r := resized_camera(camera, width, height))]


def _called(image: str, names: Mapping[int, str]) -> int | None:
    """The camera whose name a folder of the image has, else the one that its own name begins with; None if not one."""
    path = PurePosixPath(image.lower())
    folders = [k for k, name in names.items() if name.lower() in path.parent.parts]
    if len(folders) == 1:
        return folders[0]
    begins = [k for k, name in names.items() if _begins(path.name, name.lower())]
    return begins[0] if len(begins) == 1 else None


def _begins(text: str, name: str) -> bool:
    """Whether it does, and goes on with something else: left7 and left_a begin with left, lefty does not."""
    if not name or not text.startswith(name):
        return False
    ends, goes_on = name[-1], text[len(name) : len(name) + 1]
    return not (ends.isdigit() and goes_on.isdigit()) and not (ends.isalpha() and goes_on.isalpha())


def _by_size(
    cameras: Mapping[int, Camera], name: str, width: int, height: int, path: str, names: Mapping[int, str]
) -> tuple[int, Camera]:
    fitting = _fitting(cameras, width, height)
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        raise _no_camera(cameras.values(), name, width, height, path)
    remedy = "give one camera, one for each image in the order of the names, or cameras of different sizes"
    if names:
        remedy = f"put the photos of each camera in a folder of its name: {', '.join(names.values())}"
    told = f"{len(fitting)} of its {len(cameras)} cameras fit {name} of {width}×{height} px"
    raise ConfigError(told, path=path, remedy=remedy)


def _resized(camera: Camera, name: str, width: int, height: int, path: str) -> Camera:
    resized = resized_camera(camera, width, height)
    if resized is None:
        raise _no_camera([camera], name, width, height, path)
    return resized


def _no_camera(cameras: Iterable[Camera], name: str, width: int, height: int, path: str) -> ConfigError:
    sizes = ", ".join(sorted({f"{camera.width}×{camera.height}" for camera in cameras}))
    return ConfigError(
        f"its intrinsics are for {sizes} px, but {name} has {width}×{height} px",
        path=path,
        remedy="intrinsics can be scaled, but not to another shape: give those of the uncropped, unrotated images",
    )
