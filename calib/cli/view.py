"""`calib view`: a calibration in the Rerun viewer."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from calib.cli.parsing import Flag, parsed
from sfm.core.errors import ConfigError, ExitCode, ImageError

if TYPE_CHECKING:
    from sfm.core.arrays import ImageU8
    from sfm.core.events import Observer
    from sfm.viz.rerun_boards import BoardScene

EXAMPLES = (
    "calib view camera.toml photos",
    "calib view camera.toml photos --save boards.rrd",
    "calib view camera.toml photos --web",
    "calib view rig.toml left right",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Boards as they stood before the cameras, photos and residuals, in the Rerun viewer; all stays on this machine."""

    camera: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
    """What `calib camera`, `calib stereo` or `calib rig` wrote."""

    images: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="IMAGES", help_behavior_hint="")]
    """The photos that it was made from, or their folders; of a rig [NAME=]DIR or a pattern for each camera."""

    board: Annotated[str, tyro.conf.arg(metavar="BOARD", help_behavior_hint="(default: that of the file)")] = ""
    """What is in the photos."""

    save: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    """Write the scene to a file for the viewer, e.g. boards.rrd, and do not show it."""

    web: Flag = False
    """Show it in the browser, at an address of this machine that is printed."""

    threads: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 0)")] = 0
    """At most so many photos at once; 0 for all cores."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(ViewOptions, "view", words, EXAMPLES)
    if options.save and options.web:
        raise ConfigError("--save and --web exclude each other")
    if not options.images:
        raise ConfigError("no photos are named", remedy="name the folder of photos after the camera file")

    from calib.cli.progress import told
    from sfm.io.atomic import check_writable
    from sfm.io.rig_files import is_rig_file
    from sfm.viz.rerun_boards import log_boards

    check_writable(options.save)
    scene, files = (_rig if is_rig_file(options.camera) else _camera)(options, told())

    def photo(camera: str, name: str) -> ImageU8:
        from calib.cli.photos import photos_of

        found = photos_of(files[camera], [name])
        if name not in found:
            raise ImageError("is not there any more", path=name)
        return found[name]

    show = not (options.save or options.web)
    log_boards(scene, photo, save=options.save, web=options.web, spawn=show, announce=lambda at: print(at, flush=True))
    if options.save:
        print(options.save)
    return ExitCode.OK


def _camera(options: ViewOptions, observer: Observer) -> tuple[BoardScene, Mapping[str, Sequence[Path]]]:
    """The scene, and of each camera the photos or their folders."""
    from calib.cli.again import calibrated_again
    from calib.cli.progress import kernels_announced
    from calib.cli.scenes import camera_scene

    with kernels_announced(observer):
        made, seen = calibrated_again(
            options.camera, options.images, options.board, threads=options.threads, observer=observer
        )
    name = options.camera.stem
    return camera_scene(name, made, seen.board), {name: options.images}


def _rig(options: ViewOptions, observer: Observer) -> tuple[BoardScene, Mapping[str, Sequence[Path]]]:
    from calib.cli.progress import kernels_announced
    from calib.cli.rig_again import rig_again
    from calib.cli.scenes import rig_scene

    with kernels_announced(observer):
        words = [str(source) for source in options.images]
        made = rig_again(options.camera, words, options.board, threads=options.threads, observer=observer)
    return rig_scene(options.camera.stem, made), made.files
