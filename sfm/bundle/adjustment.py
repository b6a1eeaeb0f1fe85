"""Bundle adjustment: cameras, poses and points of least reprojection error."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial

import numpy as np

from sfm.bundle.gauge import held_by_three_points, held_by_two_cameras, put_back, put_back_by_points
from sfm.bundle.layout import lay_out
from sfm.bundle.limits import MOST
from sfm.bundle.problem import BundleConfig, BundleProblem, BundleResult
from sfm.bundle.solver_plan import SolverPlan
from sfm.bundle.system import BundleSystem
from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.events import SILENT, BundleAdjusted, BundlePlanned, Observer
from sfm.core.optim.levenberg_marquardt import StopRules, Summary, minimize
from sfm.core.optim.losses import evaluate_loss

_LOST_PX = 100.0
_GRADUAL_STEPS, _MAX_HALVINGS = 5, 20
"""Steps with each of the wider scales of a graduated loss, and how many of these there are at most."""


def adjust(
    problem: BundleProblem, config: BundleConfig = BundleConfig(), *, threads: int = 1, observer: Observer = SILENT,
    scope: str = "global",
) -> BundleResult:  # fmt: skip
    """Minimises ½ Σ ρ(|projected − observed|² / σ²), and what priors add, over the free poses, points and parameters.

    Observations without a projection at the start take no part. A point is never moved to where it loses a
    projection that it would keep where it is; an observation that loses its own all the same, because its camera
    moved, is charged like the worst at the start (at least 100 px, or 100 standard deviations).

    The scene is free to turn, move and grow on the way, which takes fewer steps than to hold some of its poses; with
    another gauge than `free` it is put back in the end, see `gauge`.

    If `config.graduated`, the costs and the table are those of the last scale.

    Args:
        threads: the result is the same to the last bit for any number.
        scope: passed on to the event, e.g. "local".
    """
    free, start = dataclasses.replace(config, gauge="free"), problem
    for scale in _wider_scales(problem, config):
        wider = dataclasses.replace(free, loss_scale_px=scale, max_iterations=_GRADUAL_STEPS)
        system, _ = system_of(problem, wider, threads)
        _minimize(system, wider)
        problem = _moved(problem, system)
    system, active = system_of(problem, free, threads, announce=partial(_tell, observer, scope, problem))
    result = _result(problem, system, _minimize(system, free), active)
    if config.gauge != "free" and any(row.accepted for row in result.table[1:]):
        back = put_back if config.gauge == "two_cameras" else put_back_by_points
        result = dataclasses.replace(result, problem=back(start, result.problem, system.layout))
    observer(
        BundleAdjusted(
            scope=scope,
            images=len(system.layout.slot_frame),
            points=len(problem.points3D),
            observations=len(system.layout.image),
            iterations=result.iterations,
            initial_cost=result.initial_cost,
            final_cost=result.final_cost,
            reason=result.reason,
        )
    )
    return result


def _tell(observer: Observer, scope: str, problem: BundleProblem, plan: SolverPlan, memory_bytes: int) -> None:
    observer(
        BundlePlanned(
            scope=scope,
            images=len(problem.image_cameras),
            points=len(problem.points3D),
            observations=len(problem.obs_images),
            solver=plan.kind,
            memory_bytes=memory_bytes,
        )
    )


def _say_nothing(plan: SolverPlan, memory_bytes: int) -> None:
    """Where nobody wants to know."""


def system_of(
    problem: BundleProblem, config: BundleConfig, threads: int,
    announce: Callable[[SolverPlan, int], object] = _say_nothing,
) -> tuple[BundleSystem, BoolArray]:  # fmt: skip
    """The normal equations of `problem`, and which observations (n,) take part."""
    active = _has_pose(problem)
    system = _laid_out(problem, active, config, threads, announce)
    valid = np.isfinite(system.evaluate("trivial"))
    if not valid.all():
        active[system.layout.original[~valid]] = False
        system = _laid_out(problem, active, config, threads)
        system.evaluate("trivial")
    worst = max(_LOST_PX**2, float(system.costs.max(initial=0.0)))
    system.lost_cost = 0.5 * float(evaluate_loss(config.loss, np.array(worst), config.loss_scale_px)[0])
    return system, active


def _has_pose(problem: BundleProblem) -> BoolArray:
    """(n,) whether the pose of the observation's image is finite."""
    poses = problem.cams_from_world
    return np.isfinite(np.c_[poses.rotation.wxyz, poses.translation]).all(axis=1)[problem.obs_images]


def _laid_out(
    problem: BundleProblem, active: BoolArray, config: BundleConfig, threads: int,
    announce: Callable[[SolverPlan, int], object] = _say_nothing,
) -> BundleSystem:  # fmt: skip
    layout = lay_out(problem, active)
    held = np.zeros((len(layout.slot_frame), 6), bool)
    by_points = config.gauge == "three_points" and held_by_three_points(problem, layout) is not None
    if config.gauge != "free" and not by_points:
        held = held_by_two_cameras(problem, layout)
    return BundleSystem(problem, layout, held, config, threads, announce)


def squared_errors(problem: BundleProblem) -> FloatArray:
    """|projected − observed|² of every observation (n,) in px²; NaN where there is no projection."""
    nothing = {"free_params": np.zeros_like(problem.free_params), "free_poses": np.zeros_like(problem.free_poses)}
    problem = dataclasses.replace(problem, obs_sigmas=None, priors=(), **nothing)
    layout, out = lay_out(problem, _has_pose(problem)), np.full(len(problem.obs_images), np.nan)
    out[layout.original] = BundleSystem(problem, layout, np.zeros((0, 6), bool), BundleConfig(), 1).evaluate("trivial")
    return out


def _minimize(system: BundleSystem, config: BundleConfig) -> Summary:
    if not system.free_count:
        cost, gradient = system.linearize()
        return Summary.at_once("no_free_parameters", cost, gradient)
    rules = StopRules(
        max_iterations=config.max_iterations,
        relative_cost_tolerance=config.relative_cost_tolerance,
        gradient_tolerance=config.gradient_tolerance,
    )
    return minimize(system, rules)


def _wider_scales(problem: BundleProblem, config: BundleConfig) -> list[float]:
    """Scales of the loss from that of the worst residual down to twice the configured one."""
    if not config.graduated:
        return []
    sigmas = 1.0 if problem.obs_sigmas is None else problem.obs_sigmas
    squared = squared_errors(problem) / sigmas**2
    worst = math.sqrt(float(squared[np.isfinite(squared)].max(initial=0.0)))
    halvings = min(max(math.ceil(math.log2(max(worst / config.loss_scale_px, 1.0))), 0), _MAX_HALVINGS)
    return [min(config.loss_scale_px * 2.0**k, MOST) for k in range(halvings, 0, -1)]


def _moved(problem: BundleProblem, system: BundleSystem) -> BundleProblem:
    """The problem with the parameters of the system."""
    return dataclasses.replace(
        problem,
        camera_params=system.camera_params,
        cams_from_world=system.cams_from_world,
        points3D=system.points3D,
        rigs=system.rigs,
    )


def _result(problem: BundleProblem, system: BundleSystem, summary: Summary, active: np.ndarray) -> BundleResult:
    return BundleResult(
        problem=_moved(problem, system),
        initial_cost=summary.initial_cost,
        final_cost=summary.final_cost,
        reason=summary.reason,
        invalid=int(np.sum(~active)),
        lost=system.lost,
        table=summary.iterations,
        biases=system.biases,
    )
