"""Calibration of one camera from photos of a board: from corners to a camera, poses, the board's shape, and doubts.

    sort out views → start (`zhang`) → read all from one end (`refine_turns`) → release parameters, at first on some
    views → all views → reject → verdict

What is rejected is told with its reason. Where the views leave the principal point open it is held at the centre of the
image, and where they leave the focal length open there is no camera: `Rejected`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from calib.refine_board import BoardShape, board_shape
from calib.refine_checks import check_determined
from calib.refine_fit import CalibrationConfig, Fit, solve_from_start, turned_back
from calib.refine_lenses import lens_by_name
from calib.refine_reject import RejectedView, reject_outliers, sort_out
from calib.refine_system import CalibrationSystem, Estimate
from calib.refine_turns import read_alike
from calib.refine_views import BoardView, Observations
from calib.zhang import Homographies, find_start
from sfm.core.arrays import Points3D, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.optim.levenberg_marquardt import Summary

__all__ = ["Calibration", "CalibrationConfig", "RejectedView", "calibrate"]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Calibration(Value):
    """A camera with what it was made from.

    Attributes:
        cams_from_board: batch (V,), in the board's unit, of the views of `observations`.
        free_names: the parameters that were estimated; the others are as they started.
        observations: of the views and corners that were used.
        residuals: (n, 2) projected − observed, px.
        rejected_views, rejected_corners: what was left out; corners as (name of the view, row of the board's point).
        rms_px: root of the mean squared length of residuals, as OpenCV has it.
        sigma_px: standard deviation of one coordinate, √(Σ r² / (2 n − parameters)); whitened where covariances differ.
        rung: how the start was found; see `zhang`.
        fallbacks: what was not estimated as asked, or rests on little, in words.
        converged: another step, undamped, promises less than a billionth of the cost. It is False where the solution is
            held back by `keep_invertible`: the lens model has more coefficients than the photos can bear.
        keep_invertible: as it was calibrated; see `CalibrationConfig`.
        turned_views: that read the board from another end than they were given with; see `refine_turns`. Rows of
            `observations` and of `rejected_corners` are those of the end that all read it from.
    """

    lens: str
    camera: Camera
    cams_from_board: Rigid3
    shape: BoardShape
    free_names: tuple[str, ...]
    observations: Observations
    residuals: Float64[np.ndarray, "n 2"]
    rejected_views: tuple[RejectedView, ...]
    rejected_corners: tuple[tuple[str, int], ...]
    rms_px: float
    sigma_px: float
    rung: str
    fallbacks: tuple[str, ...]
    converged: bool
    iterations: int
    cost: float
    keep_invertible: bool = True
    turned_views: tuple[str, ...] = ()

    @property
    def estimate(self) -> Estimate:
        """As the solver wants it."""
        poses = self.cams_from_board
        return Estimate(self.camera, poses.rotation.matrix, np.array(poses.translation), self.shape)

    @property
    def columns(self) -> np.ndarray:
        """Positions of the free parameters."""
        return np.flatnonzero([name in self.free_names for name in self.camera.model_info.param_names])

    @property
    def view_rms_px(self) -> Vector:
        """(V,) as `rms_px`, of each view."""
        sums = np.bincount(self.observations.view_of, np.sum(self.residuals**2, 1), len(self.observations))
        return np.sqrt(sums / np.diff(self.observations.offsets))

    def system(self) -> CalibrationSystem:
        """The problem at its solution."""
        return CalibrationSystem(
            self.observations, self.estimate, self.columns, free_shape=len(self.shape.coefficients) > 0,
            keep_invertible=self.keep_invertible,
        )  # fmt: skip


def calibrate(
    board: Points3D, views: Sequence[BoardView], config: CalibrationConfig = CalibrationConfig()
) -> Calibration | Rejected:
    """The camera that took photos of a board.

    Args:
        board: (N, 3) its points in metres, or in any other unit; z = 0.
        views: photos of it; those of another size than most are rejected.
    Returns:
        `too_few_views`, with what is wrong with the views that cannot be used; `undetermined_focal` where the boards
        are parallel to one another or to the image; `no_solution` where the minimum was not found.
    Raises:
        ValueError: the lens or the shape is unknown, a corner is not of the board, or the board is not flat.
    """
    lens = lens_by_name(config.lens)
    if np.any(board[:, 2] != 0):
        raise ValueError("the board's points must have z = 0; its shape is estimated")
    observations, homographies, rejected = sort_out(board, views, config)
    if len(observations) < config.min_views:
        return Rejected("too_few_views", _told(len(observations), config.min_views, rejected))
    start = find_start(observations, homographies, lens, config.focal_px)
    if isinstance(start, Rejected):
        return start
    fit = Fit(lens, config, start, board_shape("flat", board)).for_corners(observations)
    alike = read_alike(fit, observations, homographies)
    turned_views = _renamed(observations, alike[0]) if alike is not None else []
    if alike is not None:
        observations = alike[0]
        fit = fit.for_corners(observations)
    solved = _solved(fit, observations, homographies, alike[1] if alike is not None else None)
    if isinstance(solved, Rejected):
        return solved
    system, summary = solved
    turned = turned_back(fit, system)
    if turned is not None:
        system, summary = fit.solve(observations, turned)
    corners: list[tuple[str, int]] = []
    if config.reject:
        system, summary, more = reject_outliers(fit, system, summary, corners)
        rejected += more
        if len(system.observations) < config.min_views:
            return Rejected("too_few_views", _told(len(system.observations), config.min_views, rejected))
        fit = fit.for_corners(system.observations)
    checked = check_determined(fit, system, summary)
    if isinstance(checked, Rejected):
        return checked
    system, summary, columns, fallbacks = checked
    if start.rung == "tried" and lens.start == "perspective":
        fallbacks = (
            f"focal lengths were tried for a start, since {start.detail or 'the closed form failed'}",
            *fallbacks,
        )
    found = _result(fit, system, summary, columns, rejected, corners, fallbacks)
    return dataclasses.replace(found, turned_views=tuple(n for n in turned_views if n in found.observations.names))


def _solved(
    fit: Fit, observations: Observations, homographies: Homographies, near: Estimate | None
) -> tuple[CalibrationSystem, Summary] | Rejected:
    """Least squares, from an estimate nearby where there is one."""
    if near is not None:
        near = dataclasses.replace(near, shape=fit.shape.moved_as(near.shape.displacements))
        system, summary = fit.solve(observations, near)
        if system.is_at_minimum(summary.final_cost):
            return system, summary
    # In what is taken from homographies a turn of the board in its plane changes nothing.
    return solve_from_start(fit, observations, homographies)


def _renamed(before: Observations, after: Observations) -> list[str]:
    """Views whose corners are other ones now."""
    changed = np.bincount(before.view_of, before.rows != after.rows, len(before))
    return [name for name, count in zip(before.names, changed, strict=True) if count]


def _told(count: int, needed: int, rejected: Sequence[RejectedView]) -> str:
    reasons = "; ".join(f"{view.name}: {view.reason} {view.detail}".strip() for view in rejected[:5])
    return f"{count} of {needed} needed" + (f" ({reasons})" if reasons else "")


def _result(
    fit: Fit, system: CalibrationSystem, summary: Summary, columns: np.ndarray, rejected: list[RejectedView],
    corners: list[tuple[str, int]], fallbacks: tuple[str, ...],
) -> Calibration:  # fmt: skip
    observations, residuals = system.observations, system.residuals()
    estimate = system.estimate
    names = estimate.camera.model_info.param_names
    freedom = 2 * len(observations.rows) - 6 * len(observations) - system.shared_count
    return Calibration(
        lens=fit.lens.name,
        camera=estimate.camera,
        cams_from_board=estimate.cams_from_board,
        shape=estimate.shape,
        free_names=tuple(names[k] for k in columns),
        observations=observations,
        residuals=residuals,
        rejected_views=tuple(rejected),
        rejected_corners=tuple(corners),
        rms_px=math.sqrt(float(np.sum(residuals**2)) / len(residuals)),
        sigma_px=math.sqrt(2 * summary.final_cost / freedom) if freedom > 0 else math.nan,
        rung=fit.start.rung,
        fallbacks=fallbacks,
        converged=system.is_at_minimum(summary.final_cost),
        iterations=len(summary.iterations) - 1,
        cost=summary.final_cost,
        keep_invertible=fit.config.keep_invertible,
    )
