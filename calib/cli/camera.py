"""`calib camera`: a camera from photos of a board."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from calib.cli.parsing import Flag, board_of, parsed, pixel_size
from sfm.core.errors import ConfigError, ExitCode, Rejected

if TYPE_CHECKING:
    from calib.boards import Board
    from calib.cli.calibrating import CameraPlan

EXAMPLES = (
    "calib camera photos --board board.toml -o camera.toml",
    "calib camera photos --board chessboard:9x6:25mm --model auto -o camera.toml --suggest next.svg",
    "calib camera photos/*.jpg --board charuco:8x6:30mm:22mm --model fisheye -o camera.toml --json",
    "calib camera corners.json -o camera.toml",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """Calibrates a camera from photos of a board, and says how far to trust it.

    Beside the camera: how uncertain it is, its error on photos that were held out, what was left out and why, and what
    is wrong with photos, lens model or board, with remedies. The file works with `sfm run --intrinsics`.
    """

    images: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="IMAGES", help_behavior_hint="")]
    """Folders of photos, or photos, of one camera at one focus and zoom; or corners that were found before: what `calib
    detect -o` wrote, a .vnl of mrcal, .csv files (see docs/calibrate.md)."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """Camera file to write, .toml."""

    board: Annotated[str, tyro.conf.arg(metavar="BOARD", help_behavior_hint="(required for photos)")] = ""
    """The .toml that `calib board` wrote, or the board in one word such as chessboard:9x6:25mm (inner corners, side of
    a square); see `calib detect --help`."""

    model: Annotated[str, tyro.conf.arg(metavar="NAME")] = "auto"
    """auto (what predicts held-out photos best), pinhole, simple_radial, radial, opencv (k1 k2 p1 p2, as COLMAP's
    OPENCV), opencv5 (and k3, OpenCV's own default), opencv8 (its rational model), opencv12 (and thin prism), fisheye
    (Kannala–Brandt), eucm, division, double_sphere; names of COLMAP's models do as well."""

    shape: Annotated[str, tyro.conf.arg(metavar="NAME")] = "auto"
    """What the board may be: flat, scale (stretched by the printer), paraboloid (bent), height, free (every corner lies
    where it lies), or auto: what predicts held-out photos best and does not cost the camera."""

    focal: Annotated[float | None, tyro.conf.arg(metavar="PX", help_behavior_hint="")] = None
    """About the focal length, where photos alone do not tell it; it is refined."""

    size: Annotated[str, tyro.conf.arg(metavar="WxH", help_behavior_hint="")] = ""
    """Width and height of the photos in px, for files of corners that do not say it."""

    name: Annotated[str, tyro.conf.arg(metavar="TEXT", help_behavior_hint="")] = ""
    """Of the camera, for the file."""

    suggest: Annotated[Path | None, tyro.conf.arg(metavar="FILE.svg", help_behavior_hint="")] = None
    """Draws where to hold the board in the next three photos as SVG."""

    json: Flag = False
    """Everything as JSON."""

    no_cache: Flag = False
    """Looks for the board anew, and keeps nothing."""

    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Of the choice of photos that are held out."""

    threads: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 0)")] = 0
    """At most so many photos at once; 0 for all cores. The result does not depend on it."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(CameraOptions, "camera", words, EXAMPLES)
    board = _checked(options)

    from calib.cli.calibrating import calibrate_camera
    from calib.cli.camera_report import camera_json, camera_lines, record_of
    from calib.cli.next_photos import drawn, next_photos
    from calib.cli.progress import kernels_announced, told
    from calib.cli.refusals import no_camera, shown_size
    from calib.cli.sightings import see_board
    from sfm.io.atomic import write_text
    from sfm.io.camera_files import write_camera_toml

    observer, size = told(), pixel_size(options.size) if options.size else None
    with kernels_announced(observer):
        seen = see_board(
            options.images, board, size=size, threads=options.threads, use_cache=not options.no_cache,
            observer=observer,
        )  # fmt: skip
        finding = shown_size(seen, options.images)
        made = calibrate_camera(seen, _plan(options), observer=observer) if seen.views else Rejected("no_board")
    if isinstance(made, Rejected):
        raise no_camera(seen, made, options.images)
    if finding is not None:
        made = dataclasses.replace(made, findings=(finding, *made.findings))
    record = record_of(made, seen, command=shlex.join(["calib", "camera", *words]))
    write_camera_toml(options.output, made.found.camera, name=options.name, record=record)
    suggested = next_photos(made, seen)
    if options.suggest:
        write_text(options.suggest, drawn(made, seen, suggested))
    if options.json:
        print(json.dumps(camera_json(made, seen, suggested), indent=2, ensure_ascii=False))
    else:
        print("\n".join([*camera_lines(made, seen, suggested), "", str(options.output)]))
    return ExitCode.OK


def _checked(options: CameraOptions) -> Board | None:
    """The board; what the options say wrongly is told before photos are looked at."""
    if options.threads < 0:
        raise ConfigError(f"--threads must not be negative, got {options.threads}")
    if not options.images:
        raise ConfigError("no photos are named", remedy="name a folder of photos")
    if options.output.suffix.lower() != ".toml":
        raise ConfigError(f"-o must end in .toml, got {options.output}")
    if options.suggest and options.suggest.suffix.lower() != ".svg":
        raise ConfigError(f"--suggest must end in .svg, got {options.suggest}")
    if options.focal is not None and not 1 <= options.focal <= 1e6:
        raise ConfigError(f"--focal must be a length in px, got {options.focal:g}")
    _plan(options)
    from sfm.io.atomic import check_writable

    check_writable(options.output, options.suggest)
    return board_of(options.board) if options.board else None


def _plan(options: CameraOptions) -> CameraPlan:
    from calib.cli.calibrating import AUTO, CameraPlan
    from calib.refine_board import SHAPES
    from calib.refine_lenses import lens_called

    if options.shape not in (AUTO, *SHAPES):
        raise ConfigError(f"unknown --shape {options.shape!r}", remedy=f"known are {', '.join((AUTO, *SHAPES))}")
    try:
        lens = AUTO if options.model.lower() == AUTO else lens_called(options.model).name
    except ValueError as error:
        raise ConfigError(str(error)) from error
    return CameraPlan(lens=lens, shape=options.shape, focal_px=options.focal, seed=options.seed)
