"""Hand–eye calibration: where a camera sits on a robot, and where the board lies, from photos and the robot's poses.

    camera on the hand, board on the table (eye_in_hand):   mount = hand, world = base
    camera on a stand, board in the hand (eye_to_hand):     mount = base, world = hand

    poses of the board (`rig_alone`)  →  closed form (`hand_eye_start`)  →  the robot's own error  →  reprojection error
    (`hand_eye_system`)

A robot is not exactly where it says. All corners of a photo then err together, and photos that fit to a tenth of a
pixel each do not fit one another; how much is estimated (`hand_eye_robot`). Corners and robot weigh by what they are
worth then, in the solution as well as in its covariance.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float64

from calib.board_turns import BoardTurn, turn_of
from calib.hand_eye_robot import HandEyeViews, balanced, pose_information, worst_view
from calib.hand_eye_start import closed_form, consistent_turns, motions_agree, same_unit, turned_enough
from calib.hand_eye_system import HandEyeEstimate, HandEyeSystem
from calib.refine_fit import CalibrationConfig
from calib.refine_reject import RejectedView
from calib.refine_views import BoardView
from calib.rig_alone import AloneCamera, camera_alone
from calib.rig_views import RigCamera
from sfm.core.arrays import FloatArray, Points3D, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.optim.levenberg_marquardt import StopRules, Summary, minimize

Setup: TypeAlias = Literal["eye_in_hand", "eye_to_hand"]

_OPEN = 0.1
"""Radians of standard deviation beyond which a rotation is not determined."""
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
        `too_few_poses`, `no_rotation`, `one_axis`, `quaternion_order`, `inverse_poses`, `motions_disagree`,
        `other_unit`,
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


def _prepared(
    board: Points3D, alone: AloneCamera, mounts: Rigid3, config: HandEyeConfig, turns: tuple[BoardTurn, ...]
) -> HandEyeViews | Rejected:
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
    in_hand = config.setup == "eye_in_hand"
    other = motions_agree(mounts, poses, hand_is_mount=in_hand)
    if other is not None:
        return other
    observations = dataclasses.replace(o, rows=rows, board=board)
    named = tuple(o.names[v] for v in np.flatnonzero(chosen))
    return HandEyeViews(board, alone.camera, observations, poses, mounts, alone.sigma_px, named, in_hand)


def _solved(problem: HandEyeViews, alone: AloneCamera, config: HandEyeConfig) -> HandEyeCalibration | Rejected:
    rejected = list(alone.rejected)
    while True:
        X, Z = closed_form(problem.mounts, problem.cams_from_board)
        other = same_unit(problem.mounts, problem.cams_from_board, X)
        if other is not None:
            return other
        information = pose_information(problem)
        X, Z, sigma = balanced(problem, information, X, Z, config.robot_sigma)
        worst, off = worst_view(problem, information, X, Z, sigma)
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


def _system(problem: HandEyeViews, estimate: HandEyeEstimate, robot_information: Vector) -> HandEyeSystem:
    return HandEyeSystem(
        problem.observations, problem.camera, np.array(problem.board), problem.mounts, estimate,
        hand_is_mount=problem.hand_is_mount, robot_information=robot_information,
    )  # fmt: skip


def _refined(
    problem: HandEyeViews, X: Rigid3, Z: Rigid3, sigma: Vector, config: HandEyeConfig
) -> tuple[HandEyeSystem, Summary]:
    weights = problem.sigma_px**2 / np.repeat(sigma**2, 3)
    system = _system(problem, HandEyeEstimate(X, Z, Rigid3.identity((problem.many,))), weights)
    rules = StopRules(
        max_iterations=config.max_iterations, relative_cost_tolerance=1e-12, gradient_tolerance=0.0
    )  # fmt: skip
    return system, minimize(system, rules)


def _result(
    problem: HandEyeViews, system: HandEyeSystem, summary: Summary, covariance: FloatArray, sigma: Vector,
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
