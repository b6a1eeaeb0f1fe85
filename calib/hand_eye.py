"""Hand–eye calibration: where a camera sits on a robot, and where the board lies, from photos and the robot's poses.

    camera on the hand, board on the table (eye_in_hand):   mount = hand, world = base
    camera on a stand, board in the hand (eye_to_hand):     mount = base, world = hand

    poses of the board (`rig_alone`)  →  closed form (`hand_eye_start`)  →  the robot's own error  →  reprojection error
    (`hand_eye_system`)

A robot is not exactly where it says. All corners of a photo then err together, and photos that fit to a tenth of a
pixel each do not fit one another; how much is estimated. View k alone says where the board is, with covariance
σ² H_k⁻¹; against what the robot says it is off by

    y_k = δ_X + Ad(X) ε_k + Ad(X G_k) δ_Z + noise,      ε_k ~ N(0, diag(σ_r², σ_t²)) in the frame of the hand

a linear model whose variances σ_r (radians) and σ_t (metres) are those of the largest restricted likelihood, which
takes into account that X and Z were fitted. Corners and robot weigh by what they are worth then, in the solution as
well as in its covariance.

Reference:
    Patterson & Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 1971.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float64
from scipy.optimize import minimize as minimize_scalars

from calib.hand_eye_start import closed_form, consistent_turns, motions_agree, same_unit, turned_enough
from calib.hand_eye_system import HandEyeEstimate, HandEyeSystem
from calib.refine_board import board_shape
from calib.refine_fit import CalibrationConfig
from calib.refine_reject import RejectedView
from calib.refine_system import CalibrationSystem, Estimate
from calib.refine_views import BoardView, Observations
from calib.rig_alone import AloneCamera, camera_alone
from calib.rig_poses import BoardTurn, turn_of
from calib.rig_views import RigCamera
from sfm.core.arrays import FloatArray, Points3D, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.optim.levenberg_marquardt import StopRules, Summary, minimize

Setup: TypeAlias = Literal["eye_in_hand", "eye_to_hand"]

_LEAST = np.array([1e-8, 1e-8])
_MOST = np.array([0.3, 1.0])
"""Radians and metres between which the robot's error is sought."""
_OPEN = 0.1
"""Radians of standard deviation beyond which a rotation is not determined."""
_ROUNDS = 3
_FAR = 6.0
"""Standard deviations of a view's deviation from the robot's pose beyond which it is left out."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class HandEyeConfig:
    """How a camera on a robot is calibrated."""

    setup: Setup = "eye_in_hand"
    min_poses: int = 4
    """Three determine all, and leave little to judge the robot by."""
    robot_sigma: tuple[float, float] | None = None
    """The robot's standard deviations, radians and metres on each axis, where they are known; otherwise estimated."""
    reject: bool = True
    """Leave out views that do not fit."""
    min_corners: int = 6
    max_iterations: int = 200


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class HandEyeCalibration(Value):
    """Where the camera and the board are.

    Attributes:
        mount_from_cam: hand_from_cam of a camera on the hand, base_from_cam of one on a stand; metres.
        world_from_board: base_from_board, or hand_from_board.
        covariance: (12, 12) of the tangents of cam_from_mount and of world_from_board.
        names: of the views that were used.
        deviations: (V, 6) of the hand from where the robot says it is, (ω, υ) in its own frame, radians and metres.
        rms_px: of all corners, with the robot's poses as corrected; `strict_rms_px` with them as they were given.
        sigma_px: standard deviation of a coordinate of a corner, from each view alone.
        robot_sigma: of the robot, radians and metres on each axis.
        turned: views that read the board from another side than the others.
        fallbacks: what rests on little, in words.
    """

    setup: Setup
    mount_from_cam: Rigid3
    world_from_board: Rigid3
    covariance: Float64[np.ndarray, "12 12"]
    names: tuple[str, ...]
    deviations: Float64[np.ndarray, "V 6"]
    rms_px: float
    strict_rms_px: float
    sigma_px: float
    robot_sigma: tuple[float, float]
    rejected: tuple[RejectedView, ...]
    turned: tuple[str, ...]
    fallbacks: tuple[str, ...]
    converged: bool
    iterations: int

    @property
    def sigma_rotation(self) -> Vector:
        """(3,) of turns of the camera about its own axes, radians."""
        return np.sqrt(np.diag(self.covariance)[:3])

    @property
    def sigma_position(self) -> Vector:
        """(3,) of the camera's place along the mount's axes, metres: δ = −Rᵀ υ for R = cam_from_mount."""
        R = self.mount_from_cam.rotation.matrix
        return np.sqrt(np.diag(R @ self.covariance[3:6, 3:6] @ R.T))


def calibrate_hand_eye(
    board: Points3D, views: Sequence[BoardView], base_from_hand: Rigid3, camera: Camera,
    config: HandEyeConfig = HandEyeConfig(), *, turns: Sequence[BoardTurn] = (),
) -> HandEyeCalibration | Rejected:  # fmt: skip
    """A camera on a robot's hand, or beside it, by photos of a board.

    Args:
        board: (P, 3) its points in metres, z = 0.
        base_from_hand: batch (V,), the robot's pose of each view.
        camera: calibrated; it is held.
        turns: of the board that nothing printed on it tells apart; see `board_turns`.
    Returns:
        `too_few_poses`, `no_rotation`, `one_axis`, `quaternion_order`, `motions_disagree`, `other_unit`,
        `undetermined`; or what the camera cannot do with the views.
    Raises:
        ValueError: numbers of views and poses differ, or two views have one name.
    """
    if base_from_hand.shape != (len(views),):
        raise ValueError(f"{len(views)} views with poses of shape {base_from_hand.shape}")
    names = tuple(view.name for view in views)
    if len(set(names)) < len(names):
        raise ValueError("two views have one name")
    alone_config = CalibrationConfig(reject=config.reject, min_corners=config.min_corners)
    alone = camera_alone(board, RigCamera("camera", tuple(views), names, "opencv5", camera), alone_config, False)
    if isinstance(alone, Rejected):
        return alone
    mounts = base_from_hand.inverse() if config.setup == "eye_in_hand" else base_from_hand
    at = [names.index(name) for name in alone.observations.names]
    problem = _prepared(board, alone, mounts[at], config, tuple(turns))
    return problem if isinstance(problem, Rejected) else _solved(problem, alone, config)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Problem(Value):
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

    def of_views(self, views: list[int]) -> _Problem:
        return dataclasses.replace(
            self,
            observations=self.observations.of_views(views),
            cams_from_board=self.cams_from_board[views],
            mounts=self.mounts[views],
        )


def _prepared(
    board: Points3D, alone: AloneCamera, mounts: Rigid3, config: HandEyeConfig, turns: tuple[BoardTurn, ...]
) -> _Problem | Rejected:
    if len(mounts) < config.min_poses:
        told = "; ".join(f"{view.name}: {view.reason}" for view in alone.rejected[:5])
        detail = f"{len(mounts)} of {config.min_poses} needed"
        return Rejected("too_few_poses", detail + (f" ({told})" if told else ""))
    short = turned_enough(mounts.rotation)
    if short is not None:
        return short
    turns = turns or tuple(turn for turn in [turn_of(board, 0)] if turn is not None)
    chosen = consistent_turns(mounts, alone.cams_from_board, turns)
    o = alone.observations
    rows = np.stack([turn.rows for turn in turns])[chosen[o.view_of], o.rows]
    back = Rigid3.stack([turns[k].motion.inverse() for k in chosen.tolist()])
    poses = alone.cams_from_board @ back
    other = motions_agree(mounts, poses)
    if other is not None:
        return other
    observations = dataclasses.replace(o, rows=rows, board=board)
    named = tuple(o.names[v] for v in np.flatnonzero(chosen))
    in_hand = config.setup == "eye_in_hand"
    return _Problem(board, alone.camera, observations, poses, mounts, alone.sigma_px, named, in_hand)


def _solved(problem: _Problem, alone: AloneCamera, config: HandEyeConfig) -> HandEyeCalibration | Rejected:
    rejected = list(alone.rejected)
    while True:
        X, Z = closed_form(problem.mounts, problem.cams_from_board)
        other = same_unit(problem.mounts, problem.cams_from_board, X)
        if other is not None:
            return other
        information = _information(problem)
        X, Z, sigma = _balanced(problem, information, X, Z, config.robot_sigma)
        worst, off = _worst_view(problem, information, X, Z, sigma)
        if not (config.reject and off > _FAR and problem.many > config.min_poses):
            break
        detail = f"the robot's pose is off by {off:.0f} standard deviations of the others"
        rejected.append(RejectedView(problem.observations.names[worst], "disagrees", detail))
        problem = problem.of_views([v for v in range(problem.many) if v != worst])
        short = turned_enough(problem.mounts.rotation)
        if short is not None:
            return short
    system, summary = _refined(problem, X, Z, sigma, config)
    unit = system.shared_inverse()
    covariance = None if unit is None else problem.sigma_px**2 * unit
    if covariance is None or math.sqrt(float(np.diag(covariance)[:3].max())) > _OPEN:
        return Rejected("undetermined", "the poses leave the camera's orientation open; turn the robot more")
    return _result(problem, system, summary, covariance, sigma, rejected, config)


def _information(problem: _Problem) -> FloatArray:
    """(V, 6, 6) of the poses that views have by themselves, with unit noise."""
    estimate = Estimate(
        problem.camera,
        problem.cams_from_board.rotation.matrix,
        np.array(problem.cams_from_board.translation),
        board_shape("flat", problem.board),
    )
    blocks = np.tril(CalibrationSystem(problem.observations, estimate, np.zeros(0, np.int64)).blocks[:, :6, :6])
    return blocks + np.tril(blocks, -1).swapaxes(1, 2)


def _balanced(
    problem: _Problem, information: FloatArray, X: Rigid3, Z: Rigid3, known: tuple[float, float] | None
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
    problem: _Problem, information: FloatArray, X: Rigid3, Z: Rigid3
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
    y: FloatArray, J: FloatArray, noise: FloatArray, sigma: Vector
) -> tuple[Vector, FloatArray, FloatArray]:
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


def _worst_view(
    problem: _Problem, information: FloatArray, X: Rigid3, Z: Rigid3, sigma: Vector
) -> tuple[int, float]:  # fmt: skip
    """The view that is farthest off, and by how many standard deviations of the others."""
    y, _, noise = _linear(problem, information, X, Z)
    V = noise + np.diag(np.repeat(sigma**2, 3))
    lengths = np.sqrt(np.einsum("vk,vk->v", y, np.linalg.solve(V, y[:, :, None])[:, :, 0]) / 6)
    return int(np.argmax(lengths)), float(lengths.max() / max(float(np.median(lengths)), 1e-9))


def _system(problem: _Problem, estimate: HandEyeEstimate, robot_information: Vector) -> HandEyeSystem:
    return HandEyeSystem(
        problem.observations, problem.camera, np.array(problem.board), problem.mounts, estimate,
        hand_is_mount=problem.hand_is_mount, robot_information=robot_information,
    )  # fmt: skip


def _refined(
    problem: _Problem, X: Rigid3, Z: Rigid3, sigma: Vector, config: HandEyeConfig
) -> tuple[HandEyeSystem, Summary]:
    weights = problem.sigma_px**2 / np.repeat(sigma**2, 3)
    system = _system(problem, HandEyeEstimate(X, Z, Rigid3.identity((problem.many,))), weights)
    rules = StopRules(
        max_iterations=config.max_iterations, relative_cost_tolerance=1e-12, gradient_tolerance=0.0
    )  # fmt: skip
    return system, minimize(system, rules)


def _result(
    problem: _Problem, system: HandEyeSystem, summary: Summary, covariance: FloatArray, sigma: Vector,
    rejected: list[RejectedView], config: HandEyeConfig,
) -> HandEyeCalibration:  # fmt: skip
    estimate, residuals = system.estimate, system.residuals()
    exact = dataclasses.replace(estimate, errors=Rigid3.identity((problem.many,)))
    strict = _system(problem, exact, np.zeros(6)).residuals()
    cost = summary.final_cost
    few = problem.many < 8
    return HandEyeCalibration(
        setup=config.setup,
        mount_from_cam=estimate.cam_from_mount.inverse(),
        world_from_board=estimate.world_from_board,
        covariance=covariance,
        names=problem.observations.names,
        deviations=estimate.errors.log(),
        rms_px=math.sqrt(float(np.mean(np.sum(residuals**2, axis=1)))),
        strict_rms_px=math.sqrt(float(np.nanmean(np.sum(strict**2, axis=1)))),
        sigma_px=problem.sigma_px,
        robot_sigma=(float(sigma[0]), float(sigma[1])),
        rejected=tuple(rejected),
        turned=tuple(name for name in problem.turned if name in problem.observations.names),
        fallbacks=(f"the robot's error is estimated from {problem.many} poses only",) if few else (),
        converged=system.newton_decrement() <= 1e-9 * cost + 1e-20 * len(residuals),
        iterations=len(summary.iterations) - 1,
    )
