"""Detections of a board in files, on several threads; those of files seen before come from a cache.

A detection is kept under a digest of the file's content, the board, the settings, the versions of this package and of
OpenCV, and the sources that look at the photo, from reading it on. So a renamed or copied photo is known, and nothing
is served that another version found.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import calib
import sfm
from calib.boards import Board
from calib.detect import Detection, detect_board
from calib.detect_gates import DetectConfig
from sfm.core.arrays import ImageU8
from sfm.core.errors import ConfigError, ImageError, InputError, Rejected
from sfm.core.events import SILENT, ImageRead, Observer, StageFinished, StageStarted
from sfm.core.execution import available_threads, ordered_map
from sfm.io.atomic import write_text
from sfm.io.images import list_images, read_image
from sfm.io.kernel_cache import user_cache_folder

STAGE = "detection"
_OWN_SOURCES = ("boards.py", "boards_artwork.py", "detect*.py", "_detect_kernels.py")
_SHARED_SOURCES = ("core/imaging/noise.py", "core/imaging/resample.py", "io/images.py")


def find_photos(sources: Sequence[Path]) -> dict[str, Path]:
    """The image files of folders, and files that are named themselves, by name relative to their folder.

    Raises:
        InputError: a folder is missing, there is no image at all, or two have one name.
    """
    photos: dict[str, Path] = {}
    for source in sources:
        found = {source.name: source}
        if source.is_dir() or not source.exists():
            found = {name: source / name for name in list_images(source).names}
        if twice := photos.keys() & found.keys():
            raise InputError(f"{min(twice)} is there twice", path=source, remedy="name one folder")
        photos |= found
    if not photos:
        raise InputError("holds no image", path=sources[0] if sources else None)
    return photos


def check_apart(folder: Path, sources: Sequence[Path]) -> None:
    """Raises ConfigError where images written to a folder would be taken for photos the next time."""
    folders = {(source if source.is_dir() else source.parent).resolve() for source in sources}
    if folders & {folder.resolve(), *folder.resolve().parents}:
        cause = "lies among the photos, and the next run would take what is written there for photos"
        raise ConfigError(cause, path=folder, remedy="name a folder elsewhere")


def photos_of(sources: Sequence[Path], names: Sequence[str], *, gray: bool = False) -> dict[str, ImageU8]:
    """The photos of some names, as they are, or grey; those that are not there or cannot be read are left out."""
    out = {}
    with contextlib.suppress(InputError):
        photos = find_photos(sources)
        for name in names:
            with contextlib.suppress(KeyError, ImageError):
                out[name] = read_image(photos[name], gray=gray)
    return out


def detect_photos(
    photos: Mapping[str, Path],
    board: Board,
    config: DetectConfig = DetectConfig(),
    *,
    threads: int = 0,
    cache: Path | None = None,
    observer: Observer = SILENT,
) -> dict[str, Detection | Rejected]:
    """What is seen in each photo, in the order of `photos`; a file that cannot be read is a rejection as well.

    Args:
        threads: 0 for all cores. The result does not depend on it.
        cache: folder of detections that are known; see `detection_cache`.
    """
    observer(StageStarted(stage=STAGE, total=len(photos)))

    def seen(item: tuple[str, Path]) -> Detection | Rejected:
        name, path = item
        try:
            return _detect_file(name, path, board, config, cache)
        except ImageError as error:
            return Rejected("unreadable", error.cause)

    result: dict[str, Detection | Rejected] = {}
    # OpenCV's own threads would fight over the cores that the photos share.
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        found = ordered_map(seen, photos.items(), threads=threads or available_threads(), abandons=True)
        for name, detection in zip(photos, found, strict=True):
            result[name] = detection
            observer(ImageRead(name=name, reason="" if detection else detection.reason))
    finally:
        cv2.setNumThreads(before)
    count = sum(isinstance(detection, Detection) for detection in result.values())
    observer(StageFinished(stage=STAGE, summary=f"{count} of {len(photos)} photos show the board"))
    return result


def detection_cache() -> Path:
    """The folder in the user's cache."""
    return user_cache_folder() / "boards"


def detection_json(seen: Detection | Rejected) -> dict[str, Any]:
    """A detection as plain values; every number reads back as it is."""
    if not isinstance(seen, Detection):
        return {"reason": seen.reason, "detail": seen.detail}
    return {
        "name": seen.name,
        "width": seen.width,
        "height": seen.height,
        "finder": seen.finder,
        "blur_px": None if np.isnan(seen.blur_px) else seen.blur_px,
        "corner_ids": seen.corner_ids.tolist(),
        "points2D": seen.points2D.tolist(),
        "covariances": seen.covariances.tolist(),
        "rejected": {str(number): reason for number, reason in seen.rejected.items()},
        "rejected2D": seen.rejected2D.tolist(),
    }


def detection_from_json(values: Mapping[str, Any]) -> Detection | Rejected:
    """The inverse of `detection_json`."""
    if "reason" in values:
        return Rejected(values["reason"], values["detail"])
    return Detection(
        values["name"],
        values["width"],
        values["height"],
        np.array(values["corner_ids"], np.int64),
        np.array(values["points2D"], np.float64).reshape(-1, 2),
        np.array(values["covariances"], np.float64).reshape(-1, 2, 2),
        {int(number): reason for number, reason in values["rejected"].items()},
        np.array(values["rejected2D"], np.float64).reshape(-1, 2),
        values["finder"],
        float("nan") if values["blur_px"] is None else values["blur_px"],
    )


def _detect_file(name: str, path: Path, board: Board, config: DetectConfig, cache: Path | None) -> Detection | Rejected:
    if cache is None:
        return detect_board(read_image(path, gray=True), board, config, name=name)
    kept = cache / f"{_key(path, board, config)}.json"
    known = _known(kept, name)
    if known is not None:
        return known
    seen = detect_board(read_image(path, gray=True), board, config, name=name)
    with contextlib.suppress(InputError):  # a cache that cannot be written to costs time, nothing else
        write_text(kept, json.dumps(detection_json(seen)))
    return seen


def _known(kept: Path, name: str) -> Detection | Rejected | None:
    try:
        seen = detection_from_json(json.loads(kept.read_bytes()))
    except (OSError, ValueError, KeyError, TypeError):  # never written, or broken: then it is found anew
        return None
    return dataclasses.replace(seen, name=name) if isinstance(seen, Detection) else seen


def _key(path: Path, board: Board, config: DetectConfig) -> str:
    digest = hashlib.blake2b(digest_size=20)
    try:
        digest.update(path.read_bytes())
    except OSError as error:
        raise ImageError((error.strerror or str(error)).lower(), path=path) from error
    versions = [calib.__version__, cv2.__version__, _version_of_detector()]
    digest.update("\n".join([board.spec, repr(config), *versions]).encode())
    return digest.hexdigest()


def detector_sources() -> list[Path]:
    """The files of this package on which a detection depends, but for those that only say what an array or error is."""
    folders = {Path(calib.__file__).parent: _OWN_SOURCES, Path(sfm.__file__).parent: _SHARED_SOURCES}
    return [
        path for folder, patterns in folders.items() for pattern in patterns for path in sorted(folder.glob(pattern))
    ]


@functools.cache
def _version_of_detector() -> str:
    """A digest of all sources on which a detection depends."""
    digest = hashlib.blake2b(digest_size=16)
    for path in detector_sources():
        digest.update(path.read_bytes())
    return digest.hexdigest()
