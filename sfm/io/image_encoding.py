"""Images as files of their old kind, with what the photo said of itself.

EXIF travels without what it says of the old pixels: their size, their place in the file, a thumbnail. Orientation
stays, since pixels stay in the frame of the sensor; of a TIFF it goes, as decoders have turned it (see `images`).
"""

from __future__ import annotations

import dataclasses
import io
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from sfm.core.errors import ImageError

if TYPE_CHECKING:
    from PIL import Image

_KINDS = {".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF", ".webp": "WEBP"}
_BARE = (".bmp", ".pgm", ".ppm", ".pnm")
"""Kinds without a place for EXIF or colour profiles."""
_HOW = {"JPEG": {"quality": 95, "subsampling": 0}, "WEBP": {"lossless": True}}
_ORIENTATION, _EXIF, _GPS = 274, 34665, 34853
_TOLD = (270, 271, 272, _ORIENTATION, 282, 283, 296, 305, 306, 315, 33432)
"""Description, maker, model, orientation, resolution, program, time, artist, copyright."""
_WIDTH, _HEIGHT = 40962, 40963


@dataclasses.dataclass(frozen=True, slots=True)
class PhotoFacts:
    """What a file says of its photo: EXIF of the image that it becomes, and the profile of its colours."""

    exif: bytes = b""
    icc_profile: bytes = b""


def photo_facts(path: Path, width: int, height: int, *, with_exif: bool) -> PhotoFacts:
    """Of a photo that becomes an image of this size; what cannot be read is left out."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as photo:
            profile = photo.info.get("icc_profile") or b""
            return PhotoFacts(_exif(photo, width, height) if with_exif else b"", profile)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError):
        return PhotoFacts()


def encoded_image(image: np.ndarray, path: Path, facts: PhotoFacts = PhotoFacts()) -> bytes:
    """The bytes of a grey or RGB image of 8 or 16 bits, of the kind that the suffix of `path` names.

    JPEG at a quality of 95 with colours at full size; all else without loss.

    Raises:
        ImageError: images of this kind are not written, or it has no place for 16 bits or for EXIF.
    """
    suffix = path.suffix.lower()
    if suffix in _BARE:
        return _by_opencv(image, ".bmp" if suffix == ".bmp" else ".ppm" if image.ndim == 3 else ".pgm")
    kind = _KINDS.get(suffix)
    if kind is None:
        known = ", ".join((*_KINDS, *_BARE))
        raise ImageError(f"images of the kind {suffix!r} are not written", path=path, remedy=f"known are {known}")
    if image.dtype == np.uint8 or (kind == "TIFF" and image.ndim == 2):
        return _by_pillow(image, kind, facts)
    if kind == "PNG":
        return _with_facts(_by_opencv(image, ".png"), facts)
    if kind != "TIFF":
        raise ImageError(f"has {8 * image.itemsize} bits, and {kind} 8", path=path, remedy="convert it to PNG or TIFF")
    if facts.exif:
        remedy = "leave --keep-exif out, or convert it to PNG"
        raise ImageError("a TIFF of 16 bits a colour is not written with EXIF", path=path, remedy=remedy)
    return _by_opencv(image, ".tif")


def _exif(photo: Image.Image, width: int, height: int) -> bytes:
    from PIL import Image

    given, kept = photo.getexif(), Image.Exif()
    for tag in _TOLD:
        if tag in given and not (tag == _ORIENTATION and photo.format == "TIFF"):
            kept[tag] = given[tag]
    now = {_WIDTH: width, _HEIGHT: height}
    for tag in (_EXIF, _GPS):
        if inner := given.get_ifd(tag):
            kept.get_ifd(tag).update({name: now.get(name, value) for name, value in inner.items()})
    return kept.tobytes() if given else b""


def _by_pillow(image: np.ndarray, kind: str, facts: PhotoFacts) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    how: dict[str, object] = dict(_HOW.get(kind, {}))
    if kind == "TIFF" and not facts.exif:  # Pillow 13 fails to compress where there is EXIF
        how["compression"] = "tiff_lzw"
    how |= {name: value for name in ("exif", "icc_profile") if (value := getattr(facts, name))}
    Image.fromarray(image).save(buffer, kind, **how)
    return buffer.getvalue()


def _by_opencv(image: np.ndarray, suffix: str) -> bytes:
    picture = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    return cv2.imencode(suffix, picture)[1].tobytes()


def _with_facts(png: bytes, facts: PhotoFacts) -> bytes:
    """A PNG with chunks behind its header, which is 33 bytes from the start."""
    chunks = b""
    if facts.icc_profile:
        chunks += _chunk(b"iCCP", b"profile\0\0" + zlib.compress(facts.icc_profile))
    if facts.exif:
        chunks += _chunk(b"eXIf", facts.exif.removeprefix(b"Exif\0\0"))
    return png[:33] + chunks + png[33:]


def _chunk(name: bytes, content: bytes) -> bytes:
    return len(content).to_bytes(4, "big") + name + content + zlib.crc32(name + content).to_bytes(4, "big")
