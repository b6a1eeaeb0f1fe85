"""`calib handeye`: where a camera sits on a robot."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from calib.cli.parsing import Flag, board_of, parsed
from sfm.core.errors import ConfigError, ExitCode, ReconstructionError, Rejected

EXAMPLES = (
    "calib handeye photos --poses robot.csv --board board.toml --camera camera.toml -o handeye.toml",
    "calib handeye photos --poses robot.csv --board chessboard:9x6:25mm --camera camera.toml --eye-to-hand --json",
)
_REMEDIES = {
    "too_few_poses": "take ten photos or more, from orientations that differ by 20° and more about two axes",
    "no_rotation": "let the robot tilt and turn the camera between photos",
    "one_axis": "let the robot tilt the camera about a second axis, too",
    "quaternion_order": "write columns qw, qx, qy, qz, in any order, with these names in the first line",
    "inverse_poses": "give poses as base_from_hand, and --eye-to-hand where the camera stands beside the robot",
    "motions_disagree": "check names in the table; poses must be base_from_hand (see `calib handeye --help`)",
    "other_unit": "write x, y, z in metres, or with --unit mm",
    "undetermined": "let the robot turn the camera more",
}
_UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}


@dataclasses.dataclass(frozen=True, kw_only=True)
class HandEyeOptions:
    """Finds where a calibrated camera sits on a robot's hand, or beside the robot, from photos of a board.

    POSES is a table with a line for each photo, and a first line that names its columns: name, x, y, z, qw, qx, qy, qz.
    `name` is the photo's, with or without suffix; x, y, z and the quaternion are base_from_hand, as robots report it:
    where the hand is in the frame of the base. The robot's own error is estimated along with everything else.
    """

    images: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="PHOTOS", help_behavior_hint="")]
    """Folders of photos, or photos, of the board."""

    poses: Annotated[Path, tyro.conf.arg(metavar="FILE", help_behavior_hint="(required)")]
    """The robot's poses, .csv."""

    board: Annotated[str, tyro.conf.arg(metavar="BOARD", help_behavior_hint="(required)")]
    """The .toml that `calib board` wrote, or the board in one word such as chessboard:9x6:25mm; see `calib detect
    --help`."""

    camera: Annotated[Path, tyro.conf.arg(metavar="FILE", help_behavior_hint="(required)")]
    """The camera, as `calib camera` wrote it. It is held."""

    eye_to_hand: Flag = False
    """The camera stands beside the robot and the board is in its hand; otherwise the camera is on the hand."""

    unit: Annotated[str, tyro.conf.arg(metavar="m|mm|cm")] = "m"
    """Of x, y, z in the table."""

    robot_mm: Annotated[float | None, tyro.conf.arg(metavar="MM", help_behavior_hint="")] = None
    """Standard deviation of the robot's positions on each axis, where it is known; only together with --robot-deg."""

    robot_deg: Annotated[float | None, tyro.conf.arg(metavar="DEG", help_behavior_hint="")] = None
    """The same of its orientations, about each axis."""

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = None
    """Writes the result as .toml."""

    json: Flag = False
    """Everything as JSON."""

    no_cache: Flag = False
    """Looks for the board anew, and keeps nothing."""

    threads: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 0)")] = 0
    """At most so many photos at once; 0 for all cores."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(HandEyeOptions, "handeye", words, EXAMPLES)
    _check(options)
    board = board_of(options.board)

    from calib.board_turns import board_turns
    from calib.circle_shifts import exact_centres
    from calib.cli.handeye_report import hand_eye_json, hand_eye_lines, hand_eye_toml
    from calib.cli.progress import kernels_announced, told
    from calib.cli.refusals import no_board
    from calib.cli.robot_poses import poses_of_photos, read_robot_poses
    from calib.cli.sightings import see_board
    from calib.hand_eye import HandEyeConfig, calibrate_hand_eye
    from sfm.io.atomic import check_writable, write_text
    from sfm.io.camera_files import read_intrinsics

    check_writable(options.output)
    table = read_robot_poses(options.poses, _UNITS[options.unit])
    cameras = read_intrinsics(options.camera)
    if len(cameras) != 1:
        raise ConfigError(f"holds {len(cameras)} cameras, one is needed", path=options.camera)
    observer = told()
    with kernels_announced(observer):
        seen = see_board(
            options.images, board, threads=options.threads, use_cache=not options.no_cache, observer=observer
        )
        if not seen.views:
            raise no_board(seen, options.images)
        exact = exact_centres(board, seen.views, next(iter(cameras.values())))
        views, poses, alone = poses_of_photos(exact, table, options.poses)
        config = HandEyeConfig(
            setup="eye_to_hand" if options.eye_to_hand else "eye_in_hand", robot_sigma=_robot_sigma(options)
        )
        found = calibrate_hand_eye(
            board.points3D, views, poses, next(iter(cameras.values())), config, turns=board_turns(board)
        )
    if isinstance(found, Rejected):
        remedy = _REMEDIES.get(found.reason, "check camera, board and photos with `calib check`")
        raise ReconstructionError(f"{found.reason}: {found.detail}", remedy=remedy)
    left_out = (*seen.left_out, *alone, *found.rejected)
    if options.output:
        write_text(options.output, hand_eye_toml(found, shlex.join(["calib", "handeye", *words])))
    if options.json:
        print(json.dumps(hand_eye_json(found, left_out), indent=2, ensure_ascii=False))
    else:
        print("\n".join([*hand_eye_lines(found, left_out), *(["", str(options.output)] if options.output else [])]))
    return ExitCode.OK


def _check(options: HandEyeOptions) -> None:
    if options.threads < 0:
        raise ConfigError(f"--threads must not be negative, got {options.threads}")
    if not options.images:
        raise ConfigError("no photos are named", remedy="name a folder of photos")
    if options.unit not in _UNITS:
        raise ConfigError(f"unknown --unit {options.unit!r}", remedy=f"known are {', '.join(_UNITS)}")
    if options.output and options.output.suffix.lower() != ".toml":
        raise ConfigError(f"-o must end in .toml, got {options.output}")
    if (options.robot_mm is None) != (options.robot_deg is None):
        raise ConfigError("--robot-mm and --robot-deg belong together")
    if any(value is not None and not 0 < value < 100 for value in (options.robot_mm, options.robot_deg)):
        raise ConfigError("--robot-mm and --robot-deg must be positive")


def _robot_sigma(options: HandEyeOptions) -> tuple[float, float] | None:
    import math

    if options.robot_mm is None or options.robot_deg is None:
        return None
    return math.radians(options.robot_deg), options.robot_mm / 1000
