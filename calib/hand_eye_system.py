"""The reprojection error of a board before a camera on a robot, as the Levenberg–Marquardt loop wants it.

The board is seen in view k by the pose  T_k = X E_k G_k Z  (see `hand_eye_start`), where E_k is by how much the hand
is not where the robot says: small motions with a prior of standard deviations that are known, in the frame of the hand.
If that is not the mount but the world, it is  X G_k E_k Z. All move on the left,

    δ_view = δ_X + Ad(X) ε_k + Ad(X E_k G_k) δ_Z        or        δ_X + Ad(X G_k) ε_k + Ad(X G_k E_k) δ_Z

so that what `_refine_kernels` computes of a view by its pose becomes all that is needed. Views are eliminated, each
by its own 6 × 6 block; what is left is a matrix of X and Z, 12 × 12.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from calib import _refine_kernels as kernels
from calib.refine_views import Observations
from sfm.core.arrays import FloatArray, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.cameras._kernels import distortion_limit
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.optim.levenberg_marquardt import Trial
from sfm.core.optim.losses import loss_id

_LOST_COST = 0.5 * 1000.0**2
_NO_COLUMNS = np.zeros(0, np.int64)
_NO_RESIDUALS = np.zeros((0, 2))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class HandEyeEstimate(Value):
    """X = cam_from_mount, Z = world_from_board, and E_k (V,), by how much the hand is off."""

    cam_from_mount: Rigid3
    world_from_board: Rigid3
    errors: Rigid3


@dataclasses.dataclass(slots=True)
class _Point:
    estimate: HandEyeEstimate
    costs: Vector
    blocks: FloatArray
    priors: FloatArray


class HandEyeSystem:
    """A `sfm.core.optim.levenberg_marquardt.System`.

    Args:
        board: (P, 3) its points.
        mounts_from_world: batch (V,) as the robot says.
        hand_is_mount: whether the hand carries the camera; otherwise it carries the board.
        robot_information: (6,) inverse variances of (ω, υ) of E_k, times the variance of corners.
    """

    def __init__(
        self, observations: Observations, camera: Camera, board: FloatArray, mounts_from_world: Rigid3,
        estimate: HandEyeEstimate, *, hand_is_mount: bool, robot_information: Vector,
    ) -> None:  # fmt: skip
        self._hand_is_mount = hand_is_mount
        self.observations, self._camera, self._mounts = observations, camera, mounts_from_world
        self._board, self._basis = np.array(board), np.zeros((len(board), 3, 0))
        self._limit = distortion_limit(camera.model_info.model_id, np.array(camera.params)) ** 2
        self._information = np.asarray(robot_information, np.float64)
        self._now = self._trial = self._evaluated(estimate)

    @property
    def estimate(self) -> HandEyeEstimate:
        """At the current parameters."""
        return self._now.estimate

    @property
    def cams_from_board(self) -> Rigid3:
        """T_k, batch (V,)."""
        return self._poses(self._now.estimate)

    def residuals(self) -> FloatArray:
        """(n, 2) projected − observed in px; NaN where there is no projection."""
        out = np.empty((len(self.observations.rows), 2))
        self._run(self._now.estimate, self._now.costs, self._now.blocks, out)
        return out

    def linearize(self) -> tuple[float, float]:
        """Cost and largest entry of the gradient at the current parameters."""
        H, W, A = self.normal_equations()
        self._equations = H, W, A
        self._diagonal, self._shared_diagonal = np.diagonal(H, axis1=1, axis2=2), np.diag(A)[:12]
        return self._cost(self._now), float(np.abs(A[:12, 12]).max())

    def normal_equations(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """H (V, 6, 6), W (V, 6, 13) and A (13, 13) by (X, Z); the last column is the gradient."""
        now, views = self._now, len(self.observations)
        by_pose = np.tril(now.blocks[:, :6, :6])
        by_pose = by_pose + np.tril(by_pose, -1).swapaxes(1, 2)
        gradient = now.blocks[:, -1, :6]
        to_hand, to_world = self._chain(now.estimate)
        J = np.zeros((views, 6, 12))
        J[:, :, :6] = np.eye(6)
        J[:, :, 6:] = to_world.adjoint()
        Ad = to_hand.adjoint()
        transposed = Ad.swapaxes(1, 2)
        W, A = np.empty((views, 6, 13)), np.zeros((13, 13))
        W[:, :, :12] = transposed @ by_pose @ J
        W[:, :, 12] = np.einsum("vki,vk->vi", Ad, gradient) + self._information * now.priors
        A[:12, :12] = np.einsum("vki,vkl,vlj->ij", J, by_pose, J, optimize=True)
        A[:12, 12] = A[12, :12] = np.einsum("vki,vk->i", J, gradient)
        return transposed @ by_pose @ Ad + np.diag(self._information), W, A

    def try_step(self, damping: float) -> Trial | None:
        """Solves the damped normal equations, moves by the solution and evaluates there."""
        solved = self._solve(damping)
        if solved is None:
            return None
        by_view, shared, _ = solved
        old = self._now.estimate
        moved = HandEyeEstimate(
            _moved(old.cam_from_mount, shared[:6]),
            _moved(old.world_from_board, shared[6:]),
            _moved(old.errors, by_view),
        )
        self._trial = self._evaluated(moved)
        _, W, A = self._equations
        slope = float(np.vdot(W[:, :, 12], by_view) + A[:12, 12] @ shared)
        damped = float(np.vdot(self._diagonal, by_view**2) + self._shared_diagonal @ shared**2)
        square = float(np.vdot(by_view, by_view) + shared @ shared)
        norm = float(
            np.linalg.norm(moved.cam_from_mount.translation) + np.linalg.norm(moved.world_from_board.translation)
        )
        return Trial(self._cost(self._trial), 0.5 * (damping * damped - slope), math.sqrt(square), norm)

    def accept(self) -> None:
        """Makes the last trial current."""
        self._now = self._trial

    def shared_inverse(self) -> FloatArray | None:
        """S⁻¹ (12, 12) of the tangents of X and Z; None where they are not determined."""
        self.linearize()
        solved = self._solve(0.0)
        if solved is None:
            return None
        return np.linalg.inv(solved[2])

    def newton_decrement(self) -> float:
        """What one more undamped step promises to take off the cost; inf where there is no such step."""
        self.linearize()
        solved = self._solve(0.0)
        if solved is None:
            return math.inf
        _, W, A = self._equations
        return -0.5 * float(np.vdot(W[:, :, 12], solved[0]) + A[:12, 12] @ solved[1])

    def _solve(self, damping: float) -> tuple[FloatArray, Vector, FloatArray] | None:
        H, W, A = self._equations
        six = np.arange(6)
        damped = H.copy()
        damped[:, six, six] *= 1 + damping
        try:
            solved = np.linalg.solve(damped, W)
            S = A - np.einsum("vki,vkj->ij", W, solved)
            matrix = S[:12, :12] + np.diag(damping * self._shared_diagonal)
            np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            return None
        shared = -np.linalg.solve(matrix, S[:12, 12])
        by_view = -(solved[:, :, 12] + solved[:, :, :12] @ shared)
        return (by_view, shared, matrix) if np.all(np.isfinite(by_view)) and np.all(np.isfinite(shared)) else None

    def _cost(self, point: _Point) -> float:
        return float(point.costs.sum() + 0.5 * np.sum(self._information * point.priors**2))

    def _poses(self, estimate: HandEyeEstimate) -> Rigid3:
        return self._chain(estimate)[1] @ Rigid3.stack([estimate.world_from_board] * len(self.observations))

    def _chain(self, estimate: HandEyeEstimate) -> tuple[Rigid3, Rigid3]:
        """What E_k is multiplied by from the left, and Z."""
        X = Rigid3.stack([estimate.cam_from_mount] * len(self.observations))
        if self._hand_is_mount:
            return X, X @ estimate.errors @ self._mounts
        to_hand = X @ self._mounts
        return to_hand, to_hand @ estimate.errors

    def _evaluated(self, estimate: HandEyeEstimate) -> _Point:
        views = len(self.observations)
        costs, blocks = np.empty(views), np.empty((views, 7, 7))
        self._run(estimate, costs, blocks, _NO_RESIDUALS)
        return _Point(estimate, costs, blocks, estimate.errors.log())

    def _run(self, estimate: HandEyeEstimate, costs: Vector, blocks: FloatArray, residuals: FloatArray) -> None:
        o, poses = self.observations, self._poses(estimate)
        kernels.evaluate_views(
            self._camera.model_info.model_id, np.array(self._camera.params), _NO_COLUMNS, self._limit,
            poses.rotation.matrix, np.array(poses.translation), o.offsets, o.rows, self._board, self._basis, o.points2D,
            o.roots, loss_id("trivial"), 1.0, _LOST_COST, costs, blocks, residuals,
        )  # fmt: skip


def _moved(poses: Rigid3, steps: FloatArray) -> Rigid3:
    """exp(ω) R, exp(ω) t + υ, the movement whose derivative the kernels take."""
    turn = Rotation3.exp(steps[..., :3])
    turned = np.einsum("...ij,...j->...i", turn.matrix, poses.translation)
    return Rigid3(turn @ poses.rotation, turned + steps[..., 3:])
