"""`calib view`: a calibration in the Rerun viewer."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from calib.cli.parsing import Flag, parsed
from sfm.core.errors import ConfigError, ExitCode, ImageError

if TYPE_CHECKING:
    from calib.boards import Board
    from calib.cli.calibrating import CalibratedCamera
    from sfm.viz.rerun_boards import BoardScene

EXAMPLES = (
    "calib view camera.toml photos",
    "calib view camera.toml photos --save boards.rrd",
    "calib view camera.toml photos --web",
)
_WORST_SIGMAS = 4.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Boards as they stood before the camera, photos and residuals in the Rerun viewer; nothing leaves this machine."""

    camera: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAMERA", help_behavior_hint="")]
    """Camera file that `calib camera` wrote."""

    images: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="IMAGES", help_behavior_hint="")]
    """The photos that it was made from, or their folders."""

    board: Annotated[str, tyro.conf.arg(metavar="BOARD", help_behavior_hint="(default: that of the camera file)")] = ""
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

    from calib.cli.again import calibrated_again
    from calib.cli.photos import photos_of
    from calib.cli.progress import kernels_announced, told
    from sfm.core.arrays import ImageU8
    from sfm.viz.rerun_boards import log_boards

    observer = told()
    with kernels_announced(observer):
        made, seen = calibrated_again(
            options.camera, options.images, options.board, threads=options.threads, observer=observer
        )

    def photo(camera: str, name: str) -> ImageU8:
        found = photos_of(options.images, [name])
        if name not in found:
            raise ImageError("is not there any more", path=name)
        return found[name]

    scene = scene_of(options.camera.stem, made, seen.board)
    show = not (options.save or options.web)
    log_boards(scene, photo, save=options.save, web=options.web, spawn=show, announce=lambda at: print(at, flush=True))
    if options.save:
        print(options.save)
    return ExitCode.OK


def scene_of(name: str, made: CalibratedCamera, board: Board | None) -> BoardScene:
    """The calibration as a scene whose world is the camera's frame."""
    import numpy as np

    from sfm.core.geometry.rigid import Rigid3
    from sfm.viz.rerun_boards import BoardPhoto, BoardScene, grid_lines

    found = made.found
    views, offsets = found.observations, found.observations.offsets
    photos = tuple(
        (BoardPhoto(name, shown, views.points2D[a:b], found.residuals[a:b]),)
        for shown, a, b in zip(views.names, offsets[:-1], offsets[1:], strict=True)
    )
    columns, rows = board.grid if board is not None else (0, 0)
    lines = grid_lines(columns, rows) if board is not None else np.zeros((0, 2), np.int64)
    if board is not None and board.kind == "aprilgrid":
        corners = 4 * np.arange(board.columns * board.rows)[:, None]
        lines = np.concatenate([np.stack([corners + k, corners + (k + 1) % 4], 2)[:, 0] for k in range(4)])
    told = "\n".join(f"- {finding.cause.replace('_', ' ')}: {finding.detail}" for finding in made.findings)
    return BoardScene(
        cameras={name: found.camera},
        cams_from_world=Rigid3.identity((1,)),
        points3D=found.shape.points3D,
        lines=lines,
        worlds_from_board=found.cams_from_board,
        photos=photos,
        names=views.names,
        worst_px=_WORST_SIGMAS * found.sigma_px,
        report=f"# {name}\n\n{found.camera.model}, rms {found.rms_px:.4f} px, {len(views)} photos\n\n{told}\n",
    )
