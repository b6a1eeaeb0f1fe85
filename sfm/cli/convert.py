"""`sfm convert`: a model from one format to another."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from sfm.cli.parsing import Flag, parsed
from sfm.core.errors import ConfigError, ExitCode

EXAMPLES = (
    "sfm convert scene/sparse/0 scene-text",
    "sfm convert scene points.ply",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ConvertOptions:
    """COLMAP binary ↔ text, or a point cloud.

    The target tells the format: a name that ends in .ply is a point cloud; a folder is a COLMAP model, text if the
    source is binary and binary if it is text.
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IN", help_behavior_hint="")]
    """A workspace, or the folder of a COLMAP model."""

    target: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT", help_behavior_hint="")]
    """A folder, or a file that ends in .ply."""

    text: Flag = False
    """Write COLMAP text."""

    binary: Flag = False
    """Write COLMAP binary."""

    overwrite: Flag = False
    """Replace what is there."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(ConvertOptions, "convert", words, EXAMPLES)
    if options.text and options.binary:
        raise ConfigError("--text and --binary exclude each other")
    from sfm.cli.compare import model_folder
    from sfm.io.atomic import check_writable
    from sfm.io.convert import convert, is_point_cloud

    check_writable(options.target if is_point_cloud(options.target) else options.target / "cameras.bin")
    source = options.source if is_point_cloud(options.source) else model_folder(options.source)
    text = options.text if options.text or options.binary else None
    kind = convert(source, options.target, text=text, overwrite=options.overwrite)
    names = {"ply": "a PLY point cloud", "txt": "a COLMAP text model", "bin": "a COLMAP binary model"}
    print(f"{options.target}: {names[kind]}")
    return ExitCode.OK
