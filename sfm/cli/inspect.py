"""`sfm inspect`: what a folder of photos holds, and what will do harm."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sfm.cli.parsing import Flag, parsed
from sfm.core.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from sfm.pipeline.inspection import InspectedImage, Inspection

EXAMPLES = (
    "sfm inspect photos",
    "sfm inspect photos --json > photos.json",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class InspectOptions:
    """Size, sharpness, exposure and EXIF of each photo of a folder, copies, and files that cannot be used.

    Sharpness is the frequency of the edges in radians per pixel, at 1,024 px: 0.5 to 0.9 in photos that are in focus,
    half of that if they are blurred by 2 px. Only reads; nothing is written.
    """

    images: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGES", help_behavior_hint="")]
    """Folder of photos; folders within are searched as well."""

    json: Flag = False
    """Everything as JSON."""

    threads: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 0)")] = 0
    """At most so many photos at once; 0 for all cores."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(InspectOptions, "inspect", words, EXAMPLES)
    if options.threads < 0:
        raise ConfigError(f"--threads must not be negative, got {options.threads}")
    from sfm.pipeline.inspection import inspect_folder
    from sfm.pipeline.observers import screen_progress, watched

    with watched(screen_progress()) as observer:
        found = inspect_folder(options.images, threads=options.threads, observer=observer)
    print(json.dumps(found.to_json(), indent=2, ensure_ascii=False) if options.json else "\n".join(_lines(found)))
    return ExitCode.OK if found.images else ExitCode.BAD_INPUT


def _lines(found: Inspection) -> Iterator[str]:
    width = max((len(image.name) for image in found.images), default=0)
    if found.images:
        yield f"{'photo':<{width}}  {'size':>11}  sharp  mean  black  white  focal        remarks"
    for image in found.images:
        exposure = image.exposure
        size = f"{image.info.width}×{image.info.height}"
        yield (
            f"{image.name:<{width}}  {size:>11}  {image.sharpness:5.2f}  {exposure.mean:4.2f}  {exposure.black:4.0%}"
            f"   {exposure.white:4.0%}   {_focal(image):<11}  {_remarks(found, image)}"
        ).rstrip()
    for name, reason in found.unreadable.items():
        yield f"{name if name.isprintable() else ascii(name)}: {reason}"
    for group in found.copies:
        yield f"the same file: {', '.join(group)}"
    for group in found.near_copies:
        yield f"almost the same picture: {', '.join(group)}"
    yield f"{len(found.images)} photos, sharpness {found.median_sharpness:.2f} in the median" if found.images else ""
    yield from (f"- {line}" for line in found.advice())


def _focal(image: InspectedImage) -> str:
    info = image.info
    if info.focal_35mm:
        return f"{info.focal_35mm:.0f} mm (35)"
    if info.focal_mm:
        return f"{info.focal_mm:.1f} mm"
    return "–"


def _remarks(found: Inspection, image: InspectedImage) -> str:
    info = image.info
    told = [
        "" if found.focus(image) == "sharp" else found.focus(image),
        "" if image.exposure.verdict == "good" else image.exposure.verdict,
        f"{info.make} {info.model}".strip(),
        f"{info.captured:%Y-%m-%d %H:%M:%S}" if info.captured else "",
        f"{info.gps[0]:.5f}, {info.gps[1]:.5f}" if info.gps else "",
        f"orientation {info.orientation}" if info.orientation != 1 else "",
    ]
    return " · ".join(filter(None, told))
