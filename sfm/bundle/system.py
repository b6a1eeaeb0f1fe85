"""The normal equations of a reprojection problem, for the damping loop.

A point X seen by an image with pose (R, t) lies at x = R X + t in the camera and is projected to π(x, θ), θ the
parameters of the camera. What moves as one, an image or the images of one moment of a rig, is a frame with a centre C.
It turns and shifts by δ = (ω, υ) in the axes of the world, R ← R exp(ω) and C ← C − υ, so that against it a point moves
by ω × (X − C) + υ: the same three columns serve pose and point, and coordinates far from the origin do no harm. With
A = ∂π/∂x, Q = ∂π/∂θ:

    r = π(x, θ) − observed     ∂r/∂X = A R = P     ∂r/∂δ = P [−[X − C]×, I]     ∂r/∂θ = Q     ∂r/∂μ = A [−[x]×, I]

with μ the tangent of a sensor's pose on its rig, on the left and in its own axes. Rows are scaled by √ρ'(|r|²), see
`sfm.core.optim.losses`; how points are eliminated is in `sfm.core.optim.schur`, in which order in `layout`.
A camera parameter that is expected to be θ₀ with standard deviation σ adds ½ ((θ − θ₀) / σ)².
Points are cut into chunks whose number depends on the problem alone and whose sums are added in order.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from sfm.bundle import _kernels as kernels
from sfm.bundle.layout import SENSOR_COLUMN, Layout
from sfm.bundle.problem import BundleConfig, BundleProblem, RigArrays
from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.execution import ordered_map
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.optim._block_kernels import WIDTH
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optim.levenberg_marquardt import Trial
from sfm.core.optim.losses import loss_id
from sfm.core.optim.schur import Couplings, eliminate, invert_blocks
from sfm.core.optim.solvers import DenseCholesky

_FLOOR = 1e-8
"""Part of the largest diagonal entry of its kind below which an entry of D counts as this part."""
Job = TypeVar("Job")
Answer = TypeVar("Answer")


class BundleSystem:
    """Current and tried parameters of a problem with all buffers; meets `sfm.core.optim.System`.

    Args:
        held: (S, 6) entries of the poses' tangents that stay zero, for the gauge.
        lost_cost: what an observation costs that has no projection.
    """

    def __init__(
        self, problem: BundleProblem, layout: Layout, held: BoolArray, config: BundleConfig, lost_cost: float,
        threads: int,
    ) -> None:  # fmt: skip
        self.layout, self._threads, self._rigs = layout, threads, problem.rigs
        self._image_cameras, self._model_ids = problem.image_cameras.copy(), problem.model_ids.astype(np.int64)
        self.free_points = problem.free_points.copy()
        self._loss = (loss_id(config.loss), float(config.loss_scale_px), float(lost_cost))
        self._state = _State.of(problem)
        self._trial = self._state.copy()

        images, points, widest = len(self._image_cameras), len(problem.points3D), layout.columns.shape[1]
        poses, rows = len(layout.slot_frame), layout.rows
        self.held = layout.padding
        self.held[:poses] |= held
        self._h, self._F = np.empty((images, BLOCK)), np.empty((images, BLOCK, widest))
        self._G, self._f = np.empty((images, widest, widest)), np.empty((images, widest))
        self._of_observations = np.empty((len(layout.image), 9 + 3 * widest))
        self._costs = np.empty(len(layout.image))
        self._V, self._g, self._M = np.empty((points, 6)), np.empty((points, 3)), np.empty((points, 6))
        self._couplings = Couplings(
            layout.starts, layout.slot, np.empty((len(layout.slot), 6)),
            layout.shared_starts, layout.shared_slot, np.empty((len(layout.shared_slot), 3, BLOCK)),
        )  # fmt: skip
        self._pattern = BlockPattern.full(rows)
        self._solver = DenseCholesky(self._pattern, self.held.ravel())
        self._blocks, self._side = np.zeros((len(self._pattern.columns), BLOCK, WIDTH)), np.zeros((rows, WIDTH))
        self._own = _OwnBlocks(layout, self._pattern)
        self._row_ranges = layout.row_ranges(max(threads, 1))
        self._gradient = self._diagonal = np.zeros((rows, BLOCK))
        self._expected, self._prior_weight = _priors(problem, layout)

    @property
    def free_count(self) -> int:
        """Number of scalars that may change and that an observation sees."""
        seen = np.diff(self.layout.offsets) > 0
        return int(np.sum(~self.held)) + 3 * int(np.sum(self.free_points & seen))

    @property
    def prior_count(self) -> int:
        """Number of camera parameters that have a prior."""
        return int(np.sum(self._prior_weight > 0))

    @property
    def points3D(self) -> FloatArray:
        """Current points (P, 3)."""
        return self._state.points3D

    @property
    def camera_params(self) -> FloatArray:
        """Current camera parameters (C, 12)."""
        return self._state.params

    @property
    def cams_from_world(self) -> Rigid3:
        """Current poses of the images, a batch (I,)."""
        return self._state.images[2]

    @property
    def rigs(self) -> RigArrays | None:
        """Current rigs, where there are any."""
        now = self._state
        if self._rigs is None:
            return None
        return dataclasses.replace(self._rigs, rigs_from_world=now.frames, sensors_from_rig=now.sensors)

    @property
    def lost(self) -> int:
        """Observations without a projection at the current parameters."""
        return self._state.lost

    def linearize(self) -> tuple[float, float]:
        """Cost and largest entry of the gradient at the current parameters."""
        lay, now, links = self.layout, self._state, self._couplings
        for sums in (self._h, self._F, self._G, self._f, links.B):
            sums.fill(0)
        rotations, translations, _ = now.images
        centers, limits = now.centers[lay.slot_frame], kernels.squared_limits(self._model_ids, now.params)

        def images(job: tuple[int, int]) -> float:
            return kernels.linearize_images(
                *job, lay.image_offsets, lay.image_point, lay.place, lay.observed, lay.precision, lay.image_slot,
                self._image_cameras, self._model_ids, limits, lay.column_count, lay.columns,
                rotations, translations, centers, now.params, now.points3D, *self._loss,
                self._of_observations, self._h, self._F, self._G, self._f,
            )  # fmt: skip

        def points(job: tuple[int, int]) -> None:
            kernels.gather_points(
                *job, lay.offsets, lay.obs_slot, lay.column_count, lay.column_place, lay.image, lay.obs_shared,
                links.starts, self.free_points, self._of_observations, self._V, self._g, links.N, links.B,
            )  # fmt: skip

        cost = sum(self._run(images, lay.image_chunks)) + self._prior_cost(now.params)
        self._run(points, lay.point_chunks)
        gradient = np.zeros((lay.rows, BLOCK))
        self._own.set(self._F, self._G, self._prior_weight)
        self._own.add_gradients(self._h, self._f, gradient)
        gradient[len(lay.slot_frame) :] += self._prior_weight * self._unexpected(now.params)
        self._own_gradient = gradient
        self._gradient = np.where(self.held, 0.0, gradient)
        largest = max(np.abs(self._gradient).max(initial=0.0), np.abs(self._g).max(initial=0.0))
        return float(cost), float(largest)

    def information(self) -> Information:
        """What the problem says about its parameters, as last linearised."""
        self._eliminate(0.0)
        lower = DenseCholesky(self._pattern, np.zeros(6 * self.layout.rows, bool)).matrix(self._blocks[:, :, :BLOCK])
        reduced = np.tril(lower) + np.tril(lower, -1).T
        centers = self._state.centers[self.layout.slot_frame]
        return Information(reduced, self._couplings, centers, self._V, self._M)

    def try_step(self, damping: float) -> Trial | None:
        """Solves the damped normal equations, moves everything by the solution and evaluates the cost there."""
        self._eliminate(damping)
        scaling = damping * self._marquardt_diagonal()
        if not self._solver.factor(self._blocks[:, :, :BLOCK], scaling.ravel(), self._threads):
            return None
        delta = self._solver.solve(self._side[:, :BLOCK].ravel()).reshape(-1, BLOCK)
        if not np.isfinite(delta).all():
            return None
        lay, now, then = self.layout, self._state, self._trial
        now.move(delta, lay, then)
        centers, totals = now.centers[lay.slot_frame], np.zeros((len(lay.point_chunks), 5))
        rotations, translations, _ = then.images

        def move(job: tuple[int, int]) -> None:
            kernels.move_points(
                *job, *self._couplings, centers, now.points3D, self._M, self._g, delta, then.points3D
            )  # fmt: skip

        def settle(job: tuple[int, tuple[int, int]]) -> None:
            k, points = job
            kernels.settle_points(
                *points, lay.offsets, lay.source, lay.image, lay.observed, lay.precision, self._image_cameras,
                self._model_ids, rotations, translations, then.params, now.points3D, *self._loss,
                damping, self._V, self._g, self._costs, then.points3D, totals[k],
            )  # fmt: skip

        self._run(move, lay.point_chunks)
        self._evaluate(then)
        self._run(settle, list(enumerate(lay.point_chunks)))
        cost, decrease, step, norm, lost = totals.sum(axis=0)
        cost += self._prior_cost(then.params)
        then.lost = int(lost)
        decrease += 0.5 * float(np.sum(scaling * delta**2 - self._gradient * delta))
        norm += np.sum(centers**2) + len(centers) + np.sum(now.params**2)
        return Trial(float(cost), float(decrease), float(np.sqrt(step + np.sum(delta**2))), float(np.sqrt(norm)))

    def accept(self) -> None:
        """Makes the last trial current."""
        self._state, self._trial = self._trial, self._state

    def _run(self, function: Callable[[Job], Answer], jobs: Sequence[Job]) -> list[Answer]:
        return list(ordered_map(function, jobs, threads=self._threads if len(jobs) > 1 else 1))

    def _evaluate(self, state: _State) -> None:
        """Fills the costs of all observations, NaN where there is no projection."""
        lay, limits = self.layout, kernels.squared_limits(self._model_ids, state.params)
        rotations, translations, _ = state.images

        def images(job: tuple[int, int]) -> None:
            kernels.costs_of_images(
                *job, lay.image_offsets, lay.image_point, lay.place, lay.observed, lay.precision,
                self._image_cameras, self._model_ids, limits, rotations, translations, state.params,
                state.points3D, *self._loss[:2], self._costs,
            )  # fmt: skip

        self._run(images, lay.image_chunks)

    def _unexpected(self, params: FloatArray) -> FloatArray:
        """θ − θ₀ (T, 6) of the free camera parameters that have a prior, 0 for the others."""
        return np.where(self._prior_weight > 0, _values(params, self.layout) - self._expected, 0.0)

    def _prior_cost(self, params: FloatArray) -> float:
        return 0.5 * float(np.sum(self._prior_weight * self._unexpected(params) ** 2))

    def _eliminate(self, damping: float) -> None:
        """Fills blocks, right-hand side and diagonal of the reduced system."""
        lay, pattern = self.layout, self._pattern
        self._blocks.fill(0)
        self._own.add(self._blocks)
        np.negative(self._own_gradient, out=self._side[:, :BLOCK])
        self._diagonal = np.einsum("kaa->ka", self._blocks[pattern.diagonal, :, :BLOCK])
        centers = self._state.centers[lay.slot_frame]
        self._run(lambda job: invert_blocks(*job, self._V, damping, self._M), lay.point_chunks)

        def rows(job: tuple[int, int]) -> None:
            eliminate(
                *job, *self._couplings, centers, self._state.points3D, self._M, self._g,
                pattern.offsets, pattern.columns, self._blocks, self._side, self._diagonal,
            )  # fmt: skip

        self._run(rows, self._row_ranges)

    def _marquardt_diagonal(self) -> FloatArray:
        """The diagonal of the normal matrix (rows, 6); tiny entries become a part of the largest of their kind."""
        poses = len(self.layout.slot_frame)
        raised = []
        for part in (self._diagonal[:poses], self._diagonal[poses:]):
            largest = part.max(axis=0, initial=0.0)
            raised.append(np.maximum(part, np.where(largest > 0, _FLOOR * largest, 1.0)))
        return np.concatenate(raised)


class Information(NamedTuple):
    """The reduced matrix (6 rows, 6 rows) without damping, and what was eliminated: see `sfm.core.optim.schur`.

    Attributes:
        centers: (S, 3) of the frames by row.
        V, M: (P, 6) information about each point alone, and its inverse.
    """

    reduced: np.ndarray
    couplings: Couplings
    centers: np.ndarray
    V: np.ndarray
    M: np.ndarray


class _OwnBlocks:
    """What images contribute to shared rows and their couplings with poses, whatever becomes of the points."""

    def __init__(self, layout: Layout, pattern: BlockPattern) -> None:
        rows, slots = layout.image_shared, layout.image_slot
        self._images, self._most = rows.shape
        self._place = layout.column_place
        self._shared, self._moving = rows >= 0, slots >= 0
        self._coupled = self._shared & self._moving[:, None]
        self._both = self._shared[:, :, None] & self._shared[:, None, :]
        self._both &= np.tri(self._most, dtype=bool)
        self._used = np.arange(layout.columns.shape[1]) < layout.column_count[:, None]
        images, k = np.nonzero(self._coupled)
        i, a, b = np.nonzero(self._both)
        targets = [
            pattern.numbers(rows[images, k], slots[images]),
            pattern.numbers(rows[i, a], rows[i, b]),
            pattern.diagonal[len(layout.slot_frame) :],
        ]
        self._scatter = _Scatter(np.concatenate(targets))
        self._rows = _Scatter(np.concatenate([slots[self._moving], rows[self._shared]]))
        self._blocks = np.zeros((0, 6, 6))

    def set(self, F: FloatArray, G: FloatArray, prior_weight: FloatArray) -> None:
        """Takes over the sums of a linearisation, and the weights of the priors on parameters (T, 6)."""
        size = self._most * BLOCK
        wide, square = np.zeros((self._images, size, BLOCK)), np.zeros((self._images, size, size))
        image, k = np.nonzero(self._used)
        wide[image, self._place[image, k]] = F[image, :, k]
        lower = self._used[:, :, None] & self._used[:, None, :] & np.tri(self._used.shape[1], dtype=bool)
        image, a, b = np.nonzero(lower)
        values = G[image, a, b]
        a, b = self._place[image, a], self._place[image, b]
        square[image, a, b] = square[image, b, a] = values
        square = square.reshape(self._images, self._most, BLOCK, self._most, BLOCK).transpose(0, 1, 3, 2, 4)
        wide = wide.reshape(self._images, self._most, BLOCK, BLOCK)
        priors = prior_weight[:, :, None] * np.eye(BLOCK)
        self._blocks = self._scatter.sums(np.concatenate([wide[self._coupled], square[self._both], priors]))

    def add(self, blocks: FloatArray) -> None:
        """Adds them to the blocks of the reduced system."""
        blocks[self._scatter.targets, :, :BLOCK] += self._blocks

    def add_gradients(self, h: FloatArray, f: FloatArray, rows: FloatArray) -> None:
        """Adds the gradients of the images' frames (I, 6) and columns (I, k) to the rows they belong to."""
        wide = np.zeros((self._images, self._most * BLOCK))
        image, k = np.nonzero(self._used)
        wide[image, self._place[image, k]] = f[image, k]
        shared = wide.reshape(self._images, self._most, BLOCK)[self._shared]
        rows[self._rows.targets] += self._rows.sums(np.concatenate([h[self._moving], shared]))


class _Scatter:
    """Sums of rows that go to the same target, in the order of the rows."""

    def __init__(self, targets: np.ndarray) -> None:
        self._order = np.argsort(targets, kind="stable")
        self.targets, self._starts = np.unique(targets[self._order], return_index=True)

    def sums(self, values: FloatArray) -> FloatArray:
        """The sums for `targets`."""
        return np.add.reduceat(values[self._order], self._starts) if len(self._order) else values[:0]


@dataclasses.dataclass(slots=True)
class _State:
    """Parameters as kernels want them; what is constant is the same in both states of a system.

    Attributes:
        wxyz, centers: (F, 4) and (F, 3) of the frames.
        frames: their poses; images: rotations (I, 3, 3), translations (I, 3) and poses of the images.
    """

    wxyz: np.ndarray
    centers: np.ndarray
    frames: Rigid3
    sensors: Rigid3
    rigs: RigArrays | None
    images: tuple[np.ndarray, np.ndarray, Rigid3]
    params: np.ndarray
    points3D: np.ndarray
    lost: int = 0

    @staticmethod
    def of(problem: BundleProblem) -> _State:
        rigs, poses = problem.rigs, problem.cams_from_world
        frames = poses if rigs is None else rigs.rigs_from_world
        return _State(
            frames.rotation.wxyz.copy(),
            frames.center.copy(),
            frames,
            Rigid3.identity((0,)) if rigs is None else rigs.sensors_from_rig,
            rigs,
            _as_arrays(poses),
            problem.camera_params.copy(),
            problem.points3D.copy(),
        )

    def copy(self) -> _State:
        copied = {name: getattr(self, name).copy() for name in ("wxyz", "centers", "params", "points3D")}
        return dataclasses.replace(self, **copied)

    def move(self, delta: FloatArray, layout: Layout, then: _State) -> None:
        """Fills `then` with the poses and parameters after a step (rows, 6) of the reduced system."""
        poses, shared = len(layout.slot_frame), layout.shared
        moves = np.any(delta[:poses] != 0, axis=1)
        moving, still = layout.slot_frame[moves], layout.slot_frame[~moves]
        kernels.turn_poses(moving, delta[:poses][moves], self.wxyz, self.centers, then.wxyz, then.centers)
        then.wxyz[still], then.centers[still] = self.wxyz[still], self.centers[still]
        then.frames = _moved_poses(self.frames, moving, then.wxyz, then.centers)
        row, place = np.nonzero((shared.columns >= 0) & (shared.camera >= 0)[:, None])
        cells = shared.camera[row], shared.columns[row, place]
        then.params[cells] = self.params[cells] + delta[poses + row, place]
        if self.rigs is None:
            then.images = _as_arrays(then.frames)
            return
        mounted = np.flatnonzero(shared.sensor >= 0)
        then.sensors = _shifted(self.sensors, shared.sensor[mounted], delta[poses + mounted])
        then.rigs = dataclasses.replace(self.rigs, rigs_from_world=then.frames, sensors_from_rig=then.sensors)
        then.images = _as_arrays(then.rigs.cams_from_world)


def _as_arrays(poses: Rigid3) -> tuple[np.ndarray, np.ndarray, Rigid3]:
    return poses.rotation.matrix, poses.translation, poses


def _moved_poses(before: Rigid3, moving: np.ndarray, wxyz: np.ndarray, centers: np.ndarray) -> Rigid3:
    """Poses of which only `moving` are new, those of `wxyz` and `centers`."""
    turned = Rotation3(wxyz[moving])
    translations, turns = before.translation.copy(), before.rotation.wxyz.copy()
    translations[moving] = -np.einsum("kab,kb->ka", turned.matrix, centers[moving])
    turns[moving] = turned.wxyz
    return Rigid3(Rotation3(turns), translations)


def _shifted(sensors: Rigid3, moving: np.ndarray, delta: FloatArray) -> Rigid3:
    """Sensors of which some moved by (ω, υ) on the left: exp(ω) R and exp(ω) t + υ."""
    turn = Rotation3.exp(delta[:, :3])
    turns, translations = sensors.rotation.wxyz.copy(), sensors.translation.copy()
    turns[moving] = (turn @ sensors.rotation[moving]).wxyz
    translations[moving] = turn @ translations[moving] + delta[:, 3:]
    return Rigid3(Rotation3(turns), translations)


def _values(params: FloatArray, layout: Layout) -> FloatArray:
    """(T, 6) the parameters in the places of the shared rows; anything where there is none."""
    columns = np.where(layout.shared.columns < SENSOR_COLUMN, np.maximum(layout.shared.columns, 0), 0)
    return params[np.maximum(layout.shared.camera, 0)[:, None], columns] if len(params) else np.zeros(columns.shape)


def _priors(problem: BundleProblem, layout: Layout) -> tuple[FloatArray, FloatArray]:
    """Expected values and inverse variances (T, 6) of the free parameters in the shared rows."""
    if problem.prior_params is None or problem.prior_sigmas is None:
        return np.zeros(layout.shared.columns.shape), np.zeros(layout.shared.columns.shape)
    is_param = (layout.shared.columns >= 0) & (layout.shared.camera >= 0)[:, None]
    weight = _values(problem.prior_sigmas, layout) ** -2.0
    return _values(problem.prior_params, layout), np.where(is_param, weight, 0.0)
