"""What a photo says of itself: size, orientation, camera, focal length, place and time.

The focal length in px that EXIF allows, in the order of trust:

    f = f₃₅ · √(w² + h²) / √(36² + 24²)          the 35 mm equivalent is defined by the diagonal
    f = f_mm · max(w, h) / sensor width          where a table knows the sensor
    f = f_mm · p · max(w, h) / max(w_exif, h_exif)     p px/mm on the sensor, for images of the size w_exif × h_exif
"""

from __future__ import annotations

import dataclasses
import math
import threading
import warnings
from datetime import datetime
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from sfm.core.cameras.priors import focal_from_35mm, focal_from_sensor
from sfm.core.cameras.sensors import sensor_width_mm
from sfm.core.errors import ImageError
from sfm.io.images import read_image, read_image_bytes

_RESOLUTION_UNIT_MM = {1: 25.4, 2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
# Between a fisheye's and an astronomer's lens; beyond, the tags are wrong.
_FOCAL_RANGE = (0.1, 100.0)

# `catch_warnings` changes the state of the whole process.
_WARNINGS = threading.Lock()


@dataclasses.dataclass(frozen=True, slots=True)
class ImageInfo:
    """Facts about an image file; what it does not say is None or empty.

    Attributes:
        width, height: px in the frame of the sensor, that is before `orientation` is applied.
        orientation: the EXIF value, 1 (upright) to 8.
        focal_mm, focal_35mm: the focal length, and its 35 mm equivalent, in mm.
        sensor_px_per_mm: resolution on the sensor along x, for images of the size `exif_size`.
        exif_size: (width, height) in px that the camera wrote; another size means that the image was scaled.
        gps: latitude and longitude in degrees, WGS84; altitude_m above the ellipsoid or the sea, as the camera knows.
        captured: local time, without a zone unless the camera wrote one.
    """

    width: int
    height: int
    orientation: int = 1
    make: str = ""
    model: str = ""
    focal_mm: float | None = None
    focal_35mm: float | None = None
    sensor_px_per_mm: float | None = None
    exif_size: tuple[int, int] | None = None
    gps: tuple[float, float] | None = None
    altitude_m: float | None = None
    captured: datetime | None = None
    exposure_s: float | None = None
    f_number: float | None = None
    iso: float | None = None


def read_image_info(path: Path | str) -> ImageInfo:
    """Reads the facts without decoding the pixels; EXIF that is missing or corrupt leaves them open.

    Raises:
        ImageError: the file is no image.
    """
    path = Path(path)
    try:
        with _WARNINGS, warnings.catch_warnings():
            # Pillow warns of every oddity in EXIF and of large images; neither is of use to anyone here.
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                tags = ({}, {}, {}) if image.format == "PNG" and _lacks_exif(path) else _tags(image)
                info = _info(*image.size, *tags)
                # Pillow and OpenCV turn the pixels of a TIFF themselves, whatever they are told.
                return dataclasses.replace(info, orientation=1) if image.format == "TIFF" else info
    except (Image.UnidentifiedImageError, Image.DecompressionBombError):
        # Known to OpenCV but not to Pillow (e.g. a TIFF of three 16-bit channels), or beyond its limit of pixels.
        read_image_bytes(path)
        height, width = read_image(path, gray=True).shape
        return ImageInfo(width, height)
    except (OSError, ValueError, SyntaxError) as error:
        cause = (getattr(error, "strerror", None) or str(error)).lower()
        raise ImageError(f"cannot be read: {cause}", path=path, remedy="copy or export the photo again") from error


def prior_focal_px(info: ImageInfo) -> float | None:
    """The focal length in px that EXIF gives for an image of this size, or None."""
    longer = max(info.width, info.height)
    for focal in (_from_35mm(info), _from_sensor_table(info), _from_sensor_resolution(info)):
        if focal is not None and _FOCAL_RANGE[0] < focal / longer < _FOCAL_RANGE[1]:
            return focal
    return None


def _from_35mm(info: ImageInfo) -> float | None:
    return info.focal_35mm and focal_from_35mm(info.focal_35mm, info.width, info.height)


def _from_sensor_table(info: ImageInfo) -> float | None:
    width_mm = sensor_width_mm(info.make, info.model) if info.focal_mm else None
    return focal_from_sensor(info.focal_mm, width_mm, info.width, info.height) if info.focal_mm and width_mm else None


def _from_sensor_resolution(info: ImageInfo) -> float | None:
    if not info.focal_mm or not info.sensor_px_per_mm:
        return None
    longer = max(info.width, info.height)
    return info.focal_mm * info.sensor_px_per_mm * longer / max(info.exif_size or (longer,))


# Tags


def _lacks_exif(path: Path) -> bool:
    """Whether a PNG has none of the chunks that hold EXIF. They may follow the pixels, which Pillow decodes first."""
    data = path.read_bytes()
    return b"eXIf" not in data and b"Raw profile type" not in data


def _tags(image: Image.Image) -> tuple[dict[int, Any], dict[int, Any], dict[int, Any]]:
    """The base, EXIF and GPS directories; empty where they are corrupt."""
    try:
        base = image.getexif()
    except Exception:  # Pillow's parser meets arbitrary bytes, and no list of what it raises is complete.
        return {}, {}, {}
    return dict(base), _directory(base, ExifTags.IFD.Exif), _directory(base, ExifTags.IFD.GPSInfo)


def _directory(base: Image.Exif, which: ExifTags.IFD) -> dict[int, Any]:
    try:
        return dict(base.get_ifd(which))
    except Exception:  # As above.
        return {}


def _info(width: int, height: int, base: dict[int, Any], exif: dict[int, Any], gps: dict[int, Any]) -> ImageInfo:
    orientation = base.get(ExifTags.Base.Orientation)
    unit_mm = _RESOLUTION_UNIT_MM.get(exif.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))
    resolution = _positive(exif.get(ExifTags.Base.FocalPlaneXResolution))
    exif_width = _positive(exif.get(ExifTags.Base.ExifImageWidth))
    exif_height = _positive(exif.get(ExifTags.Base.ExifImageHeight))
    return ImageInfo(
        width,
        height,
        orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1,
        make=_text(base.get(ExifTags.Base.Make)),
        model=_text(base.get(ExifTags.Base.Model)),
        focal_mm=_positive(exif.get(ExifTags.Base.FocalLength)),
        focal_35mm=_positive(exif.get(ExifTags.Base.FocalLengthIn35mmFilm)),
        sensor_px_per_mm=resolution / unit_mm if resolution and unit_mm else None,
        exif_size=(int(exif_width), int(exif_height)) if exif_width and exif_height else None,
        gps=_position(gps),
        altitude_m=_altitude(gps),
        captured=_time(exif.get(ExifTags.Base.DateTimeOriginal), exif.get(ExifTags.Base.OffsetTimeOriginal)),
        exposure_s=_positive(exif.get(ExifTags.Base.ExposureTime)),
        f_number=_positive(exif.get(ExifTags.Base.FNumber)),
        iso=_positive(exif.get(ExifTags.Base.ISOSpeedRatings)),
    )


def _number(value: Any) -> float | None:
    """A finite float, or None; rationals with denominator 0, text and the like occur."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, ZeroDivisionError, IndexError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _positive(value: Any) -> float | None:
    number = _number(value)
    return number if number is not None and number > 0 else None


def _text(value: Any) -> str:
    if isinstance(value, bytes):
        value = value.decode(errors="replace")
    return value.split("\0")[0].strip() if isinstance(value, str) else ""


def _time(value: Any, zone: Any) -> datetime | None:
    stamp = _text(value)
    for text, layout in ((stamp + _text(zone), "%Y:%m:%d %H:%M:%S%z"), (stamp, "%Y:%m:%d %H:%M:%S")):
        try:
            return datetime.strptime(text, layout)
        except ValueError:
            continue
    return None


def _position(gps: dict[int, Any]) -> tuple[float, float] | None:
    latitude = _angle(gps.get(ExifTags.GPS.GPSLatitude), gps.get(ExifTags.GPS.GPSLatitudeRef), "S")
    longitude = _angle(gps.get(ExifTags.GPS.GPSLongitude), gps.get(ExifTags.GPS.GPSLongitudeRef), "W")
    if latitude is None or longitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return None
    # Zero zero is what a receiver without a fix writes.
    return None if latitude == longitude == 0 else (latitude, longitude)


def _angle(value: Any, reference: Any, negative: str) -> float | None:
    try:
        parts = [_number(part) for part in value]
    except TypeError:
        return None
    if len(parts) != 3 or parts[0] is None:
        return None
    degrees = parts[0] + (parts[1] or 0.0) / 60 + (parts[2] or 0.0) / 3600
    return -degrees if _text(reference).upper() == negative else degrees


def _altitude(gps: dict[int, Any]) -> float | None:
    altitude = _number(gps.get(ExifTags.GPS.GPSAltitude))
    below = gps.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\1")
    return -altitude if altitude is not None and below else altitude
