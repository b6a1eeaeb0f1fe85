"""Each camera of a rig by itself: its own calibration, or its poses where it is known already."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from calib.refine import Calibration, calibrate
from calib.refine_board import BoardShape, board_shape, shape_shown
from calib.refine_fit import ROBUST, CalibrationConfig, Fit, turned_back
from calib.refine_lenses import lens_by_name
from calib.refine_reject import RejectedView, sort_out
from calib.refine_system import Estimate
from calib.refine_views import BoardView, Observations
from calib.rig_views import RigCamera
from calib.zhang import Start
from sfm.core.arrays import Points3D, Value
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.optim.levenberg_marquardt import minimize

_POSES_ONLY = np.zeros(0, np.int64)
_LEAST_SIGMA_PX = 1e-3
"""Corners are not known better; the noise of perfect ones says nothing."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class AloneCamera(Value):
    """What one camera says without the others.

    Attributes:
        observations: of the views that can be used.
        frames: the frame of each of them.
        cams_from_board: batch (V,).
        columns: positions of its parameters that a rig refines.
        sigma_px: of its corners' residuals.
        rejected: views that cannot be used.
        calibration: its own, None where the camera was known.
    """

    name: str
    camera: Camera
    observations: Observations
    frames: tuple[str, ...]
    cams_from_board: Rigid3
    columns: np.ndarray
    sigma_px: float
    rejected: tuple[RejectedView, ...]
    calibration: Calibration | None
    fallbacks: tuple[str, ...] = ()


def camera_alone(
    board: Points3D, seen: RigCamera, config: CalibrationConfig, refine_known: bool
) -> AloneCamera | Rejected:
    """Calibrates one camera, or finds the boards' poses before a known one.

    Returns:
        `camera_without_board` where no view shows it; else what `calibrate` refuses for, with the camera's name.
    """
    if not seen.views:
        return Rejected("camera_without_board", f"{seen.name} sees the board in none of its photos")
    views = list(seen.views)
    frame_of = dict(zip((view.name for view in seen.views), seen.frames, strict=True))
    found = _known(board, seen, views, config) if seen.camera is not None else _new(board, seen, views, config)
    if isinstance(found, Rejected):
        return Rejected(found.reason, f"{seen.name}: {found.detail}")
    names = found.observations.names
    keep_columns = seen.camera is None or refine_known
    return dataclasses.replace(
        found,
        frames=tuple(frame_of[name] for name in names),
        columns=found.columns if keep_columns else _POSES_ONLY,
    )


def _new(board: Points3D, seen: RigCamera, views: list[BoardView], config: CalibrationConfig) -> AloneCamera | Rejected:
    found = calibrate(board, views, dataclasses.replace(config, lens=seen.lens))
    if isinstance(found, Rejected):
        return found
    return AloneCamera(
        seen.name, found.camera, found.observations, (), found.cams_from_board, found.columns,
        max(found.sigma_px, _LEAST_SIGMA_PX), found.rejected_views, found,
        tuple(f"{seen.name}: {words}" for words in found.fallbacks),
    )  # fmt: skip


def _known(
    board: Points3D, seen: RigCamera, views: list[BoardView], config: CalibrationConfig
) -> AloneCamera | Rejected:
    camera = seen.camera
    assert camera is not None
    size = (camera.width, camera.height)
    other = [
        RejectedView(view.name, "other_size", f"{view.width}x{view.height}, the camera is {size[0]}x{size[1]}")
        for view in views if (view.width, view.height) != size
    ]  # fmt: skip
    fitting = [view for view in views if (view.width, view.height) == size]
    if not fitting:
        return Rejected("other_size", other[0].detail)
    observations, homographies, rejected = sort_out(board, fitting, config)
    if not len(observations):
        return Rejected("too_few_views", "; ".join(f"{view.name}: {view.reason}" for view in rejected[:5]))
    lens = lens_by_name(seen.lens)
    fit = Fit(lens, config, Start(camera, "given"), board_shape("flat", board))
    robust = config.reject and bool(np.isinf(homographies.errors).any())
    estimate = fit.placed(observations, camera, robust)
    if isinstance(estimate, Rejected):
        return estimate
    estimate = _poses_only(fit, observations, estimate)
    system = fit.system(observations, estimate, columns=_POSES_ONLY)
    freedom = 2 * len(observations.rows) - 6 * len(observations)
    sigma = math.sqrt(2 * system.view_costs.sum() / freedom) if freedom > 0 else math.nan
    fits_lens = lens.model == camera.model
    columns = lens.columns() if fits_lens else np.arange(len(camera.params))
    return AloneCamera(
        seen.name, camera, observations, (), estimate.cams_from_board, columns,
        max(sigma, _LEAST_SIGMA_PX), (*other, *rejected), None,
    )  # fmt: skip


def _poses_only(fit: Fit, observations: Observations, estimate: Estimate) -> Estimate:
    system = fit.system(observations, estimate, columns=_POSES_ONLY, loss="cauchy", scale=2.0)
    minimize(system, ROBUST)
    turned = turned_back(fit, system)
    if turned is None:
        return system.estimate
    system = fit.system(observations, turned, columns=_POSES_ONLY, loss="cauchy", scale=2.0)
    minimize(system, ROBUST)
    return system.estimate


def shape_of(config: CalibrationConfig, board: Points3D, cameras: Sequence[AloneCamera]) -> BoardShape:
    """The undeformed board of the family that was asked for; points that fewer than two views show do not move."""
    return shape_shown(config.shape, board, np.sum([one.observations.shown for one in cameras], axis=0))
