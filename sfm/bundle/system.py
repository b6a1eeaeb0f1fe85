"""The normal equations of a reprojection problem, for the damping loop.

A point X seen by an image with pose (R, t) lies at x = R X + t in the camera and is projected to π(x, θ), θ the
parameters of the camera. With A = ∂π/∂x, Q = ∂π/∂θ, and poses moved on the left by exp(ω, υ):

    r = π(x, θ) − observed        ∂r/∂(ω, υ) = A [−[x]×, I]        ∂r/∂θ = Q        ∂r/∂X = A R

Rows are scaled by √ρ'(|r|²), see `sfm.core.optim.losses`; how points are eliminated is in `sfm.core.optim.schur`.
A camera parameter that is expected to be θ₀ with standard deviation σ adds ½ ((θ − θ₀) / σ)².
Points are cut into chunks whose number depends on the problem alone and whose sums are added in order.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from sfm.bundle import _kernels as kernels
from sfm.bundle.layout import Layout
from sfm.bundle.problem import BundleConfig, BundleProblem
from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.execution import ordered_map
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.optim.levenberg_marquardt import Trial
from sfm.core.optim.losses import loss_id
from sfm.core.optim.schur import ReducedSystem, eliminate_border, eliminate_poses, invert_blocks, solve_reduced

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
        self.layout, self._threads = layout, threads
        self._image_cameras, self._model_ids = problem.image_cameras.copy(), problem.model_ids.astype(np.int64)
        self._free_points = problem.free_points.copy()
        self._loss = (loss_id(config.loss), float(config.loss_scale_px), float(lost_cost))
        poses = problem.cams_from_world
        self._state = _State(
            poses.rotation.wxyz.copy(),
            poses.translation.copy(),
            poses.rotation.matrix,
            problem.camera_params.copy(),
            problem.points3D.copy(),
        )
        self._trial = self._state.copy()

        images, points, observations = len(self._image_cameras), len(problem.points3D), len(layout.image)
        chunks, K = len(layout.point_chunks), layout.columns.shape[1]
        self._pose_count = 6 * len(layout.slot_image)
        slots = np.arange(len(layout.slot_image))
        self._diagonal_blocks = slots * (slots + 3) // 2
        self.held = np.concatenate([held.ravel(), (layout.columns[layout.slot_camera] < 0).ravel()])
        self._H, self._F = np.empty((chunks, images, 6, 6)), np.empty((chunks, images, K, 6 + K))
        self._h = np.empty((chunks, images, 6 + K))
        self._V, self._g, self._M = np.empty((points, 6)), np.empty((points, 3)), np.empty((points, 6))
        self._W, self._B = np.empty((observations, 3, 6)), np.empty((len(layout.coupling_point), 3, K))
        self._reduced = ReducedSystem.allocate(len(layout.slot_image), len(layout.slot_camera) * K, layout.copies)
        self._gradient = self._diagonal = np.empty(0)
        columns = layout.columns[layout.slot_camera]
        self._expected, self._prior_weight = _priors(problem, layout.slot_camera, columns)

    @property
    def free_count(self) -> int:
        """Number of scalars that may change and that an observation sees."""
        seen = np.diff(self.layout.offsets) > 0
        return int(np.sum(~self.held)) + 3 * int(np.sum(self._free_points & seen))

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
        """Current poses, a batch (I,)."""
        return Rigid3(Rotation3(self._state.wxyz), self._state.translations)

    @property
    def lost(self) -> int:
        """Observations without a projection at the current parameters."""
        return self._state.lost

    def linearize(self) -> tuple[float, float]:
        """Cost and largest entry of the gradient at the current parameters."""
        lay, now = self.layout, self._state
        for sums in (self._H, self._F, self._h, self._B):
            sums.fill(0)

        def chunk(job: tuple[int, tuple[int, int]]) -> float:
            k, (first, last) = job
            return kernels.linearize(
                first, last, lay.offsets, lay.image, lay.observed, lay.precision, lay.obs_coupling, self._free_points,
                self._image_cameras, self._model_ids, lay.columns, lay.pose_slot,
                now.rotations, now.translations, now.params, now.points3D, *self._loss,
                self._H[k], self._F[k], self._h[k], self._V, self._g, self._W, self._B,
            )  # fmt: skip

        cost = sum(self._run(chunk, list(enumerate(lay.point_chunks)))) + self._prior_cost(now.params)
        self._images = _total(self._H), _total(self._F), _total(self._h)
        self._add_images()
        self._gradient = np.where(self.held, 0.0, -self._reduced.side())
        self._diagonal = self._marquardt_diagonal()
        largest = max(np.abs(self._gradient).max(initial=0.0), np.abs(self._g).max(initial=0.0))
        return float(cost), float(largest)

    def information(self) -> tuple[FloatArray, Eliminated]:
        """The reduced matrix S (N, N) without damping, and what is known of the points, as last linearised."""
        self._add_images()
        self._eliminate(0.0)
        lower = np.tril(self._reduced.matrix())
        return lower + np.tril(lower, -1).T, Eliminated(self._W, self._B, self._V, self._M)

    def try_step(self, damping: float) -> Trial | None:
        """Solves the damped normal equations, moves everything by the solution and evaluates the cost there."""
        self._add_images()
        self._eliminate(damping)
        delta = solve_reduced(self._reduced, damping * self._diagonal, self.held)
        if delta is None:
            return None
        lay, now, then = self.layout, self._state, self._trial
        pose_delta, camera_delta = delta[: self._pose_count].reshape(-1, 6), delta[self._pose_count :]
        kernels.move_poses(
            lay.slot_image, pose_delta, now.wxyz, now.translations, then.wxyz, then.translations, then.rotations
        )
        self._move_params(camera_delta)
        totals = np.zeros((len(lay.point_chunks), 5))

        def chunk(job: tuple[int, tuple[int, int]]) -> None:
            k, (first, last) = job
            kernels.try_points(
                first, last, lay.offsets, lay.image, lay.observed, lay.precision, lay.starts, lay.obs_slot,
                lay.coupling_offsets, lay.coupling_slot, self._image_cameras, self._model_ids,
                then.rotations, then.translations, then.params, now.points3D, *self._loss,
                damping, self._M, self._V, self._g, self._W, self._B, pose_delta, camera_delta,
                then.points3D, totals[k],
            )  # fmt: skip

        self._run(chunk, list(enumerate(lay.point_chunks)))
        cost, decrease, step, norm, lost = totals.sum(axis=0)
        cost += self._prior_cost(then.params)
        then.lost = int(lost)
        decrease += 0.5 * (damping * self._diagonal @ delta**2 - self._gradient @ delta)
        norm += np.sum(now.translations**2) + len(now.wxyz) + np.sum(now.params**2)
        return Trial(float(cost), float(decrease), float(np.sqrt(step + delta @ delta)), float(np.sqrt(norm)))

    def accept(self) -> None:
        """Makes the last trial current."""
        self._state, self._trial = self._trial, self._state

    def _run(self, function: Callable[[Job], Answer], jobs: Sequence[Job]) -> list[Answer]:
        return list(ordered_map(function, jobs, threads=self._threads if len(jobs) > 1 else 1))

    def _add_images(self) -> None:
        """The reduced system before elimination: what images contribute on their own."""
        reduced, lay = self._reduced, self.layout
        H, F, h = self._images
        reduced.clear()
        reduced.blocks[0, self._diagonal_blocks] = H[lay.slot_image]
        reduced.pose_side[0] = -h[lay.slot_image, :6]
        cameras, K = len(lay.slot_camera), lay.columns.shape[1]
        if not cameras:
            return
        images = np.flatnonzero(lay.image_slot >= 0)
        moving = images[lay.pose_slot[images] >= 0]
        border = reduced.border[0].reshape(-1, cameras, K, 6)
        border[lay.pose_slot[moving], lay.image_slot[moving]] = F[moving, :, :6]
        corner, rows = np.zeros((cameras, K, K)), np.arange(cameras)
        np.add.at(corner, lay.image_slot[images], F[images, :, 6:])
        reduced.corner[0].reshape(cameras, K, cameras, K)[rows, :, rows] = corner
        np.add.at(reduced.corner_side[0].reshape(cameras, K), lay.image_slot[images], -h[images, 6:])
        diagonal = np.arange(cameras * K)
        reduced.corner[0][diagonal, diagonal] += self._prior_weight.ravel()
        reduced.corner_side[0] -= (self._prior_weight * self._unexpected(self._state.params)).ravel()

    def _unexpected(self, params: FloatArray) -> FloatArray:
        """θ − θ₀ (S, K) of the free camera parameters that have a prior, 0 for the others."""
        lay = self.layout
        index = np.maximum(lay.columns[lay.slot_camera], 0)
        values = np.take_along_axis(params[lay.slot_camera], index, axis=1)
        return np.where(self._prior_weight > 0, values - self._expected, 0.0)

    def _prior_cost(self, params: FloatArray) -> float:
        return 0.5 * float(np.sum(self._prior_weight * self._unexpected(params) ** 2))

    def _eliminate(self, damping: float) -> None:
        reduced, lay = self._reduced, self.layout
        invert_blocks(0, len(self._V), self._V, damping, self._M)

        def poses(job: tuple[int, np.ndarray]) -> None:
            k, order = job
            eliminate_poses(
                order, lay.starts, lay.point, lay.obs_slot, self._W, self._M, self._g,
                lay.coupling_offsets, lay.coupling_slot, self._B,
                reduced.blocks[k], reduced.border[k], reduced.pose_side[k],
            )  # fmt: skip

        def shared(job: tuple[int, np.ndarray]) -> None:
            k, order = job
            eliminate_border(
                order, lay.coupling_offsets, lay.coupling_point, lay.coupling_slot, self._B, self._M, self._g,
                reduced.corner[k], reduced.corner_side[k],
            )  # fmt: skip

        self._run(poses, lay.jobs)
        self._run(shared, lay.coupling_jobs)

    def _marquardt_diagonal(self) -> FloatArray:
        """The diagonal of the normal matrix; tiny entries are raised to a part of the largest of their kind."""
        parts = (
            np.einsum("iaa->ia", self._reduced.blocks[0, self._diagonal_blocks]),
            np.diagonal(self._reduced.corner[0]).reshape(-1, max(self.layout.columns.shape[1], 1)),
        )
        raised = []
        for part in parts:
            largest = part.max(axis=0, initial=0.0)
            raised.append(np.maximum(part, np.where(largest > 0, _FLOOR * largest, 1.0)).ravel())
        return np.concatenate(raised)

    def _move_params(self, delta: FloatArray) -> None:
        lay = self.layout
        columns = lay.columns[lay.slot_camera]
        rows, k = np.nonzero(columns >= 0)
        cells = lay.slot_camera[rows], columns[rows, k]
        self._trial.params[cells] = self._state.params[cells] + delta.reshape(columns.shape)[rows, k]


class Eliminated(NamedTuple):
    """Of the points: couplings with poses (n, 3, 6) and cameras (E, 3, K), information and its inverse (P, 6)."""

    W: np.ndarray
    B: np.ndarray
    V: np.ndarray
    M: np.ndarray


@dataclasses.dataclass(slots=True)
class _State:
    """Parameters as kernels want them; what is constant is the same in both states of a system."""

    wxyz: np.ndarray
    translations: np.ndarray
    rotations: np.ndarray
    params: np.ndarray
    points3D: np.ndarray
    lost: int = 0

    def copy(self) -> _State:
        return _State(
            self.wxyz.copy(), self.translations.copy(), self.rotations.copy(), self.params.copy(), self.points3D.copy()
        )


def _priors(problem: BundleProblem, cameras: np.ndarray, columns: np.ndarray) -> tuple[FloatArray, FloatArray]:
    """Expected values and inverse variances (S, K) of the free parameters of these cameras."""
    if problem.prior_params is None or problem.prior_sigmas is None:
        return np.zeros(columns.shape), np.zeros(columns.shape)
    index = np.maximum(columns, 0)
    expected = np.take_along_axis(problem.prior_params[cameras], index, axis=1)
    weight = np.take_along_axis(problem.prior_sigmas[cameras], index, axis=1) ** -2.0
    return expected, np.where(columns >= 0, weight, 0.0)


def _total(chunks: FloatArray) -> FloatArray:
    return chunks[0] if len(chunks) == 1 else chunks.sum(axis=0)
