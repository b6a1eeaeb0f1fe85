"""`calib check`: whether photos agree with a camera."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from calib.cli.parsing import Flag, board_of, parsed, pixel_size
from sfm.core.errors import ConfigError, ExitCode, InputError, Rejected

if TYPE_CHECKING:
    from calib.boards import Board
    from calib.check import CameraCheck
    from calib.cli.sightings import Sightings
    from sfm.core.cameras import Camera
    from sfm.io.camera_records import CameraRecord

EXAMPLES = (
    "calib check camera.toml photos",
    "calib check camera.toml photos --board board.toml --suggest next.svg",
    "calib check camera.toml photos --max-error 0.3 --json",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """Whether photos of a board agree with a camera, and if not, what has changed; and which photos would help most.

    Only the poses of the board are fitted. The exit code is 5 where the error is above the limit, or where focal length
    or principal point have changed.
    """

    camera: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAMERA", help_behavior_hint="")]
    """Camera file."""

    images: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="IMAGES", help_behavior_hint="")]
    """Folders of photos, or photos, best such as it was not calibrated with; or corners, as in `calib camera`."""

    board: Annotated[str, tyro.conf.arg(metavar="BOARD", help_behavior_hint="(default: that of the camera file)")] = ""
    """What is in the photos; with the shape that the camera file has for it, if it is the same, or the same turned."""

    max_error: Annotated[
        float | None, tyro.conf.arg(metavar="PX", help_behavior_hint="(default: twice the held-out error of the file)")
    ] = None
    """Rms error that is allowed."""

    size: Annotated[str, tyro.conf.arg(metavar="WxH", help_behavior_hint="")] = ""
    """Width and height of the photos in px, for files of corners that do not say it."""

    suggest: Annotated[Path | None, tyro.conf.arg(metavar="FILE.svg", help_behavior_hint="")] = None
    """Draws where to hold the board in the next three photos."""

    json: Flag = False
    """Everything as JSON."""

    no_cache: Flag = False
    """Looks for the board anew, and keeps nothing."""

    threads: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 0)")] = 0
    """At most so many photos at once; 0 for all cores."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(CheckOptions, "check", words, EXAMPLES)
    _check_options(options)

    from calib.circle_shifts import exact_centres
    from calib.cli.check_report import check_json, check_lines
    from calib.cli.next_photos import further_photos
    from calib.cli.progress import kernels_announced, told
    from calib.cli.refusals import no_check, shown_size
    from calib.cli.sightings import see_board
    from calib.cli.suggestions_svg import suggestions_svg
    from sfm.io.atomic import write_text

    original, record = _read(options.camera)
    known = _known_board(options, record)
    board = board_of(options.board) if options.board else known
    observer, size = told(), pixel_size(options.size) if options.size else None
    with kernels_announced(observer):
        seen = see_board(
            options.images, board, size=size, threads=options.threads, use_cache=not options.no_cache,
            observer=observer,
        )  # fmt: skip
        finding = shown_size(seen, options.images)
        camera, sigmas = _at_size(original, record, seen)
        seen = dataclasses.replace(seen, views=exact_centres(seen.board, seen.views, camera))
        checked, limit_from = _checked(options, record, known, seen, camera, sigmas, camera.width / original.width)
    if isinstance(checked, Rejected):
        raise no_check(seen, checked, options.images)
    if finding is not None:
        checked = dataclasses.replace(checked, findings=(finding, *checked.findings))
    factor = camera.width / original.width
    suggested = further_photos(camera, record, seen, checked.found, resized_by=factor)
    if options.suggest:
        points = checked.found.observations.points2D
        write_text(options.suggest, suggestions_svg(camera, seen.board, points, None, suggested))
    if options.json:
        print(json.dumps(check_json(checked, seen, record, suggested, limit_from), indent=2, ensure_ascii=False))
    else:
        print("\n".join(check_lines(checked, seen, record, suggested, limit_from)))
    return ExitCode.QUALITY_GATE_FAILED if checked.failed else ExitCode.OK


def _check_options(options: CheckOptions) -> None:
    if options.threads < 0:
        raise ConfigError(f"--threads must not be negative, got {options.threads}")
    if not options.images:
        raise ConfigError("no photos are named", remedy="name a folder of photos after the camera file")
    if options.max_error is not None and not options.max_error > 0:
        raise ConfigError(f"--max-error must be positive, got {options.max_error:g}")
    if options.suggest and options.suggest.suffix.lower() != ".svg":
        raise ConfigError(f"--suggest must end in .svg, got {options.suggest}")
    from sfm.io.atomic import check_writable

    check_writable(options.suggest)


def _read(path: Path) -> tuple[Camera, CameraRecord]:
    from sfm.io.camera_files import read_camera_file, read_intrinsics
    from sfm.io.camera_foreign import stated_error_px
    from sfm.io.camera_records import CameraRecord, Fact

    if path.suffix.lower() == ".toml":
        return read_camera_file(path)
    cameras = read_intrinsics(path)
    if len(cameras) > 1:
        raise InputError(f"holds {len(cameras)} cameras", path=path, remedy="give a file with one camera")
    stated = stated_error_px(path)
    facts: dict[str, Fact] = {"rms_px": stated} if math.isfinite(stated) else {}
    return next(iter(cameras.values())), CameraRecord(facts)


def _checked(
    options: CheckOptions, record: CameraRecord, known: Board | None, seen: Sightings, camera: Camera,
    sigmas: dict[str, float], resized_by: float,
) -> tuple[CameraCheck | Rejected, str]:  # fmt: skip
    """The check by the shape of the board that suits best, of those it may have, and where its limit comes from."""
    from calib.board_turns import board_turns
    from calib.check import check_camera, known_shape
    from calib.cli.check_limits import limit_of, shapes_to_try

    shapes = shapes_to_try(record, known, seen)
    limit = limit_of(record, options.max_error, with_shape=bool(shapes))
    tried = [
        check_camera(
            camera, shape, seen.views, limit_px=limit.px, sigmas=sigmas,
            stated_px=record.number("rms_px") * resized_by, is_ours=record.facts.get("kind") == "photos",
            turns=board_turns(seen.board) if seen.board is not None else (),
        )
        for shape in (shapes or [known_shape(seen.points3D)])
    ]  # fmt: skip
    able = [check for check in tried if not isinstance(check, Rejected)]
    return (min(able, key=lambda check: check.rms_px) if able else tried[0]), limit.why


def _known_board(options: CheckOptions, record: CameraRecord) -> Board | None:
    """The board of the file; one that is only a description does not matter where another is named."""
    from calib.cli.check_limits import board_of_record

    try:
        return board_of_record(options.camera, record)
    except ConfigError:
        if not options.board:
            raise
        return None


def _at_size(camera: Camera, record: CameraRecord, seen: Sightings) -> tuple[Camera, dict[str, float]]:
    """The camera at the size of the photos, if these were resized as a whole, and its standard deviations."""
    from calib.check import resized

    known = record.uncertainty
    sigmas: dict[str, float] = {}
    if known is not None:
        best = [a if a == a else b for a, b in zip(known.sigma_by_view.tolist(), known.sigma.tolist(), strict=True)]
        sigmas = dict(zip(known.free, best, strict=True))
    sizes = {(view.width, view.height) for view in seen.views}
    if len(sizes) != 1:
        return camera, sigmas
    width, height = sizes.pop()
    if (width, height) == (camera.width, camera.height):
        return camera, sigmas
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        return camera, sigmas
    return resized(camera, sigmas, width, height)
