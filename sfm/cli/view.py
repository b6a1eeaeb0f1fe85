"""`sfm view`: look at a workspace in the Rerun viewer."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from sfm.cli.compare import model_folder
from sfm.cli.parsing import Flag, Model, parsed
from sfm.core.errors import ConfigError, ExitCode, ImageError

EXAMPLES = (
    "sfm view scene",
    "sfm view scene --save scene.rrd",
    "sfm view scene --web",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Points, cameras and photos in the Rerun viewer; nothing leaves this machine."""

    workspace: Model
    """A workspace, or the folder of a COLMAP model."""

    images: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """The photos; by default those that the workspace was made from."""

    save: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Write the scene to a file for the viewer, e.g. scene.rrd, and do not show it."""

    web: Flag = False
    """Show it in the browser, at an address of this machine that is printed."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(ViewOptions, "view", words, EXAMPLES)
    if options.save and options.web:
        raise ConfigError("--save and --web exclude each other")
    from sfm.core.arrays import ImageU8
    from sfm.io.atomic import check_writable
    from sfm.io.colmap_model import read_model
    from sfm.io.images import read_image
    from sfm.viz.rerun_log import log_reconstruction

    check_writable(options.save)
    model = read_model(model_folder(options.workspace))
    folder = options.images or images_folder(options.workspace)

    def photo(name: str) -> ImageU8:
        if folder is None:
            raise ImageError("the folder of the photos is not known", remedy="name it with --images")
        return read_image(folder / name)

    def announce(address: str) -> None:
        print(address, flush=True)
        print("served until Ctrl-C", file=sys.stderr)

    log_reconstruction(
        model, photo, save=options.save, web=options.web, spawn=not (options.save or options.web), announce=announce
    )
    if options.save:
        print(options.save)
    return ExitCode.OK


def images_folder(workspace: Path) -> Path | None:
    """The photos that a workspace was made from, as its manifest says; None if it has none."""
    try:
        return Path(json.loads((workspace / "manifest.json").read_text(encoding="utf-8"))["images_folder"])
    except (OSError, ValueError, KeyError):
        return None
