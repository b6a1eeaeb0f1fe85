"""The normal equations of a reprojection problem, for the damping loop.

A point X seen by an image with pose (R, t) lies at x = R X + t in the camera and is projected to π(x, θ), θ the
parameters of the camera. What moves as one, an image or the images of one moment of a rig, is a frame with a centre C.
It turns and shifts by δ = (ω, υ) in the axes of the world, R ← R exp(ω) and C ← C − υ, so that against it a point moves
by ω × (X − C) + υ: the same three columns serve pose and point, and coordinates far from the origin do no harm. With
A = ∂π/∂x, Q = ∂π/∂θ:

    r = π(x, θ) − observed     ∂r/∂X = A R = P     ∂r/∂δ = P [−[X − C]×, I]     ∂r/∂θ = Q     ∂r/∂μ = A [−[x]×, I]

with μ the tangent of a sensor's pose on its rig, on the left and in its own axes. Rows are scaled by √ρ'(|r|²), see
`sfm.core.optim.losses`; how points are eliminated is in `sfm.core.optim.schur`, in which order in `layout`.
What priors add is in `knowledge`.
Points are cut into chunks whose number depends on the problem alone and whose sums are added in order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sfm.bundle import _kernels as kernels
from sfm.bundle.bounds import ParamBounds
from sfm.bundle.gauge import HeldPoints
from sfm.bundle.knowledge import Knowledge
from sfm.bundle.layout import Layout
from sfm.bundle.marginals import Marginals
from sfm.bundle.own_blocks import ImageSums
from sfm.bundle.problem import BundleConfig, BundleProblem
from sfm.bundle.reduced import ReducedSystem
from sfm.bundle.rig_arrays import RigArrays
from sfm.bundle.solver_plan import SolverPlan, plan_solver
from sfm.bundle.state import Places, State
from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.execution import Workers
from sfm.core.geometry.rigid import Rigid3
from sfm.core.optim.block_pattern import BLOCK
from sfm.core.optim.levenberg_marquardt import Trial, steepness
from sfm.core.optim.losses import Loss, loss_id
from sfm.core.optim.schur import Couplings, invert_blocks


class BundleSystem:
    """Current and tried parameters of a problem with all buffers; meets `sfm.core.optim.System`.

    Args:
        held: (S, 6) entries of the poses' tangents that stay zero, for the gauge.
        announce: told the solver and about how many bytes will be taken, before they are.

    Attributes:
        lost_cost: what an observation costs that has no projection.
        costs: (n,) of the last `evaluate`, in the order by points.
    """

    def __init__(
        self, problem: BundleProblem, layout: Layout, held: BoolArray, config: BundleConfig, threads: int,
        announce: Callable[[SolverPlan, int], object] = lambda plan, memory_bytes: None,
    ) -> None:  # fmt: skip
        self.layout, self._rigs = layout, problem.rigs
        workers = Workers(threads)
        self._run = workers.map
        self._image_cameras, self._model_ids = problem.image_cameras.copy(), problem.model_ids.astype(np.int64)
        self.free_points = problem.free_points.copy()
        self._loss, self._scale, self.lost_cost = loss_id(config.loss), float(config.loss_scale_px), 1e300
        self._cost, self._flat = 0.0, config.gradient_tolerance
        self._state = State.of(problem)
        self._trial, self._places = self._state.copy(), Places.of(layout)

        images, points, widest = len(self._image_cameras), len(problem.points3D), layout.columns.shape[1]
        self.held = layout.padding
        self.held[: len(held)] |= held
        self._known, self._bounds = Knowledge(problem, layout), ParamBounds.of(problem, layout)
        plan = plan_solver(layout, self.held, self._known.targets, config.solver)
        announce(plan, system_bytes(layout, plan, images, points))
        self._images = ImageSums.allocate(images, widest)
        self._of_observations = np.empty((len(layout.image), 9 + 3 * widest))
        self.costs = np.empty(len(layout.image))
        self._V, self._g, self._M = np.empty((points, 6)), np.empty((points, 3)), np.empty((points, 6))
        self._couplings = Couplings(
            layout.starts, layout.slot, np.empty((len(layout.slot), 6)),
            layout.shared_starts, layout.shared_slot, np.empty((len(layout.shared_slot), 3, BLOCK)),
        )  # fmt: skip
        self._reduced = ReducedSystem(layout, self.held, self._couplings, self._known.targets, plan, workers)

    @property
    def free_count(self) -> int:
        """Number of scalars that may change and that an observation sees."""
        seen = np.diff(self.layout.offsets) > 0
        return int(np.sum(~self.held)) + 3 * int(np.sum(self.free_points & seen))

    @property
    def prior_count(self) -> int:
        """Number of scalars that a prior expects to be something."""
        return self._known.count

    @property
    def biases(self) -> FloatArray:
        """Current biases (G, 3) of position priors."""
        return self._state.biases

    @property
    def points3D(self) -> FloatArray:
        """Current points (P, 3)."""
        return self._state.points3D

    @property
    def camera_params(self) -> FloatArray:
        """Current camera parameters (C, K)."""
        return self._state.params

    @property
    def cams_from_world(self) -> Rigid3:
        """Current poses of the images, a batch (I,)."""
        return self._state.frames.poses if self._rigs is None else self._state.mounted(self._rigs).cams_from_world

    @property
    def rigs(self) -> RigArrays | None:
        """Current rigs, where there are any."""
        return None if self._rigs is None else self._state.mounted(self._rigs)

    @property
    def gradient(self) -> FloatArray:
        """(rows, 6) of the cost by what is left after the elimination, as last linearised; 0 where held."""
        return self._reduced.gradient

    @property
    def plan(self) -> SolverPlan:
        """How the reduced system is solved."""
        return self._reduced.plan

    @property
    def lost(self) -> int:
        """Observations without a projection at the current parameters."""
        return self._state.lost

    def linearize(self) -> tuple[float, float]:
        """Cost and largest entry of the gradient at the current parameters."""
        lay, now, links = self.layout, self._state, self._couplings
        sums = self._images
        sums.clear()
        links.B.fill(0)
        cost = self._over_images(now, now.points3D, self._loss, self.lost_cost, None)
        self._run(lambda points: kernels.gather_points(
            *points, lay.offsets, lay.obs_slot, lay.column_count, lay.column_place, lay.image, lay.obs_shared,
            links.starts, self.free_points, self._of_observations, self._V, self._g, links.N, links.B,
        ), lay.point_chunks)  # fmt: skip
        rotations, _, centers = now.images
        prior, blocks, gradient = self._known.linearize(
            rotations, centers, now.frames.centers, now.params, now.biases
        )  # fmt: skip
        cost += prior
        if self._known.is_about_points:
            prior, V, g = self._known.linearize_points(now.points3D)
            cost, self._V, self._g = cost + prior, self._V + V, self._g + g
        self._reduced.take_over(sums, blocks, gradient)
        reduced = self._bounds.projected(self._reduced.gradient, now.params)
        largest = max(np.abs(reduced).max(initial=0.0), np.abs(self._g).max(initial=0.0))
        self._cost = float(cost)
        return self._cost, float(largest)

    def evaluate(self, loss: Loss) -> FloatArray:
        """ρ of the observations (n,) by points, at the current parameters; NaN where there is no projection."""
        self._over_images(self._state, self._state.points3D, loss_id(loss), np.nan, self.costs)
        return self.costs

    def information(self, held: HeldPoints | None = None) -> Information:
        """What the problem says about its points, as last linearised; these may be held in some directions."""
        self._run(lambda job: invert_blocks(*job, self._V, 0.0, self._M), self.layout.point_chunks)
        if held is not None:
            for point, basis in zip(held.points, held.bases, strict=True):
                self._M[point] = _within(self._V[point], basis)
        self._reduced.eliminate(self._row_centers(), self._state.points3D, self._M, self._g)
        return Information(self._couplings, self._row_centers(), self._V, self._M)

    def inverse(self, motions: FloatArray) -> Marginals | int:
        """Blocks of the inverse of what `information` has left of poses and parameters; see `marginals`.

        Args:
            motions: (6 rows, m) that cost nothing.
        """
        return self._reduced.inverse(motions)

    def try_step(self, damping: float) -> Trial | None:
        """Solves the damped normal equations, moves everything by the solution and evaluates the cost there."""
        self._eliminate(damping)
        lay, now, then = self.layout, self._state, self._trial
        solved = self._reduced.solve(damping, self._bounds.room(now.params) if len(self._bounds) else None)
        if solved is None:
            return None
        delta, sides, bound_decrease = solved
        now.move(delta, lay.slot_frame, self._places, self._rigs, then)
        self._bounds.settle(then.params, sides)
        row_centers, totals = self._row_centers(), np.zeros((len(lay.point_chunks), 5))

        # Lambdas, since the checks of shapes in the test run would go over each annotated closure again.
        self._run(lambda points: kernels.move_points(
            *points, *self._couplings, row_centers, now.points3D, self._M, self._g, delta, then.points3D
        ), lay.point_chunks)  # fmt: skip
        self._over_images(then, then.points3D, self._loss, np.nan, self.costs)
        costs_here = self.costs
        if np.isnan(self.costs).any():
            costs_here = np.empty_like(self.costs)
            self._over_images(then, now.points3D, self._loss, np.nan, costs_here)
        self._run(lambda job: kernels.settle_points(
            *job[1], lay.offsets, now.points3D, self.lost_cost, damping, self._V, self._g, self.costs,
            costs_here, then.points3D, totals[job[0]],
        ), list(enumerate(lay.point_chunks)))  # fmt: skip
        cost, decrease, step, norm, lost = totals.sum(axis=0)
        cost += self._known.cost(then.images[0], then.images[2], then.params, then.biases, then.points3D)
        then.lost = int(lost)
        decrease += 0.5 * float(((self._reduced.scaling * delta - self._reduced.gradient) * delta).sum())
        decrease += bound_decrease
        # Of cameras what may change: others, perhaps never used, may hold anything.
        norm += _squared(row_centers) + len(row_centers) + _squared(now.params[self._places.cells])
        step_norm, norm = math.sqrt(step + _squared(delta)), math.sqrt(norm)
        return Trial(float(cost), float(decrease), step_norm, norm, self._steepness())

    def _steepness(self) -> float:
        """See `levenberg_marquardt`. Points, which are many, are looked at where the rest is flat at least."""
        gradient = self._bounds.projected(self._reduced.gradient, self._state.params)
        of_rows = steepness(gradient, self._reduced.diagonal, self._cost)
        if of_rows > self._flat:
            return of_rows
        return max(of_rows, steepness(self._g, self._V[:, [0, 3, 5]], self._cost))

    def accept(self) -> None:
        """Makes the last trial current."""
        self._state, self._trial = self._trial, self._state

    def _over_images(
        self, state: State, points3D: FloatArray, loss: int, lost_cost: float, costs: FloatArray | None
    ) -> float:
        """The cost of a linearisation, or what each observation costs into `costs` (n,), by points."""
        lay, sums, limits = self.layout, self._images, kernels.squared_limits(self._model_ids, state.params)
        rotations, translations, _ = state.images
        row_centers = state.frames.centers.take(lay.slot_frame, axis=0)
        return sum(self._run(lambda images: kernels.evaluate_images(
            *images, lay.image_offsets, lay.image_point, lay.place, lay.observed, lay.precision, lay.image_slot,
            self._image_cameras, self._model_ids, limits, lay.column_count, lay.columns,
            rotations, translations, row_centers, state.params, points3D, loss, self._scale, lost_cost,
            costs is None, self.costs if costs is None else costs, self._of_observations,
            sums.h, sums.F, sums.G, sums.f,
        ), lay.image_chunks))  # fmt: skip

    def _eliminate(self, damping: float) -> None:
        """Inverts the blocks of points and takes them out of the reduced system."""
        self._run(lambda job: invert_blocks(*job, self._V, damping, self._M), self.layout.point_chunks)
        self._reduced.eliminate(self._row_centers(), self._state.points3D, self._M, self._g)

    def _row_centers(self) -> FloatArray:
        return self._state.frames.centers.take(self.layout.slot_frame, axis=0)


def system_bytes(layout: Layout, plan: SolverPlan, images: int, points: int) -> int:
    """About the memory of an adjustment: its layout, the solver, and the arrays that kernels fill."""
    columns, shared = layout.columns.shape[1], layout.image_shared.shape[1]
    observation = 44 + 4 * shared + 8 * (9 + 3 * columns) + 8
    couplings = 52 * len(layout.slot) + 148 * len(layout.shared_slot)
    image = 8 * (6 + 6 * columns + columns**2 + columns) + 8 * 32
    return plan.bytes + observation * len(layout.image) + couplings + image * images + 8 * 29 * points


def _within(information: FloatArray, basis: FloatArray) -> FloatArray:
    """(6,) the inverse of a point's information within the directions (3, k) of a basis."""
    V = information[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3)
    inverse = basis @ np.linalg.inv(basis.T @ V @ basis) @ basis.T
    return inverse[np.triu_indices(3)]


class Information(NamedTuple):
    """What was eliminated, without damping: see `sfm.core.optim.schur`.

    Attributes:
        centers: (S, 3) of the frames by row.
        V, M: (P, 6) information about each point alone, and its inverse.
    """

    couplings: Couplings
    centers: np.ndarray
    V: np.ndarray
    M: np.ndarray


def _squared(numbers: FloatArray) -> float:
    return float((numbers * numbers).sum())
