"""The `calib` command."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from calib import __version__
from sfm.core.errors import ExitCode

HELP = """\
Parallax calibration: printed board and photos in, calibrated camera out.

Usage: calib --help | --version

There is nothing here yet. Planned: boards to print, their detection in photos, calibration of cameras and rigs with
covariance, and checks on photos that were held out.

Meanwhile:
  sfm run photos -o scene                              # estimates focal length and distortion
  sfm run photos -o scene --intrinsics cameras.txt     # uses a calibration that you have"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    match list(sys.argv[1:] if arguments is None else arguments):
        case ["-h" | "--help" | "help"]:
            print(HELP)
            return ExitCode.OK
        case ["--version" | "-V"]:
            print(f"calib {__version__} (Parallax)")
            return ExitCode.OK
    print("error: calib has no commands yet — see calib --help", file=sys.stderr)
    return ExitCode.USAGE
