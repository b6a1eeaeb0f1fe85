"""The `stereo` command."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from sfm.core.errors import ExitCode
from sfm.io.console import guarded
from stereo import __version__

HELP = """\
Parallax stereo: rectified pair in, disparity and depth out; reconstruction in, dense cloud and mesh out.

Usage: stereo --help | --version

There is nothing here yet. Planned: rectification, disparity by block and semi-global matching, optical flow, depth
from many views, fusion and meshes.

Meanwhile:
  sfm run photos -o scene          # camera poses and a sparse cloud
  sfm convert scene points.ply     # the cloud for other programs"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    return guarded(lambda: _answer(words), "stereo", words)


def _answer(words: list[str]) -> int:
    match words:
        case ["-h" | "--help" | "help"]:
            print(HELP)
            return ExitCode.OK
        case ["--version" | "-V"]:
            print(f"stereo {__version__} (Parallax)")
            return ExitCode.OK
    print("error: stereo has no commands yet — see stereo --help", file=sys.stderr)
    return ExitCode.USAGE
