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
    "calib report rig.toml left right -o report.html",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """One HTML page about a calibration: coverage, residuals, uncertainty over the image, the board's shape, findings.

    Of a rig: how the cameras stand, baselines, epipolar errors, who saw which board, and every camera. It is made again
    from the file and the photos that it came from; corners that are known are not looked for.
    """

    camera: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
    """What `calib camera`, `calib stereo` or `calib rig` wrote."""

    images: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="IMAGES", help_behavior_hint="")]
    """The photos that it was made from, or their folders; of a rig [NAME=]DIR or a pattern for each camera."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """Page to write, .html."""

    board: Annotated[str, tyro.conf.arg(metavar="BOARD", help_behavior_hint="(default: that of the file)")] = ""
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

    from sfm.io.atomic import check_writable, write_text
    from sfm.io.rig_files import is_rig_file

    check_writable(options.output)
    if not is_rig_file(options.camera):
        page = _page_of_camera(options)
    elif options.range is not None:
        raise ConfigError("--range is for one camera; the page of a rig has no map of uncertainty")
    else:
        page = _page_of_rig(options)
    write_text(options.output, page)
    print(options.output)
    return ExitCode.OK


def _page_of_camera(options: ReportOptions) -> str:
    from calib.cli.again import calibrated_again
    from calib.cli.calibrating import with_yardstick
    from calib.cli.photos import photos_of
    from calib.cli.progress import kernels_announced, told
    from calib.cli.report_page import report_page, worst_views

    observer = told()
    with kernels_announced(observer):
        made, seen = calibrated_again(
            options.camera, options.images, options.board, threads=options.threads, observer=observer
        )
        made = with_yardstick(made, seen.points3D)
    photos = photos_of(options.images, worst_views(made.found))
    return report_page(options.camera.stem, made, photos=photos, distance=options.range)


def _page_of_rig(options: ReportOptions) -> str:
    from calib.cli.photos import photos_of
    from calib.cli.progress import kernels_announced, told
    from calib.cli.rig_again import rig_again
    from calib.cli.rig_page import rig_page, worst_rig_views

    observer = told()
    with kernels_announced(observer):
        words = [str(source) for source in options.images]
        made = rig_again(options.camera, words, options.board, threads=options.threads, observer=observer)
    photos = {
        (camera, name): photo
        for camera, name in worst_rig_views(made.found)
        for photo in photos_of(made.files[camera], [name]).values()
    }
    return rig_page(options.camera.stem, made, photos=photos)
