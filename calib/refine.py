"""Calibration of one camera from photos of a board: from corners to a camera, poses, the board's shape, and doubts.

    sort out views → start (`zhang`) → release parameters in stages, on some views → all views → reject → verdict

What is rejected is told with its reason. Where the views leave the principal point open it is held at the centre of the
image, and where they leave the focal length open there is no camera: `Rejected`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from calib.refine_board import BoardShape, ShapeKind, board_shape
from calib.refine_lenses import Lens, lens_by_name
from calib.refine_system import CalibrationSystem, Estimate
from calib.refine_views import BoardView, Observations, gather
from calib.zhang import Homographies, Start, find_start, fit_view_homographies, largest_angle_between, poses_of_views
from sfm.core.arrays import BoolArray, FloatArray, Points3D, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.homogeneous import transform_points
from sfm.core.geometry.rigid import Rigid3
from sfm.core.optim.levenberg_marquardt import StopRules, Summary, minimize
from sfm.core.optim.losses import Loss

_NOT_A_BOARD = 0.2
"""RMS error of a view's homography over the spread of its corners. Fisheye views stay below 0.1; corners in a wrong
order are near 0.5."""
_MOSTLY = 0.1
"""Part of that limit which the median corner must keep if some are far off."""
_GROSS = 6.0
"""Worst homography over the median one, beyond which single corners are suspected of being far off."""
_RAYLEIGH_MEDIAN = 1.17741
"""Median length of a pair of unit normal numbers."""
_SEED_VIEWS = 14
_OPEN_FOCAL = 0.1
"""Standard deviation of a focal length over itself, beyond which it is not determined."""
_OPEN_CENTER = 0.1
"""Standard deviation of the principal point over the longer side, beyond which it is not determined."""
_SUSPICIOUS = 2.0
"""Times the median error of views beyond which the other pose of a plane is tried."""
_ROUNDS = 8
_NEAR = 1e-6
"""Damping near the minimum over the usual one."""
_CONVERGED, _EXACT = 1e-9, 1e-20
"""Part of the cost, and px² a corner, that need not be gained."""
_FRONTAL, _PARALLEL = math.radians(3.0), math.radians(6.0)
"""Angles of boards to the image and to one another below which they are as good as none."""
_ROUGH = StopRules(max_iterations=12, relative_cost_tolerance=1e-2, gradient_tolerance=0.0)
_SEEDED = StopRules(max_iterations=60, relative_cost_tolerance=1e-7, gradient_tolerance=0.0)
_ROBUST = StopRules(max_iterations=40, relative_cost_tolerance=1e-4, gradient_tolerance=0.0)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationConfig:
    """How a camera is calibrated."""

    lens: str = "opencv5"
    """Row of `refine_lenses.LENSES`."""
    shape: ShapeKind = "flat"
    """What the board may be; see `refine_board`."""
    focal_px: float | None = None
    """First guess where it is known; it is refined."""
    reject: bool = True
    """Leave out corners and views that do not fit."""
    min_views: int = 3
    """Below it one bad view could not be told."""
    min_corners: int = 6
    """In a view; a homography takes 4 and says nothing of their quality."""
    reject_beyond_sigma: float = 5.0
    """A corner farther off starts the rejection; one of 270 000 right ones is."""
    keep_within_sigma: float = 4.0
    """What rejection then cuts at; as mrcal does."""
    max_iterations: int = 500
    relative_cost_tolerance: float = 1e-12
    """Close to rounding, so that nothing is left of the way there."""
    keep_invertible: bool = True
    """No corner may lie where the distortion turns back. A rational polynomial can fit a little better otherwise."""


@dataclasses.dataclass(frozen=True, slots=True)
class RejectedView:
    """A view that is left out, and why."""

    name: str
    reason: str
    detail: str = ""


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
        free_shape = len(self.shape.coefficients) > 0
        return CalibrationSystem(self.observations, self.estimate, self.columns, free_shape=free_shape)


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
    shown = np.bincount(observations.rows, minlength=len(board))
    shape = board_shape(config.shape, observations.board, shown >= 2)
    fit = _Fit(lens, config, start, shape)
    estimate = fit.seed(observations, homographies.errors)
    if isinstance(estimate, Rejected):
        return estimate
    system, summary = fit.solve(observations, estimate)
    turned = _turned_back(fit, system)
    if turned is not None:
        system, summary = fit.solve(observations, turned)
    corners: list[tuple[str, int]] = []
    if config.reject:
        system, summary, more = _reject(fit, system, summary, corners)
        rejected += more
        if len(system.observations) < config.min_views:
            return Rejected("too_few_views", _told(len(system.observations), config.min_views, rejected))
    checked = _determined(fit, system, summary)
    if isinstance(checked, Rejected):
        return checked
    system, summary, columns, fallbacks = checked
    if start.rung == "tried" and lens.start == "perspective":
        fallbacks = (
            f"focal lengths were tried for a start, since {start.detail or 'the closed form failed'}",
            *fallbacks,
        )
    return _result(fit, system, summary, columns, rejected, corners, fallbacks)


def sort_out(
    board: FloatArray, views: Sequence[BoardView], config: CalibrationConfig
) -> tuple[Observations, Homographies, list[RejectedView]]:
    """Views that can be used, and the others: another size, too few corners, corners on a line or in a wrong order."""
    sizes = [(view.width, view.height) for view in views]
    common = max(sorted(set(sizes)), key=sizes.count) if sizes else (0, 0)
    usable, rejected = [], []
    for view, size in zip(views, sizes, strict=True):
        if size != common:
            detail = f"{size[0]}x{size[1]} among photos of {common[0]}x{common[1]}"
            rejected.append(RejectedView(view.name, "other_size", detail))
        elif len(view.corner_ids) < config.min_corners:
            detail = f"{len(view.corner_ids)} of {config.min_corners} needed"
            rejected.append(RejectedView(view.name, "too_few_corners", detail))
        else:
            usable.append(view)
    observations = gather(board, usable)
    found = fit_view_homographies(observations)
    H, errors = found.matrices, found.errors
    flat, limits = np.isfinite(errors), _NOT_A_BOARD * found.spreads
    fits = flat & (errors <= limits)
    for v in np.flatnonzero(flat & ~fits) if config.reject else ():
        # Single corners may be far off: most of them must fit.
        one = observations.of_views([int(v)])
        H[v] = fit_view_homographies(one, robust=True).matrices[0]
        off = np.linalg.norm(transform_points(H[v], one.board[one.rows, :2]) - one.points2D, axis=1)
        fits[v] = np.median(off) <= _MOSTLY * limits[v]
        errors[v] = np.inf if fits[v] else errors[v]
    # det ∂(u, v)/∂(x, y) = det H / w³ has the sign of det H, as w is positive on what is seen.
    turns = np.linalg.det(np.where(np.isfinite(H), H, 0.0)) > 0
    alike = turns == (np.sum(turns & fits) * 2 >= np.sum(fits))
    out = np.flatnonzero(~(fits & alike))
    rejected += [
        RejectedView(observations.names[v], *_why_not(bool(flat[v]), bool(fits[v]), float(errors[v]))) for v in out
    ]
    if np.all(fits & alike):
        return observations, found, rejected
    kept = np.flatnonzero(fits & alike).tolist()
    return observations.of_views(kept), Homographies(H[kept], errors[kept], found.spreads[kept]), rejected


def _why_not(flat: bool, fits: bool, error: float) -> tuple[str, str]:
    if not flat:
        return "corners_on_a_line", "they determine no homography"
    if not fits:
        detail = f"{error:.1f} px from a flat board: corners in a wrong order, or rows and columns swapped"
        return "not_this_board", detail
    return "mirrored", "corners run the other way round than in most views"


def _told(count: int, needed: int, rejected: Sequence[RejectedView]) -> str:
    reasons = "; ".join(f"{view.name}: {view.reason} {view.detail}".strip() for view in rejected[:5])
    return f"{count} of {needed} needed" + (f" ({reasons})" if reasons else "")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """One way to fit: what does not change between the attempts."""

    lens: Lens
    config: CalibrationConfig
    start: Start
    shape: BoardShape

    def seed(self, observations: Observations, errors: Vector) -> Estimate | Rejected:
        """Camera and poses by releasing parameters in stages, on some of the views where there are many."""
        views = len(observations)
        some = sorted(set(np.linspace(0, views - 1, min(views, _SEED_VIEWS)).astype(int).tolist()))
        seeds = observations if len(some) == views else observations.of_views(some)
        gross = self.config.reject and bool(np.isinf(errors).any() or errors.max() > _GROSS * np.median(errors))
        estimate = self.placed(seeds, self.start.camera, gross)
        if isinstance(estimate, Rejected):
            return estimate
        for stage in range(1, len(self.lens.stages) + 1):
            last = stage == len(self.lens.stages)
            if last and len(some) == views:
                break
            # The last stage runs on seeds only where they stand for many views, and then saves steps with all.
            rules, caution = (_SEEDED, _NEAR) if last and not gross else (_ROUGH, 1.0)
            loss: Loss = "cauchy" if gross else "trivial"
            system = self.system(seeds, estimate, stage, loss, 2.0, shaped=False, caution=caution)
            minimize(system, rules)
            estimate = system.estimate
        return estimate if len(some) == views else self.placed(observations, estimate.camera, gross)

    def placed(self, observations: Observations, camera: Camera, robust: bool) -> Estimate | Rejected:
        """All views with this camera, in closed form."""
        R, t, errors = poses_of_views(observations, camera, robust=robust)
        lost = np.flatnonzero(~np.isfinite(errors) | ~np.isfinite(t).all(1))
        if len(lost):
            return Rejected("no_solution", f"{observations.names[lost[0]]} has no pose with the first camera")
        return Estimate(camera, R, t, self.shape)

    def system(
        self, observations: Observations, estimate: Estimate, stages: int | None = None, loss: Loss = "trivial",
        scale: float = 1.0, shaped: bool = True, columns: np.ndarray | None = None, caution: float = 1.0,
    ) -> CalibrationSystem:  # fmt: skip
        return CalibrationSystem(
            observations,
            estimate,
            self.lens.columns(stages) if columns is None else columns,
            free_shape=shaped and self.shape.basis.shape[2] > 0,
            loss=loss,
            loss_scale=scale,
            keep_invertible=self.config.keep_invertible,
            caution=caution,
        )

    def solve(
        self, observations: Observations, estimate: Estimate, columns: np.ndarray | None = None
    ) -> tuple[CalibrationSystem, Summary]:
        """Least squares, to the end."""
        system = self.system(observations, estimate, columns=columns, caution=_NEAR)
        rules = StopRules(
            max_iterations=self.config.max_iterations,
            relative_cost_tolerance=self.config.relative_cost_tolerance,
            gradient_tolerance=0.0,
        )
        return system, minimize(system, rules)


def _turned_back(fit: _Fit, system: CalibrationSystem) -> Estimate | None:
    """The estimate with other poses for bad views that fit better tilted the other way; None where none does.

    Seen from afar, a plane tilted away to the left looks nearly like one tilted to the right: with v the line of sight
    to its middle, R_v(180°) R R_z(180°) keeps what lies across v and turns round what lies along it. Either is a
    minimum of the pose alone, and noise may have led to the wrong one.
    """
    observations, costs = system.observations, system.view_costs / np.diff(system.observations.offsets)
    bad = np.flatnonzero(costs > _SUSPICIOUS**2 * np.median(costs)).tolist()
    if not bad:
        return None
    views, now = observations.of_views(bad), system.estimate
    R, t = now.rotations.copy(), now.translations.copy()
    for v in bad:
        middle = observations.board[observations.rows[observations.offsets[v] : observations.offsets[v + 1]]].mean(0)
        there = R[v] @ middle + t[v]
        sight = there / np.linalg.norm(there)
        R[v] = (2 * np.outer(sight, sight) - np.eye(3)) @ R[v] * [-1.0, -1.0, 1.0]
        t[v] = there - R[v] @ middle
    other = dataclasses.replace(now, rotations=R, translations=t).of_views(bad)
    trial = fit.system(views, other, shaped=False, columns=np.zeros(0, np.int64))
    minimize(trial, _ROBUST)
    better = trial.view_costs < system.view_costs[bad]
    if not np.any(better):
        return None
    R, t = now.rotations.copy(), now.translations.copy()
    at = np.array(bad)[better]
    R[at], t[at] = trial.estimate.rotations[better], trial.estimate.translations[better]
    return dataclasses.replace(now, rotations=R, translations=t)


def _lengths(system: CalibrationSystem) -> Vector:
    """(n,) lengths of the whitened residuals; inf where there is no projection."""
    r, roots = system.residuals(), system.observations.roots
    lengths = np.hypot(roots[:, 0] * r[:, 0] + roots[:, 1] * r[:, 1], roots[:, 2] * r[:, 1])
    return np.where(np.isfinite(lengths), lengths, np.inf)


def _reject(
    fit: _Fit, system: CalibrationSystem, summary: Summary, corners: list[tuple[str, int]]
) -> tuple[CalibrationSystem, Summary, list[RejectedView]]:
    """Refits without corners beyond some σ, and without views that lose half of theirs.

    Corners may come back: all are judged again by each new fit, until the choice stays.
    """
    config, rejected = fit.config, []
    full, lengths = system.observations, _lengths(system)
    if not lengths.max() > config.reject_beyond_sigma * _spread_of(lengths):
        return system, summary, rejected
    # Least squares bends towards what is wrong; which corners that are, a robust fit tells.
    judge = fit.system(full, system.estimate, loss="cauchy", scale=2 * _spread_of(lengths))
    minimize(judge, _ROBUST)
    before = None
    for _ in range(_ROUNDS):
        lengths = _lengths(judge)
        sigma = _spread_of(lengths if before is None else lengths[before])
        kept = lengths <= config.keep_within_sigma * sigma
        views, gone = _without_bad_views(full, kept, lengths, sigma, config.min_corners)
        rejected += gone
        if len(views) < config.min_views:
            return fit.system(full.of_views(views), judge.estimate.of_views(views)), summary, rejected
        if before is not None and not gone and np.array_equal(kept, before):
            break
        inside = np.concatenate([kept[full.offsets[v] : full.offsets[v + 1]] for v in views])
        full = full.of_views(views)
        system, summary = fit.solve(full.of_corners(inside), judge.estimate.of_views(views))
        judge, before = fit.system(full, system.estimate), inside
    if before is not None:
        names, views_of = full.names, full.view_of
        corners += [(names[views_of[n]], int(full.rows[n])) for n in np.flatnonzero(~before)]
    return system, summary, rejected


def _spread_of(lengths: Vector) -> float:
    """The standard deviation of a coordinate by the median length."""
    return max(float(np.median(lengths)) / _RAYLEIGH_MEDIAN, 1e-9)


def _without_bad_views(
    observations: Observations, kept: BoolArray, lengths: Vector, sigma: float, min_corners: int
) -> tuple[list[int], list[RejectedView]]:
    """Views to go on with, and those whose corners are mostly outliers."""
    good, bad = [], []
    for v, name in enumerate(observations.names):
        inside = kept[observations.offsets[v] : observations.offsets[v + 1]]
        if inside.sum() >= max(min_corners, 0.5 * len(inside)):
            good.append(v)
            continue
        typical = float(np.median(lengths[observations.offsets[v] : observations.offsets[v + 1]]))
        detail = f"{int((~inside).sum())} of {len(inside)} corners beyond limits; median {typical / sigma:.1f} sigma"
        bad.append(RejectedView(name, "outlier_view", detail))
    return good, bad


_Checked = tuple[CalibrationSystem, Summary, np.ndarray, tuple[str, ...]]


def _determined(fit: _Fit, system: CalibrationSystem, summary: Summary) -> _Checked | Rejected:
    """Holds the principal point where the views leave it open; refuses where they leave the focal length open."""
    names = system.estimate.camera.model_info.param_names
    columns, longer = fit.lens.columns(), max(system.observations.width, system.observations.height)
    deviations = _deviations(system, summary, [names[k] for k in columns])
    focal = [d for name, d in deviations.items() if name.startswith("f")]
    center = [d for name, d in deviations.items() if name.startswith("c")]
    fallbacks: tuple[str, ...] = ()
    between, _, one_axis = _tilts(system.estimate.rotations)
    mean = system.estimate.camera.mean_focal_length
    if max(center) > _OPEN_CENTER * longer or max(focal) > _OPEN_FOCAL * mean:
        columns = np.array([k for k in columns if not names[k].startswith("c")])
        fallbacks = (f"the principal point is held at the centre of the image: {_tilts_in_words(system)}",)
        camera = fit.start.camera
        centred = fit.lens.camera(
            camera.width, camera.height, *camera.focal_lengths, camera.width / 2, camera.height / 2
        )
        estimate = fit.placed(system.observations, centred, False)
        if isinstance(estimate, Rejected):
            return estimate
        system, summary = fit.solve(system.observations, estimate, columns)
        deviations = _deviations(system, summary, [names[k] for k in columns])
        focal = [d for name, d in deviations.items() if name.startswith("f")]
        mean = system.estimate.camera.mean_focal_length
    elif between < _PARALLEL or one_axis:
        fallbacks = (f"focal length and principal point rest on little: {_tilts_in_words(system)}",)
    if _tilts(system.estimate.rotations)[1] < _FRONTAL:
        # The focal length and all distances may grow together, whatever the noise makes of it.
        return Rejected("undetermined_focal", _tilts_in_words(system))
    if not (max(focal) <= _OPEN_FOCAL * mean and mean < 20 * longer):
        return Rejected(
            "undetermined_focal", f"focal length {mean:.0f} ± {max(focal):.0f} px: {_tilts_in_words(system)}"
        )
    return system, summary, columns, fallbacks


def _deviations(system: CalibrationSystem, summary: Summary, names: Sequence[str]) -> dict[str, float]:
    """Standard deviation of each free parameter, inf where nothing determines them."""
    inverse = system.shared_inverse()
    freedom = max(2 * len(system.observations.rows) - 6 * len(system.observations) - system.shared_count, 1)
    noise = 2 * summary.final_cost / freedom
    if inverse is None:
        return dict.fromkeys(names, math.inf)
    # Noise-free views that leave something open have no noise to tell so.
    floor = 1e-6
    return dict(zip(names, np.sqrt(np.diag(inverse)[: len(names)] * max(noise, floor)).tolist(), strict=True))


def _tilts(rotations: FloatArray) -> tuple[float, float, bool]:
    """Largest angle between two boards, largest between a board and the image, radians; whether about one axis only."""
    normals = rotations[:, :, 2]
    tilts = np.arccos(np.clip(np.abs(normals[:, 2]), 0, 1))
    directions = (normals[:, :2] / np.maximum(np.linalg.norm(normals[:, :2], axis=1, keepdims=True), 1e-12))[
        tilts > 0.1
    ]
    spread = np.linalg.svd(directions, compute_uv=False) if len(directions) > 1 else np.ones(2)
    return largest_angle_between(normals), float(tilts.max()), bool(spread[-1] < 0.15 * spread[0])


def _tilts_in_words(system: CalibrationSystem) -> str:
    """How the boards stand to one another and to the image, in degrees, and what would help."""
    between, tilt, one_axis = _tilts(system.estimate.rotations)
    views = f"all {len(system.observations)} views"
    if tilt < _FRONTAL:
        return f"{views} within {np.rad2deg(tilt):.0f}° of the image plane; tilt the board by 15° to 45° about two axes"
    if between < _PARALLEL:
        return f"{views} within {np.rad2deg(between):.0f}° of parallel; tilt the board by 15° to 45° about two axes"
    if one_axis:
        return f"{views} are tilted about one axis only; tilt the board about the other one, too"
    return f"tilts up to {np.rad2deg(tilt):.0f}° are too few or too alike; add views that fill the image"


def _result(
    fit: _Fit, system: CalibrationSystem, summary: Summary, columns: np.ndarray, rejected: list[RejectedView],
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
        converged=system.newton_decrement() <= _CONVERGED * summary.final_cost + _EXACT * len(residuals),
        iterations=len(summary.iterations) - 1,
        cost=summary.final_cost,
    )
