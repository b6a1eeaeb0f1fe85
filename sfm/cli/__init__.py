"""The `sfm` command. This module imports nothing heavy: `sfm --help` answers at once."""

from __future__ import annotations

from collections.abc import Sequence

from sfm import __version__
from sfm.io.console import Console

COMMANDS = {
    "run": "photos → camera poses and a sparse model",
    "features": "the first stage alone: keypoints of all photos",
    "pairs": "the next: which pairs of photos are to be matched",
    "match": "the next: matches of these pairs",
    "verify": "the next: which matches a rigid scene explains, and how",
    "inspect": "photos: sharpness, exposure, EXIF, copies, what cannot be read",
    "refine": "bundle adjustment of any COLMAP model",
    "view": "look at a workspace in the Rerun viewer",
    "compare": "pose errors of a model against a reference",
    "convert": "a model from one format to another: COLMAP binary, text, PLY",
    "doctor": "what is installed, what is missing and how to get it",
}
"""In the order in which they are used; `sfm.cli.<name>` holds each."""

_EXAMPLES = """\
Examples:
  sfm run photos -o scene          # reconstruct a folder of photos
  sfm view scene                   # look at the result
  sfm run --help                   # the options of a command, with examples"""

_STAGES = ("run", "features", "pairs", "match", "verify")
CONSOLE = Console(
    program="sfm",
    version=__version__,
    title="Parallax: structure from motion, photos in, camera poses and geometry out.",
    commands=COMMANDS,
    examples=_EXAMPLES,
    goes_on=lambda command, words: command in _STAGES,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    return CONSOLE.main(arguments)
