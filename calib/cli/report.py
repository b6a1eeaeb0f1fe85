"""`calib report`: a calibration as one HTML page."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from calib.cli.parsing import parsed
from sfm.core.errors import ConfigError, ExitCode

EXAMPLES = (
    "calib report camera.toml photos -o report.html",
    "calib report camera.toml photos --range 2.5 -o report.html",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """One HTML page about a calibration: coverage, residuals, uncertainty over the image, the board's shape, findings.

    It is made again from the camera file and the photos that it came from; corners that are known are not looked for.
    """

    camera: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAMERA", help_behavior_hint="")]
    """Camera file that `calib camera` wrote."""

    images: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="IMAGES", help_behavior_hint="")]
    """The photos that it was made from, or their folders."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """Page to write, .html."""

    board: Annotated[str, tyro.conf.arg(metavar="BOARD", help_behavior_hint="(default: that of the camera file)")] = ""
    """What is in the photos."""

    range: Annotated[
        float | None, tyro.conf.arg(metavar="M", help_behavior_hint="(default: as far as boards were)")
    ] = None
    """Distance in metres at which uncertainty is drawn, beside that of what is infinitely far."""

    threads: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 0)")] = 0
    """At most so many photos at once; 0 for all cores."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(ReportOptions, "report", words, EXAMPLES)
    if not options.images:
        raise ConfigError("no photos are named", remedy="name the folder of photos after the camera file")
    if options.output.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"-o must end in .html, got {options.output}")
    if options.range is not None and not options.range > 0:
        raise ConfigError(f"--range must be positive, got {options.range:g}")

    from calib.cli.again import calibrated_again
    from calib.cli.photos import photos_of
    from calib.cli.progress import kernels_announced, told
    from calib.cli.report_page import report_page, worst_views
    from sfm.io.atomic import write_text

    observer = told()
    with kernels_announced(observer):
        made, _ = calibrated_again(
            options.camera, options.images, options.board, threads=options.threads, observer=observer
        )
    photos = photos_of(options.images, worst_views(made.found))
    write_text(options.output, report_page(options.camera.stem, made, photos=photos, distance=options.range))
    print(options.output)
    return ExitCode.OK
