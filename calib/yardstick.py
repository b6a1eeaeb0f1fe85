"""Is what a calibration does not explain the lens, or the board and its corners? A splined lens is the yardstick.

A lens that follows any smooth one (`yardstick_spline`) is put on top of the calibrated one, and both predict the
corners of views that were held out. If it predicts no better, no lens model will. If it does, its difference to the
calibrated camera says by how many pixels, and where in the image, as far as these photos can tell.

That holds only while the board does not pass for the lens. With boards, poses and noise of real sets, the lens exactly
right and a board whose corners lie 0.1 mm beside the best paraboloid, the splined lens lowers held-out errors by up to
4 %, by up to three standard errors, and leads away from the truth. With every corner of the board free it raises them
by 0.2 to 3 % in all trials; where the lens is off by 0.1 px (rms) it lowers them by 2 to 18 %. So the comparison is
made with a free board, unless that predicts worse than the board as it was calibrated: then there is nothing in it to
be taken for the lens.

Reference:
    Kogan, mrcal, A tour of mrcal (documentation): a splined lens beside a lean one, and the difference between them.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float64

from calib.coverage import coverage
from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_board import BoardShape, ShapeKind, board_shape
from calib.refine_system import CalibrationSystem
from calib.refine_views import BoardView
from calib.uncertainty import pixel_grid, projection_difference
from calib.uncertainty_choice import is_clearly_lower
from calib.uncertainty_holdout import fit_poses, read_as_suits, views_of
from calib.uncertainty_shapes import free_is_too_large
from calib.yardstick_spline import SplinedLens, SplinedSystem
from sfm.core.arrays import FloatArray, Points2D, Points3D, Value, Vector, readonly
from sfm.core.errors import Rejected
from sfm.core.geometry.rotation import Rotation3, skew
from sfm.core.optim.levenberg_marquardt import StopRules, minimize

_RULES = StopRules(max_iterations=40, relative_cost_tolerance=1e-6, gradient_tolerance=0.0)
_TO_THE_END = StopRules(max_iterations=100, relative_cost_tolerance=1e-8, gradient_tolerance=0.0)
_NEAR = 1e-6
"""Damping near the minimum over the usual one."""
_CLEAR = 2.0
"""Standard errors by which the splined lens has to be better."""
_NOTABLE = 0.98
"""Of the held-out error, below which it stays open whether it is the lens though it may be chance."""
_ACROSS = 24
"""Cells of the image's width in which the two are compared."""
_ALIGNMENTS = 8


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Yardstick(Value):
    """A calibrated lens beside a splined one, both with the same shape of the board.

    Attributes:
        shape: of the board, for both.
        lens_rms_px, splined_rms_px: errors of views that were held out.
        coefficients: of the splined lens.
        is_lens: whether the splined one is clearly better.
        differences: (Y, X) px between the two over the image, for what is far away, frames aligned; NaN in cells
            without a corner.
        worst_at: where they are largest, px.
        held_out_px: error of views that were held out of the calibration as it was.
        board_px: rms where corners were by which this shape of the board moves the calibrated camera, for what is far
            away, frames aligned; 0 where it is the shape that it has.
    """

    lens: str
    shape: ShapeKind
    lens_rms_px: float
    splined_rms_px: float
    coefficients: int
    is_lens: bool
    differences: Float64[np.ndarray, "Y X"]
    worst_at: tuple[float, float]
    held_out_px: float
    board_px: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "differences", readonly(self.differences, (None, None)))

    @property
    def differs_px(self) -> float:
        """Rms of the differences."""
        return math.sqrt(float(np.nanmean(self.differences**2)))

    @property
    def worst_px(self) -> float:
        """The largest of the differences."""
        return float(np.nanmax(self.differences))

    @property
    def of_lens(self) -> str:
        """What follows for the lens, in words."""
        errors = f"held-out {self.lens_rms_px:.4f} px with {self.lens}, {self.splined_rms_px:.4f} px splined"
        apart = f"{self.differs_px:.2g} px (rms where corners were)"
        if not self.is_lens:
            told = f"the two differ by {apart}, and these photos cannot tell which is right"
            is_better = self.splined_rms_px < _NOTABLE * self.lens_rms_px
            return f"{'open' if is_better else 'no error of the lens shows'}: {errors}; {told}"
        worst = f"{self.worst_px:.2g} px near ({self.worst_at[0]:.0f}, {self.worst_at[1]:.0f})"
        shape = ", with --shape free," if self.shape == "free" else ""
        return f"{errors}: {self.lens} is off by about {apart}, {worst}; a richer --model{shape} would help"

    @property
    def of_board(self) -> str:
        """What follows for the board, in words; empty where it was free from the start."""
        if self.board_px == 0.0:
            return "" if self.shape == "free" else "corners that are free predict photos held out no better"
        before = f" and takes the held-out error from {self.held_out_px:.4f} to {self.lens_rms_px:.4f} px"
        told = before if math.isfinite(self.held_out_px) else ""
        return f"freeing its corners moves the camera by {self.board_px:.2g} px (rms where corners were){told}"


def measure_lens(
    board: Points3D, found: Calibration, config: CalibrationConfig, held_out_px: float = math.inf, *,
    folds: int = 5, rng: np.random.Generator,
) -> Yardstick | Rejected:  # fmt: skip
    """Compares the lens of a calibration with a splined one, at the views and corners that it kept.

    Args:
        config: that it was made with.
        held_out_px: its error on views that were held out, where it is known.
    Returns:
        what the calibrations without some of the views were refused for, `not_seen` where one of these has corners
        beyond what such a camera sees, `no_residuals` where corners have no errors.
    """
    views, order = views_of(found.observations), rng.permutation(len(found.observations))
    compared: tuple[Calibration, Vector, Vector] | Rejected = Rejected("too_large", "of this many corners")
    for shape in dict.fromkeys(("free", config.shape)):
        if shape == "free" and free_is_too_large(len(board), len(found.residuals)):
            continue
        compared = _compared(board, views, dataclasses.replace(config, shape=shape, reject=False), order, folds)
        if not isinstance(compared, Rejected) and _rms(found, compared[1]) <= held_out_px:
            break
    if isinstance(compared, Rejected):
        return compared
    base, errors, splined_errors = compared
    splined, _ = _splined(base)
    differences, pixels = _differences(base, splined)
    if not (np.all(np.isfinite(splined_errors)) and np.isfinite(differences).any()):
        return Rejected("not_seen", "the splined lens does not see all corners")
    worst = pixels[int(np.nanargmax(differences))]
    return Yardstick(
        lens=found.lens,
        shape=base.shape.kind,
        lens_rms_px=_rms(found, errors),
        splined_rms_px=_rms(found, splined_errors),
        coefficients=splined.coefficients.size,
        is_lens=is_clearly_lower(splined_errors, errors, _CLEAR),
        differences=differences.reshape(pixel_grid(base.camera, _ACROSS)[1]),
        worst_at=(float(worst[0]), float(worst[1])),
        held_out_px=held_out_px,
        board_px=_board_moves(found, base),
    )


def _rms(found: Calibration, squares: Vector) -> float:
    counts = np.diff(found.observations.offsets)
    return math.sqrt(float(squares @ counts / counts.sum()))


def _compared(
    board: Points3D, views: list[BoardView], config: CalibrationConfig, order: np.ndarray, folds: int
) -> tuple[Calibration, Vector, Vector] | Rejected:
    """The calibration from all views, and mean squared errors of each view where it was held out, of both lenses."""
    base = calibrate(board, views, config)
    if isinstance(base, Rejected):
        return base
    errors, splined_errors = np.empty(len(views)), np.empty(len(views))
    folds = min(folds, len(views))
    for fold in range(folds):
        held = sorted(order[fold::folds].tolist())
        kept = sorted(set(range(len(views))) - set(held))
        if len(kept) < config.min_views:
            return Rejected("too_few_views", f"{len(kept)} of {config.min_views} needed")
        fit = _of_views(base, kept)
        if not fit.sigma_px > 0:
            return Rejected("no_residuals", "corners are fitted exactly")
        turns = config.turns if fit.shape.kind != "flat" else ()
        observations, errors[held] = read_as_suits(fit.camera, fit.shape, base.observations.of_views(held), turns)
        system, seen = fit_poses(fit.camera, fit.shape, observations)
        if len(seen) < len(held):
            return Rejected("not_seen", "a held-out view is not seen")
        lens, shape = _splined(fit)
        start = dataclasses.replace(system.estimate, shape=shape)
        trial = SplinedSystem(observations, lens, start, fit.sigma_px, poses_only=True)
        if math.isfinite(trial.cost):
            minimize(trial, _RULES)
        lengths = np.sum(trial.residuals**2, axis=1)
        sums = np.bincount(observations.view_of, np.where(np.isfinite(lengths), lengths, np.inf), len(held))
        splined_errors[held] = sums / np.diff(observations.offsets)
    return base, errors, splined_errors


def _of_views(base: Calibration, kept: list[int]) -> Calibration:
    """The calibration from these views only; it starts from that of all, which saves half of the time."""
    observations, start = base.observations.of_views(kept), base.estimate.of_views(kept)
    if base.shape.kind == "free":
        # Points that fewer than two of these views show do not move.
        shown = np.bincount(observations.rows, minlength=len(observations.board)) >= 2
        shape = board_shape("free", observations.board, shown)
        moved = np.einsum("pcs,pc->s", shape.basis, base.shape.displacements)
        start = dataclasses.replace(start, shape=dataclasses.replace(shape, coefficients=moved))
    system = CalibrationSystem(
        observations, start, base.columns, free_shape=len(start.shape.coefficients) > 0,
        keep_invertible=base.keep_invertible, caution=_NEAR, by_secant=True,
    )  # fmt: skip
    cost = minimize(system, _TO_THE_END).final_cost
    estimate = system.estimate
    freedom = 2 * len(observations.rows) - 6 * len(kept) - system.shared_count
    return dataclasses.replace(
        base,
        camera=estimate.camera,
        cams_from_board=estimate.cams_from_board,
        shape=estimate.shape,
        observations=observations,
        residuals=system.residuals(),
        sigma_px=math.sqrt(2 * cost / freedom) if freedom > 0 else math.nan,
    )


def _splined(fit: Calibration) -> tuple[SplinedLens, BoardShape]:
    """The spline that explains most of what a calibration leaves, and the board as it sees it."""
    system = SplinedSystem(fit.observations, SplinedLens.of(fit.camera), fit.estimate, fit.sigma_px)
    if math.isfinite(system.cost):
        minimize(system, _RULES)
    return system.lens, system.shape


def _differences(base: Calibration, splined: SplinedLens) -> tuple[Vector, Points2D]:
    """(n,) lengths between the two at the cells' middles, NaN without corners, after the best turn; and these."""
    pixels, _ = pixel_grid(base.camera, _ACROSS)
    rays, valid = base.camera.unproject(pixels)
    rays = np.where(valid[:, None], rays, [0.0, 0.0, 1.0])
    shown = valid & coverage(base, _ACROSS).ravel() & splined.project(rays)[2]
    rays, turn = rays[shown], Rotation3.identity()
    apart = np.zeros((len(rays), 2))
    for _ in range(_ALIGNMENTS):
        turned = turn @ rays
        seen, by_point, _ = splined.project(turned)
        apart = seen - pixels[shown]
        J = (-by_point @ skew(turned)).reshape(-1, 3)
        turn = Rotation3.exp(-np.linalg.lstsq(J, apart.ravel(), rcond=None)[0]) @ turn
    lengths: FloatArray = np.full(len(pixels), np.nan)
    lengths[shown] = np.linalg.norm(apart, axis=1)
    return lengths, pixels


def _board_moves(found: Calibration, base: Calibration) -> float:
    """Rms of the difference that the shape of the board makes to the calibrated camera, where corners were; px."""
    if found.shape.kind == base.shape.kind:
        return 0.0
    pixels = pixel_grid(found.camera, _ACROSS)[0][coverage(found, _ACROSS).ravel()]
    lengths = np.linalg.norm(projection_difference(found.camera, base.camera, pixels), axis=1)
    return math.sqrt(float(np.nanmean(lengths**2)))
