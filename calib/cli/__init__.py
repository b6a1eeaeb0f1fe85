"""The `calib` command. This module imports nothing heavy: `calib --help` answers at once."""

from __future__ import annotations

from collections.abc import Sequence

from calib import __version__
from sfm.io.console import Console

COMMANDS = {
    "board": "a board to print: PDF or SVG at true scale",
    "detect": "the corners of a board in photos, and what they look like",
    "camera": "photos of a board → a camera, and how far to trust it",
    "check": "whether other photos agree with a camera, and which would help most",
    "report": "a calibration, of a camera or a rig, as one HTML page",
    "view": "the boards before the cameras, in the Rerun viewer",
    "stereo": "two cameras that are mounted together, and how they stand",
    "rig": "several such cameras, of any models",
    "handeye": "where a camera sits on a robot, from photos and the robot's poses",
    "undistort": "photos as a lens without distortion would have taken them",
    "convert": "a calibration in another program's file: OpenCV, ROS, Kalibr, COLMAP, nerfstudio",
}
"""In the order in which they are used; `calib.cli.<name>` holds each."""

_EXAMPLES = """\
Examples:
  calib board chessboard --cols 9 --rows 6 --square 25mm -o board.pdf
  calib camera photos --board board.toml -o camera.toml
  calib check camera.toml more_photos
  calib stereo left right --board board.toml -o rig.toml
  calib board --help               # the options of a command, with examples"""

_SEEK_BOARDS = ("detect", "camera", "check", "report", "view", "stereo", "rig", "handeye")
CONSOLE = Console(
    program="calib",
    version=__version__,
    title="Parallax calibration: printed board and photos in, calibrated camera out.",
    commands=COMMANDS,
    examples=_EXAMPLES,
    goes_on=lambda command, words: command in _SEEK_BOARDS and "--no-cache" not in words,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    return CONSOLE.main(arguments)
