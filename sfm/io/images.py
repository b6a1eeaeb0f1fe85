"""Image files: what is there, and their pixels.

Pixels stay in the frame of the sensor: the EXIF orientation is known (`exif.read_image_info`) but never applied, so
that photos of one camera share one calibration however it was held. TIFFs are the exception: both decoders turn them.

JPEGs are always decoded at full size. The decoder's built-in halving rounds the size up, so that its scale is not
the ratio of the sizes and keypoints would move by up to half a pixel towards the far edge; it also filters
differently from block to block. The few milliseconds do not pay for that.
"""

from __future__ import annotations

import dataclasses
import os
import re
import zlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from sfm.core.arrays import ImageU8
from sfm.core.errors import ImageError, InputError
from sfm.io.atomic import os_errors

MIN_SIDE_PX = 16
"""Below this an image holds no feature that could be matched."""

_RECOVER = "copy or export the photo again, or remove it"
_CONVERT = "convert it to JPEG, PNG or TIFF"

_MAGIC: tuple[tuple[str, bytes], ...] = (
    ("jpeg", rb"\xff\xd8\xff"),
    ("png", rb"\x89PNG\r\n\x1a\n"),
    ("tiff", rb"II[*+]\0|MM\0[*+]"),
    ("webp", rb"RIFF....WEBP"),
    ("bmp", rb"BM.{4}\0{4}"),
    ("jpeg2000", rb"\0\0\0\x0cjP  \r\n\x87\n|\xff\x4f\xff\x51"),
    ("pnm", rb"P[2356]\s"),
)
_NOT_DECODED: tuple[tuple[str, bytes], ...] = (
    ("a HEIF/AVIF picture", rb"....ftyp(heic|heix|hevc|heim|heis|mif1|msf1|avif)"),
    ("a GIF", rb"GIF8[79]a"),
    ("a PDF", rb"%PDF"),
    ("a video", rb"....ftyp|\x1aE\xdf\xa3|RIFF....AVI "),
    ("a zip archive", rb"PK\x03\x04"),
)


@dataclasses.dataclass(frozen=True, slots=True)
class ImageListing:
    """What a folder holds: names relative to it with forward slashes, in natural order.

    `skipped` are the files that are no images, each with the reason.
    """

    names: tuple[str, ...]
    skipped: tuple[tuple[str, str], ...] = ()


def natural_key(name: str) -> tuple[tuple[tuple[int, int | str], ...], str]:
    """A sort key in which `img2` comes before `img10`; capital letters do not matter unless all else is equal."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return tuple((0, int(part)) if part.isdecimal() else (1, part) for part in parts if part), name


def list_images(folder: Path | str) -> ImageListing:
    """Finds the images in a folder and below it, by their content rather than by their suffix.

    Hidden files and folders are passed over. Links are followed, each folder is visited once.

    Raises:
        InputError: `folder` is missing, is no folder or may not be read.
    """
    folder = Path(folder)
    _check_folder(folder)
    names, skipped = [], {}
    for path in _files(folder):
        name = path.relative_to(folder).as_posix()
        reason = _why_not_listed(path, name)
        if reason:
            # What cannot be encoded must not break the log either.
            skipped[name.encode(errors="replace").decode()] = reason
        else:
            names.append(name)
    return ImageListing(
        tuple(sorted(names, key=natural_key)), tuple((name, skipped[name]) for name in sorted(skipped, key=natural_key))
    )


def read_image(path: Path | str, *, gray: bool = False) -> ImageU8:
    """The pixels of an image in the frame of its sensor, (H, W, 3) RGB or (H, W) grey, uint8.

    Of a file with several pictures the first is read. Transparency is dropped: the colours beneath are what the
    camera saw. More than 8 bits are scaled to 8, taking the whole range of the smallest of 8, 10, 12, 14 and 16 bits
    that holds the brightest pixel, since cameras store 12 bits in files of 16; floats must lie in [0, 1]. A
    truncated file is refused although much of it could be decoded, since the rest would be flat grey with a sharp edge.

    Raises:
        ImageError: the file is missing, empty, truncated, no image, or below `MIN_SIDE_PX`.
    """
    path = Path(path)
    colour = cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR
    image = _to_8_bits(_decode(read_image_bytes(path), path, colour), path)
    height, width = image.shape[:2]
    check_size(width, height, path)
    return image if gray else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_pixels(path: Path | str) -> np.ndarray:
    """As `read_image`, but grey or RGB, and of 8 or 16 bits, as the file is.

    Raises:
        ImageError: as there.
    """
    path = Path(path)
    image = _decode(read_image_bytes(path), path, cv2.IMREAD_ANYCOLOR)
    image = image if image.dtype == np.uint16 else _to_8_bits(image, path)
    height, width = image.shape[:2]
    check_size(width, height, path)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def check_size(width: int, height: int, path: Path) -> None:
    """Raises ImageError where an image is too small to hold features."""
    if min(height, width) < MIN_SIDE_PX:
        raise ImageError(
            f"{width} × {height} px is too small", path=path, remedy=f"at least {MIN_SIDE_PX} px a side are needed"
        )


def read_image_bytes(path: Path) -> bytes:
    """The bytes of a file that is a complete image.

    Raises:
        ImageError: it is missing, empty, no image or truncated.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageError((error.strerror or str(error)).lower(), path=path, remedy="check its permissions") from error
    reason = _why_no_image(data[:64])
    if reason:
        raise ImageError(reason, path=path, remedy=_RECOVER if not data else _CONVERT)
    if not _is_complete(data):
        raise ImageError("is truncated", path=path, remedy=_RECOVER)
    return data


# Listing


def _check_folder(folder: Path) -> None:
    if not folder.exists():
        raise InputError("there is no such folder", path=folder, remedy="check the spelling of the path")
    if not folder.is_dir():
        raise InputError("is a file, not a folder", path=folder, remedy="name the folder that holds the photos")
    with os_errors(folder), os.scandir(folder):
        pass


def _files(folder: Path) -> Iterator[Path]:
    seen: set[str] = set()
    refused: list[OSError] = []
    for where, folders, files in os.walk(folder, followlinks=True, onerror=refused.append):
        real = os.path.realpath(where)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        yield from (Path(where, name) for name in files if not name.startswith("."))
    yield from (Path(error.filename) for error in refused)


def _why_not_listed(path: Path, name: str) -> str:
    try:
        name.encode()
    except UnicodeEncodeError:
        return "its name is not valid UTF-8; rename it"
    if any(character in name for character in "\n\r\t"):
        return "its name holds a line break or a tab; rename it"
    if path.is_dir():
        return "is a folder that may not be read"
    if not path.is_file():
        return "is no regular file"
    try:
        with path.open("rb") as file:
            return _why_no_image(file.read(64))
    except OSError as error:
        return (error.strerror or str(error)).lower()


def _kind(head: bytes) -> str | None:
    return next((kind for kind, magic in _MAGIC if re.match(magic, head, re.DOTALL)), None)


def _why_no_image(head: bytes) -> str:
    """Why the first bytes of a file are not those of an image that can be decoded; empty if they are."""
    if not head:
        return "is empty"
    if _kind(head):
        return ""
    for what, magic in _NOT_DECODED:
        if re.match(magic, head, re.DOTALL):
            return f"is {what}, which cannot be read"
    is_text = not re.search(rb"[\x00-\x08\x0e-\x1f]", head)
    return "is a text file, not an image" if is_text else "is not an image"


# Completeness


def _is_complete(data: bytes) -> bool:
    """Whether the file ends where its format says, for the formats of which decoders have returned part of an image."""
    match _kind(data[:64]):
        case "jpeg":
            return _jpeg_is_complete(data)
        case "png":
            return _png_is_complete(data)
    return True


# In the entropy-coded data of a JPEG, FF is followed by a stuffed 00, a restart marker D0–D7 or fill bytes FF.
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9


def _jpeg_is_complete(data: bytes) -> bool:
    """Walks the segments and scans up to the end-of-image marker.

    A mere search for that marker would find the one of the EXIF thumbnail, and looking only at the last bytes would
    refuse the files of cameras that append data of their own.
    """
    position = 2
    while found := _MARKER.search(data, position):
        marker, position = data[found.start() + 1], found.end()
        if marker == _END_OF_IMAGE:
            return True
        position += int.from_bytes(data[position : position + 2], "big") or len(data)
    return False


def _png_is_complete(data: bytes) -> bool:
    """Walks the chunks up to the last one, and compares their checksums."""
    position = 8
    while position + 12 <= len(data):
        end = position + 8 + int.from_bytes(data[position : position + 4], "big")
        kind = data[position + 4 : position + 8]
        if data[end : end + 4] != zlib.crc32(memoryview(data)[position + 4 : end]).to_bytes(4, "big"):
            return False
        if kind == b"IEND":
            return True
        position = end + 4
    return False


# Decoding


@lru_cache(maxsize=1)
def _silence_decoder() -> None:
    """OpenCV would print its own account of a broken file to the screen, beside the line that we raise."""
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def _decode(data: bytes, path: Path, colour: int) -> np.ndarray:
    _silence_decoder()
    try:
        image = cv2.imdecode(
            np.frombuffer(data, np.uint8), colour | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except (cv2.error, MemoryError) as error:
        raise ImageError(f"cannot be decoded: {_first_line(error)}", path=path, remedy=_CONVERT) from error
    if image is None or not image.size:
        raise ImageError("is corrupt or of an unknown kind", path=path, remedy=_RECOVER)
    return image


def _first_line(error: Exception) -> str:
    if "CV_IO_MAX_IMAGE" in str(error):  # its own words are those of a programmer
        return "it has more than 2³⁰ pixels or 2²⁰ in a row or column"
    return (str(error).strip().splitlines() or ["out of memory"])[0]


def _to_8_bits(image: np.ndarray, path: Path) -> np.ndarray:
    if image.dtype == np.uint8:
        return image
    top = image.max()
    if image.dtype == np.uint16:
        white = next(2**bits - 1 for bits in (8, 10, 12, 14, 16) if top < 2**bits)
    elif image.dtype in (np.float32, np.float64) and image.min() >= 0 and top <= 1:
        white = 1
    else:
        raise ImageError(f"has {image.dtype} pixels beyond [0, 1]", path=path, remedy="convert it to 8 or 16 bits")
    return cv2.convertScaleAbs(image, alpha=255 / white)
