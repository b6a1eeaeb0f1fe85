"""The joint problem of cameras, their mounts, the frames' poses and the board as the Levenberg–Marquardt loop wants it.

Camera c sees the board's point X in frame f where its model projects  T_c T_f X,  T_c = cam_from_rig (the identity for
camera 0) and T_f = rig_from_board. All are moved on the left, so that the pose T_c T_f of the view moves by

    δ_view = δ_c + Ad(T_c) δ_f

and what `_refine_kernels` computes of a view by its own pose, H, W and the gradient, becomes what it contributes to its
frame and to its camera by products with Ad(T_c) and the identity: nothing is derived anew. Frames see one another only
through what they share, and are eliminated, each by its own 6 × 6 block:

    S = A − Σ_f W_f H_f⁻¹ W_fᵀ

is a matrix of the shared parameters alone: mounts, free parameters of the cameras, free coefficients of the board.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from calib import _refine_kernels as kernels
from calib.rig_estimate import RigEstimate
from calib.rig_views import RigObservations
from sfm.core.arrays import FloatArray, Vector
from sfm.core.cameras._kernels import distortion_limit
from sfm.core.geometry.rotation import skew
from sfm.core.optim.levenberg_marquardt import Trial
from sfm.core.optim.losses import Loss, evaluate_loss, loss_id

_LOST_PX = 1000.0
"""What an observation without projection costs, as a residual."""
_FLOOR = 1e-12
"""Least diagonal of the damping, over the largest of its kind."""
_PIVOT = 1e-14
"""Least pivot, over the diagonal before elimination, that is not a rounding error."""
_NO_RESIDUALS = np.zeros((0, 2))


@dataclasses.dataclass(slots=True)
class _Point:
    """Parameters, and of each camera what was evaluated there."""

    params: list[FloatArray]
    coefficients: FloatArray
    mounts: tuple[FloatArray, FloatArray]
    frames: tuple[FloatArray, FloatArray]
    costs: list[FloatArray]
    blocks: list[FloatArray]


@dataclasses.dataclass(frozen=True, slots=True)
class NormalEquations:
    """H (F, 6, 6) of the frames, W (F, 6, K + 1) and A (K + 1, K + 1) by what is shared; the last column is Jᵀe."""

    H: FloatArray
    W: FloatArray
    A: FloatArray


class RigSystem:
    """A `sfm.core.optim.levenberg_marquardt.System`.

    Args:
        columns: of each camera the positions of its free parameters.
        free_mounts: whether cameras but the first move in the rig.
        loss: of whitened residuals, with its scale; see `CalibrationSystem`, also for `keep_invertible` and `caution`.
    """

    def __init__(
        self, observations: RigObservations, estimate: RigEstimate, columns: Sequence[np.ndarray], *,
        free_mounts: bool = True, free_shape: bool = False, loss: Loss = "trivial", loss_scale: float = 1.0,
        keep_invertible: bool = True, caution: float = 1.0,
    ) -> None:  # fmt: skip
        self.observations, self._cameras, self._shape = observations, estimate.cameras, estimate.shape
        self._columns = [np.asarray(positions, np.int64) for positions in columns]
        basis = estimate.shape.basis
        self._basis = basis if free_shape else np.ascontiguousarray(basis[:, :, :0])
        self._loss = loss_id(loss), float(loss_scale)
        self._lost = 0.5 * float(evaluate_loss(loss, np.array(_LOST_PX**2), loss_scale)[0])
        self._keep_invertible, self._caution = keep_invertible, caution
        self._lay_out(free_mounts)
        self._now = self._place(estimate)
        self._trial = self._place(estimate)
        self._evaluate(self._now)

    def _lay_out(self, free_mounts: bool) -> None:
        """Where what is shared lies: mounts, parameters of one camera after the other, the board."""
        count, self._mounts = 0, []
        for c in range(len(self._cameras)):
            self._mounts.append(slice(count, count + 6 if free_mounts and c else count))
            count = self._mounts[c].stop
        self._params = []
        for positions in self._columns:
            self._params.append(slice(count, count + len(positions)))
            count += len(positions)
        self.shared_count = count + self._basis.shape[2]
        self._coefficients = slice(count, self.shared_count)
        beyond = np.arange(count, self.shared_count + 1)
        self._places = [np.concatenate([np.arange(part.start, part.stop), beyond]) for part in self._params]

    @property
    def mount_slices(self) -> list[slice]:
        """Of each camera where its mount's tangent is among what is shared; empty where it is held."""
        return self._mounts

    @property
    def param_slices(self) -> list[slice]:
        """Of each camera where its free parameters are among what is shared."""
        return self._params

    @property
    def estimate(self) -> RigEstimate:
        """At the current parameters."""
        now = self._now
        cameras = [
            dataclasses.replace(camera, params=params.copy(), has_prior_focal_length=True)
            for camera, params in zip(self._cameras, now.params, strict=True)
        ]
        shape = dataclasses.replace(self._shape, coefficients=now.coefficients.copy())
        mounts, frames = [part.copy() for part in now.mounts], [part.copy() for part in now.frames]
        return RigEstimate(tuple(cameras), mounts[0], mounts[1], frames[0], frames[1], shape)

    def residuals(self) -> list[FloatArray]:
        """Of each camera (n, 2) projected − observed in px; NaN where there is no projection."""
        out = [np.empty((len(camera.rows), 2)) for camera in self.observations.cameras]
        self._evaluate(self._now, out)
        return out

    def whitened_lengths(self) -> list[Vector]:
        """Of each camera (n,) lengths of the whitened residuals; inf where there is no projection."""
        found = []
        for r, camera in zip(self.residuals(), self.observations.cameras, strict=True):
            a, b, c = camera.roots.T
            lengths = np.hypot(a * r[:, 0] + b * r[:, 1], c * r[:, 1])
            found.append(np.where(np.isfinite(lengths), lengths, np.inf))
        return found

    def by_frame(self) -> tuple[FloatArray, FloatArray]:
        """What each frame adds to S (F, K, K) and to the gradient (F, K), with its pose eliminated."""
        equations, count = self.normal_equations(), self.shared_count + 1
        A = np.zeros((len(equations.H), count, count))
        for c, (blocks, seen) in enumerate(zip(self._now.blocks, self.observations.frame_of, strict=True)):
            mount, at = self._mounts[c], self._places[c]
            places = np.concatenate([np.arange(mount.start, mount.stop), at])
            # A mount moves its views as their own poses do.
            first = 6 - (mount.stop - mount.start)
            lower = np.tril(blocks[:, first:, first:])
            A[np.ix_(seen, places, places)] += lower + np.tril(lower, -1).swapaxes(1, 2)
        A -= equations.W.swapaxes(1, 2) @ np.linalg.solve(equations.H, equations.W)
        return A[:, :-1, :-1], A[:, :-1, -1]

    def normal_equations(self) -> NormalEquations:
        """At the current parameters."""
        frames, count = len(self.observations.frames), self.shared_count + 1
        H, W, A = np.zeros((frames, 6, 6)), np.zeros((frames, 6, count)), np.zeros((count, count))
        six = np.arange(6)
        for c, (blocks, seen) in enumerate(zip(self._now.blocks, self.observations.frame_of, strict=True)):
            by_pose, mount, at = np.tril(blocks[:, :6, :6]), self._mounts[c], self._places[c]
            by_pose = by_pose + np.tril(by_pose, -1).swapaxes(1, 2)
            across = blocks[:, 6:, :6].swapaxes(1, 2)
            shared = np.tril(blocks[:, 6:, 6:].sum(0))
            Ad = _adjoint(self._now.mounts[0][c], self._now.mounts[1][c])
            H[seen] += Ad.T @ by_pose @ Ad
            W[np.ix_(seen, six, at)] += Ad.T @ across
            A[np.ix_(at, at)] += shared + np.tril(shared, -1).T
            if mount.stop > mount.start:
                W[seen, :, mount] += Ad.T @ by_pose
                A[mount, mount] += by_pose.sum(0)
                A[mount, at] += across.sum(0)
                A[at, mount] += across.sum(0).T
        return NormalEquations(H, W, A)

    def linearize(self) -> tuple[float, float]:
        """Cost and largest entry of the gradient at the current parameters."""
        self._equations = equations = self.normal_equations()
        diagonal = np.diagonal(equations.H, axis1=1, axis2=2)
        self._diagonal = self._caution * np.maximum(diagonal, _FLOOR * diagonal.max(initial=0.0))
        shared = np.diag(equations.A)[:-1]
        self._shared_diagonal = self._caution * np.where(shared > 0, shared, 1.0)
        self._gradient = equations.W[:, :, -1], equations.A[:-1, -1]
        return self._cost(self._now), max(float(np.abs(part).max(initial=0.0)) for part in self._gradient)

    def try_step(self, damping: float) -> Trial | None:
        """Solves the damped normal equations, moves by the solution and evaluates there."""
        solved = self._solve(damping)
        if solved is None:
            return None
        by_frame, by_shared, _ = solved
        now, trial = self._now, self._trial
        by_mount = np.zeros((len(self._cameras), 6))
        for c, mount in enumerate(self._mounts):
            if mount.stop > mount.start:
                by_mount[c] = by_shared[mount]
            trial.params[c] = now.params[c].copy()
            trial.params[c][self._columns[c]] += by_shared[self._params[c]]
        trial.coefficients = now.coefficients.copy()
        if self._basis.shape[2]:
            trial.coefficients += by_shared[self._coefficients]
        kernels.move_poses(*now.mounts, by_mount, *trial.mounts)
        kernels.move_poses(*now.frames, by_frame, *trial.frames)
        self._evaluate(trial)
        damped = float(np.vdot(self._diagonal, by_frame**2) + self._shared_diagonal @ by_shared**2)
        slope = float(np.vdot(self._gradient[0], by_frame) + self._gradient[1] @ by_shared)
        square = float(np.vdot(by_frame, by_frame) + by_shared @ by_shared)
        norm = float(np.vdot(now.frames[1], now.frames[1])) + sum(float(p @ p) for p in now.params)
        return Trial(self._cost(trial), 0.5 * (damping * damped - slope), math.sqrt(square), math.sqrt(norm))

    def accept(self) -> None:
        """Makes the last trial current."""
        self._now, self._trial = self._trial, self._now

    def shared_inverse(self) -> FloatArray | None:
        """S⁻¹ (K, K) at the current parameters, None where they are not determined."""
        self.linearize()
        solved = self._solve(0.0)
        if solved is None:
            return None
        root = np.linalg.solve(solved[2], np.eye(self.shared_count))
        return root.T @ root

    def newton_decrement(self) -> float:
        """What one more undamped step promises to take off the cost; inf where there is no such step."""
        self.linearize()
        solved = self._solve(0.0)
        if solved is None:
            return math.inf
        return -0.5 * float(np.vdot(self._gradient[0], solved[0]) + self._gradient[1] @ solved[1])

    def _solve(self, damping: float) -> tuple[FloatArray, Vector, FloatArray] | None:
        """Steps of the frames (F, 6) and of what is shared (K,), and the factor of S; None where it is indefinite."""
        H, W, A = self._equations.H, self._equations.W, self._equations.A
        six = np.arange(6)
        damped = H.copy()
        damped[:, six, six] += damping * self._diagonal
        L = _factor(damped, np.diagonal(H, axis1=1, axis2=2))
        if L is None:
            return None
        Y = np.linalg.solve(L, W)
        flat = Y.reshape(-1, Y.shape[2])
        S = A - flat.T @ flat
        root = _factor(S[:-1, :-1] + np.diag(damping * self._shared_diagonal), np.diag(A)[:-1])
        if root is None:
            return None
        by_shared = -np.linalg.solve(root.T, np.linalg.solve(root, S[:-1, -1]))
        left = Y[:, :, -1] + Y[:, :, :-1] @ by_shared
        by_frame = -np.linalg.solve(L.swapaxes(1, 2), left[:, :, None])[:, :, 0]
        if not (np.all(np.isfinite(by_frame)) and np.all(np.isfinite(by_shared))):
            return None
        return np.ascontiguousarray(by_frame), by_shared, root

    def _cost(self, point: _Point) -> float:
        return float(sum(part.sum() for part in point.costs))

    def _place(self, estimate: RigEstimate) -> _Point:
        widths = [7 + len(positions) + self._basis.shape[2] for positions in self._columns]
        counts = [len(camera) for camera in self.observations.cameras]
        return _Point(
            params=[np.array(camera.params) for camera in estimate.cameras],
            coefficients=np.array(estimate.shape.coefficients),
            mounts=(np.array(estimate.mount_rotations), np.array(estimate.mount_translations)),
            frames=(np.array(estimate.frame_rotations), np.array(estimate.frame_translations)),
            costs=[np.empty(count) for count in counts],
            blocks=[np.empty((count, width, width)) for count, width in zip(counts, widths, strict=True)],
        )

    def _evaluate(self, point: _Point, residuals: Sequence[FloatArray] | None = None) -> None:
        board = self._shape.given
        if self._basis.shape[2]:
            board = board + self._shape.basis @ point.coefficients
        elif len(self._shape.coefficients):
            board = self._shape.points3D
        for c, (o, seen) in enumerate(zip(self.observations.cameras, self.observations.frame_of, strict=True)):
            model, params = self._cameras[c].model_info.model_id, point.params[c]
            limit = distortion_limit(model, params) ** 2 if self._keep_invertible else -math.inf
            R, t = point.mounts[0][c], point.mounts[1][c]
            kernels.evaluate_views(
                model, params, self._columns[c], limit, R @ point.frames[0][seen], point.frames[1][seen] @ R.T + t,
                o.offsets, o.rows, np.array(board), self._basis, o.points2D, o.roots, *self._loss, self._lost,
                point.costs[c], point.blocks[c], _NO_RESIDUALS if residuals is None else residuals[c],
            )  # fmt: skip


def _adjoint(R: FloatArray, t: FloatArray) -> FloatArray:
    """Ad of one motion; see `Rigid3.adjoint`."""
    Ad = np.zeros((6, 6))
    Ad[:3, :3] = Ad[3:, 3:] = R
    Ad[3:, :3] = skew(t) @ R
    return Ad


def _factor(matrices: FloatArray, before: FloatArray) -> FloatArray | None:
    """Cholesky factors; None where one is indefinite, or a pivot is nothing but rounding of its diagonal `before`."""
    try:
        L = np.linalg.cholesky(matrices)
    except np.linalg.LinAlgError:
        return None
    pivots = np.diagonal(L, axis1=-2, axis2=-1) ** 2
    return L if np.all(pivots > _PIVOT * before) else None
