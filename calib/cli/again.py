"""A calibration made again from the file that it gave and the photos that it was made from.

A camera file tells the board, the lens model and the shape of the board, but not the corners. They come from the cache
of detections, so that to calibrate again takes seconds, and commands that show a calibration need no file of their own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np

from calib.boards import Board
from calib.cli.calibrating import CalibratedCamera, CameraPlan, calibrate_camera
from calib.cli.check_limits import board_of_record
from calib.cli.parsing import board_of
from calib.cli.refusals import no_camera
from calib.cli.sightings import Sightings, see_board
from calib.refine_board import SHAPES, ShapeKind
from calib.refine_lenses import lens_called
from calib.uncertainty import pixel_grid, projection_difference
from sfm.core.cameras import Camera
from sfm.core.errors import ConfigError, Rejected
from sfm.core.events import Note, Observer
from sfm.io.camera_files import read_camera_file
from sfm.io.camera_records import CameraRecord

SAME_PX = 1e-3
"""Of cameras whose difference is not worth a word."""


def calibrated_again(
    path: Path, sources: Sequence[Path], board: str, *, threads: int, observer: Observer
) -> tuple[CalibratedCamera, Sightings]:
    """The calibration behind a camera file.

    Where the photos give another camera than the file holds, that is said by a note, with the difference in px.

    Args:
        board: in one word, or empty for that of the file.
    Raises:
        SfmError: the file cannot be read or names no board, or the photos give no camera.
    """
    camera, record = read_camera_file(path)
    size = (camera.width, camera.height)
    seen = see_board(sources, _board(path, record, board), size=size, threads=threads, observer=observer)
    made = calibrate_camera(seen, _plan(camera, record), observer=observer) if seen.views else Rejected("no_board")
    if isinstance(made, Rejected):
        raise no_camera(seen, made, sources)
    differs = difference_px(camera, made.found.camera)
    if not differs <= SAME_PX:
        words = f"by {differs:.3g} px (rms over the image)" if differs == differs else "of another size"
        observer(Note(message=f"note: these photos give another camera than {path}, {words}; this one is shown"))
    told = record.facts.get("would_bring")
    return (dataclasses.replace(made, would_bring=(str(told),)) if told else made), seen


def _board(path: Path, record: CameraRecord, board: str) -> Board | None:
    """None where the corners' files say by themselves where they lie."""
    if board:
        return board_of(board)
    if record.board is None or not record.board.spec:
        raise ConfigError("names no board", path=path, remedy="name it with --board")
    return board_of_record(path, record)


def _plan(camera: Camera, record: CameraRecord) -> CameraPlan:
    lens = record.facts.get("lens") or camera.model
    known = record.board.shape if record.board is not None else "flat"
    shape = cast("ShapeKind", known) if known in SHAPES else "flat"
    try:
        return CameraPlan(lens=lens_called(str(lens)).name, shape=shape)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def difference_px(camera: Camera, again: Camera) -> float:
    """Rms over the image of where the two see the same, with frames aligned; NaN for images of different sizes."""
    if (camera.width, camera.height) != (again.width, again.height):
        return float("nan")
    pixels, _ = pixel_grid(camera, 12)
    apart = projection_difference(camera, again, pixels)
    return float(np.sqrt(np.nanmean(np.sum(apart**2, axis=1))))
