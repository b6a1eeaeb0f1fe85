"""What is left out of a rig: corners that do not fit, and views that disagree with the others of their frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from calib.refine_board import shape_still_shown
from calib.refine_fit import ROBUST
from calib.refine_reject import RejectedView, limits_of, spread_of, views_that_belong
from calib.rig_system import RigEstimate, RigSystem
from calib.rig_views import RigObservations
from sfm.core.arrays import FloatArray, Value
from sfm.core.errors import Rejected
from sfm.core.optim.levenberg_marquardt import StopRules, Summary, minimize
from sfm.core.optim.losses import Loss

_NEAR = 1e-6
"""Damping near the minimum over the usual one."""
_WORSE = 3.0
"""Noise of the rig over that of its cameras alone that is put down to the model; more is put down to single views."""
_ROUNDS = 8


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigFit(Value):
    """One way to fit: what does not change between the attempts.

    Attributes:
        alone_sigma: standard deviation of a whitened coordinate in cameras alone. If views of a frame do not belong
            together, residuals are large throughout, and no measure of what is usual.
        columns: of each camera the positions of its free parameters.
    """

    keep_invertible: bool
    max_iterations: int
    relative_cost_tolerance: float
    reject_beyond_sigma: float
    keep_within_sigma: float
    min_corners: int
    alone_sigma: float
    columns: tuple[np.ndarray, ...]

    def system(
        self, observations: RigObservations, estimate: RigEstimate, loss: Loss = "trivial", scale: float = 1.0
    ) -> RigSystem:
        """The problem from here."""
        return RigSystem(
            observations,
            estimate,
            self.columns,
            free_shape=len(estimate.shape.coefficients) > 0,
            loss=loss,
            loss_scale=scale,
            keep_invertible=self.keep_invertible,
            caution=_NEAR if loss == "trivial" else 1.0,
        )

    def solve(self, observations: RigObservations, estimate: RigEstimate) -> tuple[RigSystem, Summary]:
        """Least squares, to the end."""
        system = self.system(observations, estimate)
        rules = StopRules(
            max_iterations=self.max_iterations,
            relative_cost_tolerance=self.relative_cost_tolerance,
            gradient_tolerance=0.0,
        )
        return system, minimize(system, rules)


def reject_from_rig(
    fit: RigFit, system: RigSystem, summary: Summary, views: Sequence[list[RejectedView]],
    corners: Sequence[list[tuple[str, int]]], start: RigEstimate | None = None,
) -> tuple[RigSystem, Summary] | Rejected:  # fmt: skip
    """Refits without corners beyond some σ, and without views far worse than the others; appends them, by camera.

    Corners may come back: all are judged again by each new fit, until the choice stays.

    Args:
        start: where `system` was solved from. First poses are those on which most frames agree; a few frames of two
            moments bend least squares so far that nothing fits, and no robust fit comes back from there.
    Returns:
        `nothing_fits` where no two views of a frame are left.
    """
    lengths, full = system.whitened_lengths(), system.observations
    sigma, limits = _limits(fit, full, lengths, fit.reject_beyond_sigma, None)
    if not any(np.any(one > limit) for one, limit in zip(lengths, limits, strict=True)):
        return system, summary
    # Least squares bends towards what is wrong; which corners that are, a robust fit tells.
    judge = _robust(fit, full, [system.estimate] if start is None else [system.estimate, start], 2 * sigma)
    before: list[np.ndarray] | None = None
    for _ in range(_ROUNDS):
        lengths = judge.whitened_lengths()
        sigma, limits = _limits(fit, full, lengths, fit.keep_within_sigma, before)
        kept = [one <= limit for one, limit in zip(lengths, limits, strict=True)]
        good = []
        for c, seen in enumerate(full.cameras):
            belong, gone = views_that_belong(seen, kept[c], lengths[c], sigma, fit.min_corners, "disagrees")
            good.append(belong)
            views[c].extend(gone)
        changed = any(len(good[c]) < len(full.cameras[c]) for c in range(len(good)))
        if not changed and before is not None and all(np.array_equal(a, b) for a, b in zip(kept, before, strict=True)):
            break
        if not all(good):
            return Rejected("nothing_fits", "a camera has no view left that agrees with the others")
        kept = [_of_views(full, c, kept[c], good[c]) for c in range(len(kept))]
        full, left = full.of_views(good)
        some, now = full.of_corners(kept), judge.estimate.of_frames(left)
        now = dataclasses.replace(now, shape=shape_still_shown(now.shape, some.shown))
        system, summary = fit.solve(some, now)
        judge, before = fit.system(full, system.estimate), kept
    for c, mask in enumerate(before or []):
        names, view_of = full.cameras[c].names, full.cameras[c].view_of
        corners[c].extend((names[view_of[n]], int(full.cameras[c].rows[n])) for n in np.flatnonzero(~mask))
    return system, summary


def _robust(fit: RigFit, observations: RigObservations, starts: Sequence[RigEstimate], scale: float) -> RigSystem:
    """The best of the robust fits from these starts."""
    judges = [fit.system(observations, start, "cauchy", scale) for start in starts]
    costs = [minimize(judge, ROBUST).final_cost for judge in judges]
    return judges[int(np.argmin(costs))]


def _of_views(observations: RigObservations, camera: int, mask: np.ndarray, kept: Sequence[int]) -> np.ndarray:
    """The part of a mask of corners that belongs to these views."""
    offsets = observations.cameras[camera].offsets
    return np.concatenate([np.zeros(0, bool), *(mask[offsets[v] : offsets[v + 1]] for v in kept)])


def _limits(
    fit: RigFit, observations: RigObservations, lengths: Sequence[FloatArray], sigmas: float,
    among: Sequence[np.ndarray] | None,
) -> tuple[float, list[FloatArray]]:  # fmt: skip
    """The standard deviation of all corners, and of each camera the lengths beyond which one is wrong."""
    usual = [one if among is None else one[among[c]] for c, one in enumerate(lengths)]
    sigma = min(spread_of(np.concatenate(usual)), _WORSE * fit.alone_sigma)
    return sigma, [
        limits_of(lengths[c], seen, sigmas, sigma, among=None if among is None else among[c])
        for c, seen in enumerate(observations.cameras)
    ]
