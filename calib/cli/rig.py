"""`calib rig`: several cameras from photos of a board."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Sequence
from typing import Annotated

import tyro

from calib.cli.parsing import parsed
from calib.cli.rig_options import CommonOptions, named_sources
from calib.cli.rigging import run
from sfm.core.errors import ConfigError

EXAMPLES = (
    "calib rig cam0 cam1 cam2 --board aprilgrid:6x6:88mm:26.4mm -o rig.toml",
    "calib rig front=mav/cam0/data back=mav/cam1/data --board board.toml -o rig.toml",
    "calib rig cam* --board board.toml -o rig.toml --model opencv5,cam2=fisheye --camera cam0=cam0.toml",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RigOptions(CommonOptions):
    """Calibrates cameras that are mounted together, and how they stand, from photos of a board.

    Not all of them need see the board at once, nor any two of them ever, as long as others connect them. Models may
    differ. The rig's frame is that of the first camera.
    """

    cameras: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[NAME=]DIR", help_behavior_hint="")
    ]
    """A folder of photos for each camera, or a pattern in quotes. Names are what tells paths apart, unless given."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(RigOptions, "rig", words, EXAMPLES)
    if len(options.cameras) < 2:
        raise ConfigError("a rig has two cameras or more", remedy="name a folder for each; for one, `calib camera`")
    return run(options, named_sources(options.cameras), shlex.join(["calib", "rig", *words]))
