"""Masks of photos: which file belongs to which photo, and what it hides.

A mask is a picture of the size of its photo that is black where nothing shall be sought: people, cars, the sky, a
turntable. For the photo `sub/IMG.jpg` it may be called  IMG.jpg.png  (as COLMAP wants it),  IMG.png,  IMG_mask.png,
IMG-mask.png,  IMG.mask.png,  mask_IMG.png  or  mask-IMG.png,  with any suffix of a picture, and lies in the folder
`sub` of the masks, or without sub-folders where that is unambiguous.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from sfm.core.arrays import BoolArray
from sfm.core.errors import ImageError, InputError
from sfm.io.exif import read_image_info
from sfm.io.images import list_images, read_image

NONE = "none"
"""The setting that forbids masks."""
_FOLDERS = ("masks", "mask", "Masks", "Mask")
_LOSSY = {".jpg", ".jpeg", ".webp", ".jp2"}
_LOSSY_BLACK = 128
"""Below it a pixel of a lossy mask was black: around an edge such files hold all sorts of greys."""


def masks_folder(images: Path, setting: str) -> Path | None:
    """The folder of masks: the one that is named, or else one called masks in the folder of the photos or beside it.

    Raises:
        InputError: the named folder is missing.
    """
    if setting == NONE:
        return None
    if setting:
        if not Path(setting).is_dir():
            raise InputError("there is no such folder of masks", path=setting, remedy="check the spelling of the path")
        return Path(setting)
    places = [folder / name for folder in (images, images.absolute().parent) for name in _FOLDERS]
    return next((place for place in places if place.is_dir() and place.resolve() != images.resolve()), None)


def photos_among(names: Iterable[str], images: Path, folder: Path | None) -> tuple[str, ...]:
    """The names in the folder of the photos that are no masks.

    Those in a folder of masks within are; and where the masks lie among the photos, those that are named like a
    mask of a photo that is there.
    """
    names = tuple(names)
    if folder is None:
        return names
    if folder.resolve() == images.resolve():
        masks = {path.relative_to(folder).as_posix() for path in _masks_among(names, folder).values()}
        return tuple(name for name in names if name not in masks)
    # A link in the folder of the photos counts as lying there, and so does what a link from elsewhere leads to.
    for inner, outer in ((folder.absolute(), images.absolute()), (folder.resolve(), images.resolve())):
        if inner.is_relative_to(outer):
            within = inner.relative_to(outer).as_posix()
            names = tuple(name for name in names if not name.startswith(f"{within}/"))
    return names


def find_masks(names: Sequence[str], images: Path, folder: Path) -> dict[str, Path]:
    """The masks in `folder` by the name of their photo; photos without one are left out.

    Raises:
        InputError: no file there is a mask of any photo; it tells what is expected.
    """
    if folder.resolve() == images.resolve():
        found = _masks_among(names, folder)
    else:
        found = _matched(names, list_images(folder).names, folder, own_stem=True)
    if not found:
        raise InputError(
            "no file here is the mask of any photo",
            path=folder,
            remedy=f"for {names[0]} it should be called {_expected(names[0])}; or forbid masks with --masks {NONE}",
        )
    return found


def check_mask_size(path: Path, name: str, width: int, height: int) -> None:
    """Raises ImageError where a mask has not the size of its photo `name`."""
    info = read_image_info(path)
    if (info.width, info.height) == (width, height):
        return
    turned = (info.height, info.width) == (width, height)
    raise ImageError(
        f"the mask has {info.width}×{info.height} px, its photo {name} has {width}×{height} px",
        path=path,
        remedy="turn the mask: photos are read as the sensor gave them, without the EXIF orientation"
        if turned
        else "masks must have the size of their photos",
    )


def read_mask(path: Path) -> BoolArray:
    """(H, W), True where the photo is to be used: where the mask is not black.

    Raises:
        ImageError: as for `read_image`.
    """
    grey = read_image(path, gray=True)
    return grey >= (_LOSSY_BLACK if path.suffix.lower() in _LOSSY else 1)


def masked_share(mask: BoolArray) -> float:
    """Share of the pixels that are hidden."""
    return float(1 - np.count_nonzero(mask) / mask.size)


def _expected(name: str) -> str:
    stem = PurePosixPath(name).stem
    file = PurePosixPath(name).name
    return f"{file}.png, {stem}.png, {stem}_mask.png or mask_{stem}.png"


def _masks_among(names: Sequence[str], folder: Path) -> dict[str, Path]:
    """Masks that lie beside their photos: a file is one only where its name says so and its photo is there."""
    return _matched(names, names, folder, own_stem=False)


def _matched(names: Sequence[str], files: Sequence[str], folder: Path, *, own_stem: bool) -> dict[str, Path]:
    by_place: dict[tuple[str, str], str] = {}
    for file in files:
        by_place.setdefault(_place(file, PurePosixPath(file).stem), file)
    ambiguous = _repeated(names)
    found: dict[str, Path] = {}
    for name in names:
        folders = [str(PurePosixPath(name).parent)]
        if PurePosixPath(name).name not in ambiguous:
            folders.append(".")
        places = [(where.casefold(), base) for where in folders for base in _bases(name, own_stem)]
        file = next((by_place[place] for place in places if place in by_place), None)
        if file is not None:
            found[name] = folder / file
    return found


def _place(name: str, base: str) -> tuple[str, str]:
    return str(PurePosixPath(name).parent).casefold(), base.casefold()


def _bases(name: str, own_stem: bool) -> list[str]:
    """Names without suffix that the mask of a photo may have, the most telling first."""
    path = PurePosixPath(name)
    words = (path.name, path.stem)
    after = [f"{word}{mark}mask" for word in words for mark in "_-."]
    before = [f"mask{mark}{word}" for word in words for mark in "_-"]
    return [base.casefold() for base in [path.name, *after, *before, *([path.stem] if own_stem else [])]]


def _repeated(names: Sequence[str]) -> set[str]:
    """File names that occur in more than one folder."""
    counts = Counter(PurePosixPath(name).name for name in names)
    return {file for file, count in counts.items() if count > 1}
