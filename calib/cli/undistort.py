"""`calib undistort`: photos as a lens without distortion would have taken them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from calib.cli.parsing import Flag, parsed
from sfm.core.errors import ConfigError, ExitCode, FormatError, ImageError, InputError

if TYPE_CHECKING:
    import numpy as np

    from sfm.core.cameras import Camera

EXAMPLES = (
    "calib undistort camera.toml photos -o straight",
    "calib undistort camera.toml photos -o straight --crop valid --keep-exif",
    "calib undistort fisheye.toml photos -o straight --crop full --max-fov 140 --masks",
)


_LARGEST = 4e8
"""Pixels: where each of them comes from takes 16 bytes, and some more on the way."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class UndistortOptions:
    """Writes photos without their lens distortion, and the pinhole camera that they now have, camera.toml, beside them.

    The photos themselves are never touched. They must have the size that the camera was calibrated at. Grey photos stay
    grey, and 16 bits stay 16 bits.
    """

    camera: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAMERA", help_behavior_hint="")]
    """A camera.toml, or the calibration of another program that `calib convert` reads, with one camera."""

    images: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="IMAGES", help_behavior_hint="")]
    """Folders of photos, or photos."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER", help_behavior_hint="(required)")]
    """Where to; names stay."""

    model: Literal["pinhole"] = "pinhole"
    """The camera to make."""

    crop: Literal["inside", "full", "valid"] = "inside"
    """inside: as much as can be shown without a blank pixel; full: all of the photo, with blank borders; valid: the
    scale of the middle is kept, and blank borders are cut off."""

    focal: Annotated[float, tyro.conf.arg(metavar="PX", help_behavior_hint="")] = 0.0
    """The focal length, px of the photo, instead of the one that --crop chooses."""

    scale: Annotated[float, tyro.conf.arg(metavar="S", help_behavior_hint="(default: 1)")] = 1.0
    """Size of the result over that of the photo."""

    max_fov: Annotated[float, tyro.conf.arg(metavar="DEG", help_behavior_hint="(default: 110)")] = 110.0
    """No wider than this across or down; a pinhole stretches its corners without end towards 180."""

    masks: Flag = False
    """Writes masks/NAME.png too, black where the photo has nothing to show."""

    keep_exif: Flag = False
    """Copies what the photo says of itself: time, place, exposure. The profile of its colours is kept anyway."""

    threads: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 0)")] = 0
    """At most so many photos at once; 0 for all cores."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(UndistortOptions, "undistort", words, EXAMPLES)
    if not 0 < options.max_fov < 180:
        raise ConfigError(f"--max-fov must be between 0 and 180, got {options.max_fov}: a pinhole sees less than 180°")
    if not options.scale > 0 or options.focal < 0 or options.threads < 0:
        raise ConfigError("--scale must be positive, --focal and --threads must not be negative")
    import numpy as np

    from calib.cli.photos import find_photos
    from sfm.core.cameras.undistortion import undistortion_grid
    from sfm.core.execution import available_threads, ordered_map
    from sfm.io.atomic import check_writable, write_bytes
    from sfm.io.camera_files import write_camera_toml
    from sfm.io.image_encoding import encoded_image

    check_writable(options.output / "camera.toml")
    camera, photos = _camera(options.camera), find_photos(options.images)
    if any(path.resolve() == (options.output / name).resolve() for name, path in photos.items()):
        raise ConfigError("would write over the photos", path=options.output, remedy="choose another -o")
    target = _target(camera, options)
    map_x, map_y = undistortion_grid(camera, target)
    valid = (map_x >= 0) & (map_x <= camera.width) & (map_y >= 0) & (map_y <= camera.height)
    if not valid.any():
        raise InputError("no pixel of the result would show anything", remedy="choose another --focal")

    def straighten(item: tuple[str, Path]) -> str:
        name, path = item
        try:
            data = _straightened(path, camera, map_x, map_y, options.keep_exif)
        except ImageError as error:
            return str(error)
        write_bytes(options.output / name, data)
        if options.masks:
            mask = np.where(valid, np.uint8(255), np.uint8(0))
            write_bytes(options.output / "masks" / f"{name}.png", encoded_image(mask, Path(f"{name}.png")))
        return ""

    refused = [
        told for told in ordered_map(straighten, photos.items(), threads=options.threads or available_threads()) if told
    ]
    write_camera_toml(options.output / "camera.toml", target)
    for told in refused:
        print(f"left out: {told}")
    (fx, fy), (cx, cy) = target.focal_lengths, target.principal_point
    print(f"{len(photos) - len(refused)} of {len(photos)} photos in {options.output}")
    print(f"camera.toml: PINHOLE {target.width}x{target.height}, f {fx:.2f} {fy:.2f}, centre {cx:.2f} {cy:.2f} px")
    print(f"{1 - valid.mean():.1%} of the pixels are blank")
    return ExitCode.OK if len(refused) < len(photos) else ExitCode.BAD_INPUT


def _camera(path: Path) -> Camera:
    from sfm.io.camera_exchange import read_camera_set

    cameras = read_camera_set(path)[1]
    if len(cameras) != 1:
        raise FormatError(
            f"holds {len(cameras)} cameras",
            path=path,
            remedy=f"take one out: calib convert {path} -o camera.toml --camera {cameras.names[0]}",
        )
    return cameras.cameras[0]


def _target(camera: Camera, options: UndistortOptions) -> Camera:
    """The pinhole camera of the result, and a word where the field of view had to be limited."""
    import numpy as np

    from sfm.core.cameras import Camera
    from sfm.core.cameras.undistortion import undistorted_camera, undistortion_grid, valid_rectangle

    blank = {"inside": 0.0, "full": 1.0, "valid": None}[options.crop]
    target = undistorted_camera(camera, blank_pixels=blank, max_field_of_view=math.radians(options.max_fov))
    if options.focal:
        fx, fy = camera.focal_lengths
        _, _, cx, cy = target.params
        target = target.with_params(np.array([options.focal, options.focal * fy / fx, cx, cy]))
    seen = 2 * math.degrees(_widest_angle(camera))
    if seen > options.max_fov:
        print(f"the lens sees up to {seen:.0f}°, of which a pinhole of at most {options.max_fov:.0f}° across is made")
    if not target.width * options.scale * target.height * options.scale <= _LARGEST:
        size = " × ".join(f"{side * options.scale:.0f}" for side in (target.width, target.height))
        raise ConfigError(
            f"the result would have {size} px, more than {_LARGEST:.0e}", remedy="choose a smaller --scale"
        )
    width, height = (max(1, round(side * options.scale)) for side in (target.width, target.height))
    target = target.scaled(width, height)
    if options.crop != "valid":
        return target
    map_x, map_y = undistortion_grid(camera, target)
    valid = (map_x >= 0) & (map_x <= camera.width) & (map_y >= 0) & (map_y <= camera.height)
    left, top, right, bottom = valid_rectangle(valid)
    if right <= left or bottom <= top:
        raise InputError("nothing is left between the blank borders", remedy="use --crop inside")
    params = target.params - [0, 0, left, top]
    return Camera("PINHOLE", right - left, bottom - top, params, target.has_prior_focal_length)


def _widest_angle(camera: Camera) -> float:
    """The largest angle from the axis, radians, that any pixel on the border of the image has."""
    import numpy as np

    x, y = np.linspace(0, camera.width, 65), np.linspace(0, camera.height, 65)
    sides = [(x, 0 * x), (x, 0 * x + camera.height), (0 * y, y), (0 * y + camera.width, y)]
    rays, valid = camera.unproject(np.concatenate([np.stack(side, 1) for side in sides]))
    if not valid.all():  # beyond the rim of the model
        return camera.max_angle
    return float(np.arccos(np.clip(rays[:, 2], -1, 1)).max())


def _straightened(path: Path, camera: Camera, map_x: np.ndarray, map_y: np.ndarray, keep_exif: bool) -> bytes:
    from sfm.core.imaging.resample import remap
    from sfm.io.image_encoding import encoded_image, photo_facts
    from sfm.io.images import read_pixels

    image = read_pixels(path)
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise ImageError(
            f"has {width} × {height} px, the camera {camera.width} × {camera.height}",
            path=path,
            remedy="undistort photos at the size at which they were calibrated",
        )
    straight = remap(image, map_x, map_y)
    return encoded_image(straight, path, photo_facts(path, *straight.shape[1::-1], with_exif=keep_exif))
