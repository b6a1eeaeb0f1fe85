"""The joint problem of camera, poses and board as the Levenberg–Marquardt loop wants it.

Views see one another only through the camera and the board. With the poses of the views eliminated, each from its own
6 × 6 block H_v,

    S = Σ_v (A_v − W_v H_v⁻¹ W_vᵀ)

is what is left of the normal equations, a matrix of the free parameters alone: the work of a step grows with the number
of views and no faster. At the minimum S⁻¹ is the covariance of the parameters.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from calib import _refine_kernels as kernels
from calib.refine_board import BoardShape
from calib.refine_views import Observations
from sfm.core.arrays import FloatArray, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.cameras._kernels import distortion_limit
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.optim.levenberg_marquardt import Trial
from sfm.core.optim.losses import Loss, evaluate_loss, loss_id

_LOST_PX = 1000.0
"""What an observation without projection costs, as a residual."""
_FLOOR = 1e-12
"""Least diagonal of the damping, over the largest of its kind."""
_CONVERGED, _EXACT = 1e-9, 1e-20
"""Part of the cost, and px² a corner, that need not be gained."""
RIDGE = 1e-12
"""Damping that makes a matrix definite in which coefficients of a lens are not determined, and changes nothing else."""
_LOCAL = 1e-4
"""Part of the cost that a step takes off, below which it teaches something of the second derivative."""
_NO_STEP = (math.nan, math.nan, math.nan)
_NO_RESIDUALS = np.zeros((0, 2))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Estimate(Value):
    """What is estimated: camera, `cams_from_board` as rotations (V, 3, 3) and translations (V, 3), and the board."""

    camera: Camera
    rotations: FloatArray
    translations: FloatArray
    shape: BoardShape

    @property
    def cams_from_board(self) -> Rigid3:
        """Poses, a batch (V,)."""
        return Rigid3(Rotation3.from_matrix(self.rotations), self.translations)

    def of_views(self, views: list[int]) -> Estimate:
        """With the poses of these views only."""
        return dataclasses.replace(self, rotations=self.rotations[views], translations=self.translations[views])


@dataclasses.dataclass(slots=True)
class _Point:
    """Parameters, and what was evaluated there."""

    params: FloatArray
    coefficients: FloatArray
    rotations: FloatArray
    translations: FloatArray
    costs: FloatArray
    blocks: FloatArray
    cost: float = math.nan


class CalibrationSystem:
    """A `sfm.core.optim.levenberg_marquardt.System`.

    Args:
        columns: positions of the parameters of the camera that are free; none refines poses alone.
        loss: of residuals in px (in units of their typical deviation where covariances were given), with its scale.
        keep_invertible: lets no observation lie where the distortion cannot be inverted.
        caution: factor of the damping. A rational distortion is nearly undetermined in some directions, in which even
            the loop's first damping, small as it is, holds back for tens of steps; near the minimum none is needed.
        by_secant: near the minimum, what the normal matrix lacks of the second derivative is learnt from the steps. In
            directions that are nearly undetermined it lacks half or more, and steps overshoot for tens of times.
    """

    def __init__(
        self, observations: Observations, estimate: Estimate, columns: np.ndarray, *, free_shape: bool = False,
        loss: Loss = "trivial", loss_scale: float = 1.0, keep_invertible: bool = True, caution: float = 1.0,
        by_secant: bool = False,
    ) -> None:  # fmt: skip
        self.observations, self._camera, self._shape = observations, estimate.camera, estimate.shape
        self._columns = np.asarray(columns, np.int64)
        basis = estimate.shape.basis
        self._basis = basis if free_shape else np.ascontiguousarray(basis[:, :, :0])
        self._loss = loss_id(loss), float(loss_scale)
        self._lost = 0.5 * float(evaluate_loss(loss, np.array(_LOST_PX**2), loss_scale)[0])
        self._keep_invertible, self._caution = keep_invertible, caution
        self._board = np.array(estimate.shape.points3D)
        views, shared = len(observations), len(self._columns) + self._basis.shape[2]
        self._now = self._place(
            estimate.camera.params, estimate.shape.coefficients, estimate.rotations, estimate.translations
        )
        self._trial = self._place(np.zeros(0), np.zeros(0), np.empty((views, 3, 3)), np.empty((views, 3)))
        self._evaluate(self._now)
        self._L, self._Y = np.zeros((views, 6, 6)), np.empty((views, 6, shared + 1))
        self._S, self._F = np.empty((shared + 1, shared + 1)), np.zeros((shared + 1, shared + 1))
        self._by_pose, self._by_shared = np.empty((views, 6)), np.empty(shared)
        # What is lacking of the second derivative, nothing, and the last step with the reduced gradient before it.
        self._bend, self._straight = np.zeros((shared, shared)), np.zeros((shared, shared))
        self._last = np.zeros(shared), np.zeros(shared)
        self._by_secant, self._bends, self._learns = by_secant, False, False
        self._diagonal, self._shared_diagonal, self._slope = np.empty((views, 6)), np.empty(shared), math.nan

    @property
    def shared_count(self) -> int:
        """Number of free parameters that views share."""
        return len(self._by_shared)

    @property
    def estimate(self) -> Estimate:
        """At the current parameters."""
        now = self._now
        camera = dataclasses.replace(self._camera, params=now.params.copy(), has_prior_focal_length=True)
        shape = dataclasses.replace(self._shape, coefficients=now.coefficients.copy())
        return Estimate(camera, now.rotations.copy(), now.translations.copy(), shape)

    @property
    def rotations(self) -> FloatArray:
        """(V, 3, 3) of the current poses."""
        return self._now.rotations

    @property
    def view_costs(self) -> Vector:
        """(V,) half the sum of ρ of each view's residuals."""
        return self._now.costs

    @property
    def blocks(self) -> FloatArray:
        """(V, M, M) see `_refine_kernels`."""
        return self._now.blocks

    def residuals(self) -> FloatArray:
        """(n, 2) projected − observed in px; NaN where there is no projection."""
        out = np.empty((len(self.observations.rows), 2))
        self._evaluate(self._now, out)
        return out

    def linearize(self) -> tuple[float, float]:
        """Cost and largest entry of the gradient at the current parameters."""
        largest = kernels.scale_views(
            self._now.blocks, _FLOOR, self._caution, self._diagonal, self._shared_diagonal
        )  # fmt: skip
        return self._now.cost, largest

    def try_step(self, damping: float) -> Trial | None:
        """Solves the damped normal equations, moves by the solution and evaluates there."""
        now, trial, free = self._now, self._trial, len(self._columns)
        square, slope, damped = self._solve(damping)
        if not math.isfinite(square):
            return None
        moved = kernels.move_poses(
            now.rotations, now.translations, self._by_pose, trial.rotations, trial.translations
        )  # fmt: skip
        trial.params, trial.coefficients = now.params.copy(), now.coefficients.copy()
        trial.params[self._columns] += self._by_shared[:free]
        if self._basis.shape[2]:
            trial.coefficients += self._by_shared[free:]
        self._evaluate(trial)
        norm = math.sqrt(moved + float(now.params @ now.params))
        return Trial(trial.cost, 0.5 * (damping * damped - slope), math.sqrt(square), norm)

    def _solve(self, damping: float) -> tuple[float, float, float]:
        """Squared length of the step, its slope and its damped square; NaN where there is none."""
        now = self._now
        if not kernels.eliminate_views(now.blocks, self._diagonal, damping, self._L, self._Y, self._S):
            return _NO_STEP
        if self._learns:
            self._learns = False
            kernels.bend_by_secant(self._S, *self._last, self._bend)
        for bend in (self._bend, self._straight) if self._bends else (self._straight,):
            found = kernels.step_views(
                now.blocks, self._diagonal, self._shared_diagonal, damping, self._L, self._Y, self._S, bend, self._F,
                self._by_pose, self._by_shared,
            )  # fmt: skip
            if math.isfinite(found[0]):
                return found
        return _NO_STEP

    def shared_inverse(self, ridge: float = 0.0) -> FloatArray | None:
        """S⁻¹ (K, K) at the current parameters, None where they are not determined; with so much damping, if wanted."""
        if not self._solve_undamped(ridge):
            return None
        root = np.linalg.inv(self._F[:-1, :-1])
        return root.T @ root

    def newton_decrement(self) -> float:
        """What one more step, all but undamped, promises to take off the cost; inf where there is no such step."""
        if not (self._solve_undamped(0.0) or self._solve_undamped(RIDGE)):
            return math.inf
        return -0.5 * self._slope

    def _solve_undamped(self, ridge: float) -> bool:
        self.linearize()
        self._bends = self._learns = False
        self._slope = self._solve(ridge / self._caution)[1]
        return math.isfinite(self._slope)

    def is_at_minimum(self, cost: float) -> bool:
        """Whether one more undamped step promises less than a billionth of the cost."""
        return self.newton_decrement() <= _CONVERGED * cost + _EXACT * len(self.observations.rows)

    def accept(self) -> None:
        """Makes the last trial current."""
        self._now, self._trial = self._trial, self._now
        if not self._by_secant:
            return
        self._learns = self._bends = self._trial.cost - self._now.cost <= _LOCAL * self._trial.cost
        if self._bends:
            self._last[0][:], self._last[1][:] = self._by_shared, self._S[-1, :-1]
        else:
            self._bend[:] = 0.0

    def _place(self, params: FloatArray, coefficients: FloatArray, R: FloatArray, t: FloatArray) -> _Point:
        views, width = len(self.observations), 7 + len(self._columns) + self._basis.shape[2]
        arrays = (np.array(params), np.array(coefficients), np.array(R), np.array(t))
        return _Point(*arrays, np.empty(views), np.empty((views, width, width)))

    def _evaluate(self, point: _Point, residuals: FloatArray = _NO_RESIDUALS) -> None:
        o, model = self.observations, self._camera.model_info.model_id
        limit = distortion_limit(model, point.params) ** 2 if self._keep_invertible else -math.inf
        board = self._board
        if self._basis.shape[2]:
            board = self._shape.given + self._shape.basis @ point.coefficients
        point.cost = kernels.evaluate_views(
            model, point.params, self._columns, limit, point.rotations, point.translations, o.offsets, o.rows,
            board, self._basis, o.points2D, o.roots, *self._loss, self._lost, point.costs, point.blocks, residuals,
        )  # fmt: skip
