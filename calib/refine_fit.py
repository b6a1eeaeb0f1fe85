"""One way to fit a calibration: start, release of parameters, the end, and planes tilted the wrong way."""

from __future__ import annotations

import dataclasses

import numpy as np

from calib.board_turns import BoardTurn
from calib.refine_board import BoardShape, ShapeKind, shape_shown
from calib.refine_lenses import Lens
from calib.refine_system import CalibrationSystem, Estimate
from calib.refine_views import Observations
from calib.zhang import Homographies, Start, centred_focal_lengths, poses_of_views
from sfm.core.arrays import Vector
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.optim.levenberg_marquardt import Damping, StopRules, Summary, minimize
from sfm.core.optim.losses import Loss

_GROSS = 6.0
"""Worst homography over the median one, beyond which single corners are suspected of being far off."""
_SEED_VIEWS = 14
_MANY_VIEWS, _SEEDS_OF_MANY = 60, 40
"""For `Lens.at_once`: fewer seeds have other minima than all views."""
_SUSPICIOUS = 2.0
"""Times the median error of views beyond which the other pose of a plane is tried."""
_NEAR = 1e-6
"""Damping near the minimum over the usual one."""
_ROUGH = StopRules(max_iterations=12, relative_cost_tolerance=1e-2, gradient_tolerance=0.0)
_SEEDED = StopRules(max_iterations=60, relative_cost_tolerance=1e-7, gradient_tolerance=0.0)
_POSES = StopRules(max_iterations=5, relative_cost_tolerance=1e-3, gradient_tolerance=0.0)
_PATIENT = StopRules(max_iterations=300, relative_cost_tolerance=1e-6, gradient_tolerance=0.0)
_HALFWAY = StopRules(max_iterations=60, relative_cost_tolerance=1e-4, gradient_tolerance=0.0)
_SLOW = Damping(least=1e-30, least_factor=1 / 3, least_factor_of_exact=1 / 3)
"""With the usual fall three times as many trials of `Lens.at_once` end above OpenCV's, and they take more steps."""
ROBUST = StopRules(max_iterations=40, relative_cost_tolerance=1e-4, gradient_tolerance=0.0)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationConfig:
    """How a camera is calibrated."""

    lens: str = "opencv5"
    """Row of `refine_lenses.LENSES`."""
    shape: ShapeKind = "flat"
    """What the board may be; see `refine_board`."""
    turns: tuple[BoardTurn, ...] = ()
    """Of the board that nothing printed on it tells apart, the first is none; see `board_turns.board_turns`."""
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


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """One way to fit: what does not change between the attempts."""

    lens: Lens
    config: CalibrationConfig
    start: Start
    shape: BoardShape

    def for_corners(self, observations: Observations) -> Fit:
        """With the board of which those points may move that enough of these views show."""
        return dataclasses.replace(self, shape=shape_shown(self.config.shape, observations.board, observations.shown))

    def seed(self, observations: Observations, errors: Vector) -> Estimate | Rejected:
        """Camera and poses by releasing parameters in stages, on some of the views where there are many."""
        views = len(observations)
        some = _spread_over(views, _SEED_VIEWS)
        seeds = observations if len(some) == views else observations.of_views(some)
        gross = self.has_gross_errors(errors)
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

    def seed_at_once(self, observations: Observations, homographies: Homographies) -> Estimate | Rejected:
        """Camera and poses by releasing all parameters at once, on some of the views where there are many."""
        width, height, views = observations.width, observations.height, len(observations)
        focal = centred_focal_lengths(homographies.matrices, width, height)
        if self.start.rung == "given" or focal is None:
            camera = self.start.camera
        else:
            camera = self.lens.camera(width, height, *focal, width / 2, height / 2)
        many = views > _MANY_VIEWS
        seeds = observations.of_views(_spread_over(views, _SEEDS_OF_MANY)) if many else observations
        estimate = self.placed(seeds, camera, False)
        if isinstance(estimate, Rejected):
            return estimate
        poses = self.system(seeds, estimate, shaped=False, columns=np.zeros(0, np.int64))
        minimize(poses, _POSES)
        system = self.system(seeds, poses.estimate, shaped=False)
        minimize(system, _HALFWAY if many else _PATIENT, _SLOW)
        return self.placed(observations, system.estimate.camera, False) if many else system.estimate

    def has_gross_errors(self, errors: Vector) -> bool:
        """Whether single corners are suspected of being far off, by the errors of the views' homographies."""
        return self.config.reject and bool(np.isinf(errors).any() or errors.max() > _GROSS * np.median(errors))

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
        by_secant: bool = False,
    ) -> CalibrationSystem:  # fmt: skip
        """The problem from here, with what the first so many stages release, or these columns."""
        return CalibrationSystem(
            observations,
            estimate,
            self.lens.columns(stages) if columns is None else columns,
            free_shape=shaped and self.shape.basis.shape[2] > 0,
            loss=loss,
            loss_scale=scale,
            keep_invertible=self.config.keep_invertible,
            caution=caution,
            by_secant=by_secant,
        )

    def solve(
        self, observations: Observations, estimate: Estimate, columns: np.ndarray | None = None
    ) -> tuple[CalibrationSystem, Summary]:
        """Least squares, to the end."""
        system = self.system(observations, estimate, columns=columns, caution=_NEAR, by_secant=True)
        rules = StopRules(
            max_iterations=self.config.max_iterations,
            relative_cost_tolerance=self.config.relative_cost_tolerance,
            gradient_tolerance=0.0,
        )
        return system, minimize(system, rules)


def solve_from_start(
    fit: Fit, observations: Observations, homographies: Homographies
) -> tuple[CalibrationSystem, Summary] | Rejected:
    """Least squares from the start, on the ways that the lens asks for; see `Lens.at_once` and `Lens.rival`.

    The first minimum that is reached is taken for the right one. Where `keep_invertible` holds all of them back, the
    lowest cost of those by stages wins: at once they are held back anywhere, far from anything.
    """
    errors = homographies.errors
    if fit.lens.at_once and not fit.has_gross_errors(errors):
        found = _solved(fit, observations, fit.seed_at_once(observations, homographies))
        held_back = fit.config.keep_invertible and not _is_at_minimum(found)
        if not isinstance(found, Rejected) and not held_back:
            return found
    found = _solved(fit, observations, fit.seed(observations, errors))
    rival = _rival_of(fit, found)
    if isinstance(found, Rejected) or rival is None:
        return found
    other = _solved(rival, observations, rival.seed(observations, errors))
    if isinstance(other, Rejected) or found[1].final_cost <= other[1].final_cost:
        return found
    return other


def _solved(
    fit: Fit, observations: Observations, estimate: Estimate | Rejected
) -> tuple[CalibrationSystem, Summary] | Rejected:
    return estimate if isinstance(estimate, Rejected) else fit.solve(observations, estimate)


def _is_at_minimum(solved: tuple[CalibrationSystem, Summary] | Rejected) -> bool:
    return not isinstance(solved, Rejected) and solved[0].is_at_minimum(solved[1].final_cost)


def _spread_over(views: int, most: int) -> list[int]:
    """Some views, or all where there are not many."""
    return sorted(set(np.linspace(0, views - 1, min(views, most)).astype(int).tolist()))


def _rival_of(fit: Fit, found: tuple[CalibrationSystem, Summary] | Rejected) -> Fit | None:
    """The second attempt, where the lens has one and needs it."""
    lens, start = fit.lens, fit.start
    if lens.other_shape:
        lens, camera = lens.from_other_shape(start.camera)
        return dataclasses.replace(fit, lens=lens, start=dataclasses.replace(start, camera=camera))
    if not lens.rival or _is_at_minimum(found):
        return None
    return dataclasses.replace(fit, lens=dataclasses.replace(lens, stages=lens.rival))


def turned_back(fit: Fit, system: CalibrationSystem) -> Estimate | None:
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
    minimize(trial, ROBUST)
    better = trial.view_costs < system.view_costs[bad]
    if not np.any(better):
        return None
    R, t = now.rotations.copy(), now.translations.copy()
    at = np.array(bad)[better]
    R[at], t[at] = trial.estimate.rotations[better], trial.estimate.translations[better]
    return dataclasses.replace(now, rotations=R, translations=t)
