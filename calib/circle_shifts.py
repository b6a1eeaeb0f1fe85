"""Centres of circles from centroids of their images, exactly, once there is a camera.

Detection takes off the shift of each centroid (`detect_circles`) by the lens with one coefficient that fits a photo
best. With a camera and the pose of the board the image of each disc is known, and with it the shift: the first is put
back and this is taken off. It takes a camera that is right to a percent only, as shifts are a pixel at most.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from calib.boards import Board
from calib.detect_circles import centroid_shifts, shifts_by_one_lens
from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_board import board_shape
from calib.refine_views import BoardView, gather
from calib.uncertainty_holdout import fit_poses
from sfm.core.arrays import FloatArray, Points2D, Vector
from sfm.core.cameras import Camera

TRIED = ("opencv5", "fisheye")
"""Lenses of which the better one is close enough to any."""


def with_exact_centres(
    board: Board | None, views: Sequence[BoardView], config: CalibrationConfig, *, lenses: Sequence[str] = TRIED
) -> tuple[BoardView, ...]:
    """Views with the centres that a camera gives which is calibrated from them; as they are where there is none.

    Args:
        board: that of the views; nothing is done to corners.
        config: its lens does not count.
        lenses: of them, the one that fits best is taken.
    """
    if board is None or not board.has_circles:
        return tuple(views)
    given = dataclasses.replace(config, shape="flat")
    found = [calibrate(board.points3D, views, dataclasses.replace(given, lens=lens)) for lens in lenses]
    able = [one for one in found if isinstance(one, Calibration)]
    if not able:
        return tuple(views)
    first = min(able, key=lambda one: one.rms_px)
    better = exact_centres(board, views, first.camera)
    # The first camera is off by what is corrected here; of the second that is a tenth.
    second = calibrate(board.points3D, better, dataclasses.replace(given, lens=first.lens))
    return exact_centres(board, views, second.camera) if isinstance(second, Calibration) else better


def exact_centres(board: Board | None, views: Sequence[BoardView], camera: Camera) -> tuple[BoardView, ...]:
    """Views with the centres of circles as this camera saw them.

    Views of another size, or that this camera cannot have seen, stay as they are; so do those of corners.
    """
    if board is None or not board.has_circles:
        return tuple(views)
    alike = [view for view in views if (view.width, view.height) == (camera.width, camera.height)]
    observations = gather(board.points3D, alike)
    system, seen = fit_poses(camera, board_shape("flat", board.points3D), observations)
    estimate = system.estimate
    better = {
        id(alike[v]): _redone(board, alike[v], camera, R, t)
        for v, R, t in zip(seen, estimate.rotations, estimate.translations, strict=True)
    }
    return tuple(better.get(id(view), view) for view in views)


def _redone(board: Board, view: BoardView, camera: Camera, R: FloatArray, t: Vector) -> BoardView:
    def image(points: Points2D) -> Points2D:
        pixels, valid = camera.project(points @ R[:, :2].T + t)
        return np.where(valid[:, None], pixels, np.nan)

    on_board, radius = board.points3D[view.corner_ids, :2], board.detail_m / 2
    taken_off = shifts_by_one_lens(view.points2D, on_board, radius, (view.width, view.height))
    change = taken_off - centroid_shifts(image, on_board, radius)
    return dataclasses.replace(view, points2D=view.points2D + np.where(np.isfinite(change), change, 0.0))
