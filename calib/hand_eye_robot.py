"""How far a robot is from where it says, by photos of a board.

View k alone says where the board is, with covariance σ² H_k⁻¹; against what the robot says it is off by

    y_k = δ_X + Ad(X) ε_k + Ad(X G_k) δ_Z + noise,      ε_k ~ N(0, diag(σ_r², σ_t²)) in the frame of the hand

a linear model whose variances σ_r (radians) and σ_t (metres) are those of the largest restricted likelihood, which
takes into account that X and Z were fitted.

Reference:
    Patterson & Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 1971.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.optimize import minimize as minimize_scalars

from calib.refine_board import board_shape
from calib.refine_system import CalibrationSystem, Estimate
from calib.refine_views import Observations
from sfm.core.arrays import FloatArray, Points3D, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3

_LEAST = np.array([1e-8, 1e-8])
_MOST = np.array([0.3, 1.0])
"""Radians and metres between which the robot's error is sought."""
_ROUNDS = 3


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class HandEyeViews(Value):
    """Views read from the same side, with their own poses, and what the robot says."""

    board: Points3D
    camera: Camera
    observations: Observations
    cams_from_board: Rigid3
    mounts: Rigid3
    sigma_px: float
    turned: tuple[str, ...]
    hand_is_mount: bool

    @property
    def many(self) -> int:
        """Number of views."""
        return len(self.mounts)

    def of_views(self, views: list[int]) -> HandEyeViews:
        """Only these."""
        return dataclasses.replace(
            self,
            observations=self.observations.of_views(views),
            cams_from_board=self.cams_from_board[views],
            mounts=self.mounts[views],
        )


def pose_information(problem: HandEyeViews) -> FloatArray:
    """(V, 6, 6) of the poses that views have by themselves, with unit noise."""
    estimate = Estimate(
        problem.camera,
        problem.cams_from_board.rotation.matrix,
        np.array(problem.cams_from_board.translation),
        board_shape("flat", problem.board),
    )
    blocks = np.tril(CalibrationSystem(problem.observations, estimate, np.zeros(0, np.int64)).blocks[:, :6, :6])
    return blocks + np.tril(blocks, -1).swapaxes(1, 2)


def balanced(
    problem: HandEyeViews, information: FloatArray, X: Rigid3, Z: Rigid3, known: tuple[float, float] | None
) -> tuple[Rigid3, Rigid3, Vector]:
    """X and Z by generalised least squares of the views' poses, and the robot's standard deviations (2,)."""
    sigma = np.array(known) if known else np.array([1e-3, 1e-3])
    for _ in range(_ROUNDS):
        y, J, noise = _linear(problem, information, X, Z)
        if known is None:
            found = minimize_scalars(
                lambda s, y=y, J=J, noise=noise: _minus_likelihood(np.exp(s), y, J, noise), np.log(sigma),
                method="Nelder-Mead", bounds=list(zip(np.log(_LEAST), np.log(_MOST), strict=True)),
                options={"xatol": 1e-3, "fatol": 1e-4, "maxiter": 200},
            )  # fmt: skip
            sigma = np.exp(found.x)
        step = _generalised(y, J, noise, sigma)[0]
        X, Z = Rigid3.exp(step[:6]) @ X, Rigid3.exp(step[6:]) @ Z
    return X, Z, sigma


def _linear(
    problem: HandEyeViews, information: FloatArray, X: Rigid3, Z: Rigid3
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Deviations y (V, 6) in the hand's frame, their derivatives J (V, 6, 12), covariance of the views' own noise."""
    many = Rigid3.stack([X] * problem.many)
    to_world = many @ problem.mounts
    predicted = to_world @ Rigid3.stack([Z] * problem.many)
    back = np.linalg.inv((many if problem.hand_is_mount else to_world).adjoint())
    y = np.einsum("vij,vj->vi", back, (problem.cams_from_board @ predicted.inverse()).log())
    J = np.concatenate([back, back @ to_world.adjoint()], axis=2)
    return y, J, problem.sigma_px**2 * back @ np.linalg.inv(information) @ back.swapaxes(1, 2)


def _generalised(
    y: FloatArray, J: FloatArray, noise: FloatArray, sigma: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The solution (12,), its information (12, 12), and the covariances V_k (V, 6, 6)."""
    V = noise + np.diag(np.repeat(sigma**2, 3))
    weighted = np.linalg.solve(V, J)
    information = np.einsum("vki,vkj->ij", J, weighted)
    return np.linalg.solve(information, np.einsum("vki,vk->i", weighted, y)), information, V


def _minus_likelihood(sigma: Vector, y: FloatArray, J: FloatArray, noise: FloatArray) -> float:
    """−2 log of the restricted likelihood, but for a constant."""
    step, information, V = _generalised(y, J, noise, sigma)
    left = y - J @ step
    fit = float(np.einsum("vk,vk->", left, np.linalg.solve(V, left[:, :, None])[:, :, 0]))
    return fit + float(np.linalg.slogdet(V)[1].sum()) + float(np.linalg.slogdet(information)[1])


def worst_view(
    problem: HandEyeViews, information: FloatArray, X: Rigid3, Z: Rigid3, sigma: Vector
) -> tuple[int, float]:  # fmt: skip
    """The view that is farthest off, and by how many standard deviations of the others."""
    y, _, noise = _linear(problem, information, X, Z)
    V = noise + np.diag(np.repeat(sigma**2, 3))
    lengths = np.sqrt(np.einsum("vk,vk->v", y, np.linalg.solve(V, y[:, :, None])[:, :, 0]) / 6)
    return int(np.argmax(lengths)), float(lengths.max() / max(float(np.median(lengths)), 1e-9))
