"""Which photos of several cameras were taken at one moment, by their names.

    stem     the same name but for the suffix: left/0007.png and right/0007.jpg
    number   the same number: left07.jpg and right7.jpg. Of several numbers in a name those count that change within a
             camera: 0007_cam1.png and 0007_cam2.png are both 7
    order    the first of each camera, the second …: only if asked for, and only if all have as many photos, since one
             photo too few would shift all others

By default the stem is tried, then the number, and what pairs more photos is taken.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Literal, TypeAlias, get_args

from sfm.core.arrays import Value
from sfm.core.errors import Rejected

Pairing: TypeAlias = Literal["auto", "stem", "number", "order"]
PAIRINGS: tuple[Pairing, ...] = get_args(Pairing)

_DIGITS = re.compile(r"\d+")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class FrameTable(Value):
    """Photos by moment.

    Attributes:
        by: how they were paired.
        frames: of each camera, by its name, the frame of each of its photos, by the photo's name.
    """

    by: Pairing
    frames: Mapping[str, Mapping[str, str]]

    @property
    def shared(self) -> tuple[str, ...]:
        """Frames of which two cameras or more have a photo, in order."""
        counts: dict[str, int] = {}
        for one in self.frames.values():
            for frame in one.values():
                counts[frame] = counts.get(frame, 0) + 1
        return tuple(sorted(frame for frame, count in counts.items() if count > 1))

    def without_partner(self, camera: str) -> tuple[str, ...]:
        """Photos of a camera whose moment no other camera has."""
        shared = set(self.shared)
        return tuple(name for name, frame in self.frames[camera].items() if frame not in shared)


def pair_photos(photos: Mapping[str, Sequence[str]], by: Pairing = "auto") -> FrameTable | Rejected:
    """Pairs the photos of cameras.

    Args:
        photos: names, possibly with folders, by camera.
    Returns:
        `two_photos_of_a_frame`, `different_counts` or `no_common_frame`.
    """
    if by == "auto":
        found = [_paired(photos, how) for how in ("stem", "number")]
        tables = [one for one in found if isinstance(one, FrameTable)]
        # max takes the first of equals: the stem.
        best = max(tables, key=lambda table: sum(map(len, table.frames.values())) - _alone(table), default=None)
        result = best or next(one for one in found if isinstance(one, Rejected))
    else:
        result = _paired(photos, by)
    if isinstance(result, FrameTable) and not result.shared:
        some = " | ".join(", ".join([*list(names)[:2], "…"]) for names in photos.values())
        return Rejected("no_common_frame", f"no names of two cameras agree: {some}")
    return result


def _alone(table: FrameTable) -> int:
    return sum(len(table.without_partner(camera)) for camera in table.frames)


def _paired(photos: Mapping[str, Sequence[str]], by: Literal["stem", "number", "order"]) -> FrameTable | Rejected:
    if by == "order":
        return _in_order(photos)
    keys = {camera: [_stem(name) for name in names] for camera, names in photos.items()}
    if by == "number":
        keys = _written({camera: _numbers(names) for camera, names in photos.items()}, keys)
    frames = {}
    for camera, names in photos.items():
        first: dict[str, str] = {}
        for name, key in zip(names, keys[camera], strict=True):
            if key in first:
                return Rejected("two_photos_of_a_frame", f"{camera}: {first[key]} and {name} are both frame {key}")
            first[key] = name
        frames[camera] = dict(zip(names, keys[camera], strict=True))
    return FrameTable(by, frames)


def _written(numbers: Mapping[str, list[tuple[int, ...]]], stems: Mapping[str, list[str]]) -> dict[str, list[str]]:
    """Numbers as text that sorts as they do; a name without a number stays as it is."""
    width = max((len(str(number)) for one in numbers.values() for some in one for number in some), default=1)
    return {
        camera: [
            "-".join(f"{number:0{width}d}" for number in some) or stem
            for some, stem in zip(one, stems[camera], strict=True)
        ]
        for camera, one in numbers.items()
    }


def _in_order(photos: Mapping[str, Sequence[str]]) -> FrameTable | Rejected:
    counts = {camera: len(names) for camera, names in photos.items()}
    if len(set(counts.values())) > 1:
        told = ", ".join(f"{camera} {count}" for camera, count in counts.items())
        return Rejected("different_counts", f"photos can be paired by their order only where all have as many: {told}")
    width = len(str(max(counts.values())))
    return FrameTable(
        "order", {camera: {name: f"{k:0{width}d}" for k, name in enumerate(names)} for camera, names in photos.items()}
    )


def _stem(name: str) -> str:
    return str(PurePath(name).with_suffix(""))


def _numbers(names: Sequence[str]) -> list[tuple[int, ...]]:
    """Of each name the numbers that change within a camera, else its last; none of a name without one."""
    found = [tuple(int(digits) for digits in _DIGITS.findall(_stem(name))) for name in names]
    counts = {len(numbers) for numbers in found}
    if len(counts) == 1 and len(names) > 1 and 0 not in counts:
        changing = [k for k in range(counts.pop()) if len({numbers[k] for numbers in found}) > 1]
        if changing:
            return [tuple(numbers[k] for k in changing) for numbers in found]
    return [numbers[-1:] for numbers in found]
