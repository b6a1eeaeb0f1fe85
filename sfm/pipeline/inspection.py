"""A look at a folder of photos before anything is made of them: what is there, and what will do harm.

Nothing is written. Files are read and decoded on several threads; the result does not depend on how many.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sfm.core.errors import ImageError, InputError
from sfm.core.events import SILENT, ImageRead, Observer, StageFinished, StageStarted
from sfm.core.execution import available_threads, ordered_map
from sfm.core.graphs import connected_components
from sfm.core.imaging.exposure import Exposure, exposure_of
from sfm.core.imaging.fingerprint import fingerprint, near_pairs
from sfm.core.imaging.sharpness import sharpness
from sfm.io.exif import ImageInfo, prior_focal_px, read_image_info
from sfm.io.images import list_images, read_image, read_image_bytes

STAGE = "inspection"
_BLURRED_SHARE = 0.7
"""Of the folder's median sharpness, below which a photo is blurred: in-focus photos of one place keep above 0.9, a blur
by 1 px at 1,024 px takes a quarter away, shake by 12 px more than half."""
_BLURRED_BELOW = 0.35
"""Sharpness in rad/px below which a photo is blurred whatever the others are."""


@dataclasses.dataclass(frozen=True, slots=True)
class InspectedImage:
    """What is known of one photo.

    Attributes:
        sharpness: in rad/px, see `core.imaging.sharpness`; NaN where it has hardly an edge.
        focal_px: the focal length that EXIF gives for this size, if it does.
    """

    name: str
    info: ImageInfo
    bytes: int
    digest: str
    sharpness: float
    exposure: Exposure
    focal_px: float | None
    fingerprint: np.ndarray


@dataclasses.dataclass(frozen=True, slots=True)
class Inspection:
    """A folder of photos.

    Attributes:
        images: in natural order of the names.
        unreadable: the other files, each with the reason.
        copies: groups of names of equal content.
        near_copies: groups of names of almost one picture (other size or compression, or a moment later from the same
            place), exact copies not repeated.
    """

    folder: Path
    images: Sequence[InspectedImage]
    unreadable: Mapping[str, str]
    copies: Sequence[Sequence[str]]
    near_copies: Sequence[Sequence[str]]

    @property
    def median_sharpness(self) -> float:
        """Of the photos that have edges; NaN if none has."""
        values = [image.sharpness for image in self.images if not np.isnan(image.sharpness)]
        return float(np.median(values)) if values else float("nan")

    def focus(self, image: InspectedImage) -> str:
        """`sharp`, `blurred` or `no detail`."""
        if np.isnan(image.sharpness):
            return "no detail"
        limit = max(_BLURRED_BELOW, _BLURRED_SHARE * self.median_sharpness)
        return "sharp" if image.sharpness >= limit else "blurred"

    def advice(self) -> list[str]:
        """What to do before these photos are reconstructed, a line for each matter."""
        return [line for line in _advice(self) if line]

    def to_json(self) -> dict[str, Any]:
        """Everything but the fingerprints."""
        return {
            "folder": str(self.folder),
            "images": [_image_json(self, image) for image in self.images],
            "unreadable": dict(self.unreadable),
            "copies": [list(group) for group in self.copies],
            "near_copies": [list(group) for group in self.near_copies],
            "median_sharpness": _finite(self.median_sharpness),
            "advice": self.advice(),
        }


def inspect_folder(folder: Path | str, *, threads: int = 0, observer: Observer = SILENT) -> Inspection:
    """Looks at every file of a folder and below it.

    Args:
        threads: at most so many files at once; 0 for all cores.
    Raises:
        InputError: the folder is missing, is no folder or holds no files.
    """
    folder = Path(folder).absolute()
    listing = list_images(folder)
    if not listing.names and not listing.skipped:
        raise InputError("there are no photos in this folder", path=folder, remedy="name the folder that holds them")
    unreadable = dict(listing.skipped)
    observer(StageStarted(stage=STAGE, total=len(listing.names)))
    images: list[InspectedImage] = []

    def look(name: str) -> InspectedImage | ImageError:
        return _look(folder, name)

    for name, image in zip(
        listing.names, ordered_map(look, listing.names, threads=threads or available_threads()), strict=True
    ):
        if isinstance(image, ImageError):
            unreadable[name] = image.cause
        else:
            images.append(image)
        observer(ImageRead(name=name, reason=unreadable.get(name, "")))
    copies = _copies(images)
    inspection = Inspection(folder, images, dict(sorted(unreadable.items())), copies, _near_copies(images, copies))
    observer(StageFinished(stage=STAGE, summary=f"{len(images)} photos, {len(unreadable)} other files"))
    return inspection


def _look(folder: Path, name: str) -> InspectedImage | ImageError:
    path = folder / name
    try:
        info, data = read_image_info(path), read_image_bytes(path)
        image = read_image(path)
    except ImageError as error:
        return error
    except OSError as error:
        return ImageError((error.strerror or str(error)).lower(), path=path)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return InspectedImage(
        *(name, info, len(data), hashlib.blake2b(data, digest_size=16).hexdigest()),
        *(sharpness(grey), exposure_of(image), prior_focal_px(info), fingerprint(grey)),
    )


def _copies(images: Sequence[InspectedImage]) -> list[list[str]]:
    groups: dict[str, list[str]] = {}
    for image in images:
        groups.setdefault(image.digest, []).append(image.name)
    return [names for names in groups.values() if len(names) > 1]


def _near_copies(images: Sequence[InspectedImage], copies: Sequence[Sequence[str]]) -> list[list[str]]:
    """Pictures without edges all look alike, and are left out; so are repeated ones but the first."""
    repeated = {name for group in copies for name in group[1:]}
    seen = [image for image in images if image.name not in repeated and not np.isnan(image.sharpness)]
    if not seen:
        return []
    pairs = near_pairs(np.stack([image.fingerprint for image in seen]))
    groups = connected_components(len(seen), np.array(pairs, np.int64).reshape(-1, 2))
    return sorted(([seen[k].name for k in group] for group in groups if len(group) > 1), key=lambda names: names[0])


def _advice(inspection: Inspection) -> list[str]:
    images = inspection.images
    if not images:
        return ["none of these files is a usable photo"]
    blurred = [image.name for image in images if inspection.focus(image) == "blurred"]
    blank = [image.name for image in images if inspection.focus(image) == "no detail"]
    exposed = Counter(image.exposure.verdict for image in images)
    poor = ", ".join(
        f"{exposed[verdict]} {verdict}" for verdict in ("dark", "bright", "clipped", "flat") if exposed[verdict]
    )
    without = sum(image.focal_px is None for image in images)
    sizes = Counter((image.info.width, image.info.height) for image in images)
    spare = sum(len(group) - 1 for group in inspection.copies)
    near = sum(len(group) - 1 for group in inspection.near_copies)
    one_camera = "; if one camera took all of them, say --single-camera" if len(sizes) == 1 else ""
    advice = (
        (len(images) < 3, "three photos are the least for a model that can be checked, some dozens are good"),
        (blurred, f"{len(blurred)} blurred ({_named(blurred)}): leave them out where others show the same"),
        (blank, f"{len(blank)} with hardly any detail ({_named(blank)}): nothing can be matched there"),
        (poor, f"exposure: {poor}: detail that is lost cannot be matched"),
        (spare, f"{spare} exact copies: they cost time and bring nothing"),
        (near, f"{near} near copies (other size or compression, or taken from the same place): keep the best"),
        (len(sizes) > 1, f"{len(sizes)} sizes of photos: a camera is estimated for each"),
        (without, f"no focal length in EXIF for {without} of {len(images)}: it is estimated{one_camera}"),
        (inspection.unreadable, f"{len(inspection.unreadable)} files cannot be used"),
    )
    return [text for applies, text in advice if applies]


def _image_json(inspection: Inspection, image: InspectedImage) -> dict[str, Any]:
    info = dataclasses.asdict(image.info)
    info["captured"] = image.info.captured.isoformat() if image.info.captured else None
    return {
        "name": image.name,
        "bytes": image.bytes,
        "digest": image.digest,
        "sharpness": _finite(image.sharpness),
        "focus": inspection.focus(image),
        "exposure": dataclasses.asdict(image.exposure) | {"verdict": image.exposure.verdict},
        "focal_px": image.focal_px,
        **info,
    }


def _finite(value: float) -> float | None:
    return None if np.isnan(value) else value


def _named(names: Sequence[str], at_most: int = 5) -> str:
    more = f", +{len(names) - at_most} more" if len(names) > at_most else ""
    return ", ".join(names[:at_most]) + more
