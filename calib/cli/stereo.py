"""`calib stereo`: a pair of cameras from photos of a board."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from typing import Annotated

import tyro

from calib.cli.parsing import parsed
from calib.cli.rig_options import CommonOptions
from calib.cli.rigging import run

EXAMPLES = (
    "calib stereo left right --board chessboard:9x6:25mm -o rig.toml",
    "calib stereo 'photos/left*.jpg' 'photos/right*.jpg' --board board.toml -o rig.toml --json",
    "calib stereo left right --board board.toml -o rig.toml --camera left=left.toml --camera right=right.toml",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StereoOptions(CommonOptions):
    """Calibrates two cameras that are mounted together, and how they stand, from photos of a board.

    The rig's frame is that of the left camera. Beside baseline and rotation: how uncertain they are, how far partners
    lie from each other's epipolar line and from the same row after rectification, and what was left out and why.
    """

    left: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="LEFT", help_behavior_hint="")]
    """Folder of the left camera's photos, or a pattern in quotes."""

    right: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="RIGHT", help_behavior_hint="")]
    """The same for the right camera."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(StereoOptions, "stereo", words, EXAMPLES)
    return run(options, {"left": options.left, "right": options.right}, shlex.join(["calib", "stereo", *words]))
