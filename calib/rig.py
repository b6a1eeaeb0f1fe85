"""Calibration of cameras that are mounted together: from corners in frames to cameras, their poses, and doubts.

    each camera alone (`rig_alone`)  →  relative poses by pairs, along a spanning tree (`rig_poses`)  →  all together
    (`rig_system`)  →  reject (`rig_reject`)  →  verdict

Not every camera need see the board in every frame, nor any two of them ever, as long as others connect them.
The rig's frame is that of the first camera.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from calib.board_turns import BoardTurn, turn_of
from calib.refine_copies import SeenBefore
from calib.refine_views import RejectedView
from calib.rig_alone import AloneCamera, camera_alone, shape_of
from calib.rig_estimate import RigEstimate
from calib.rig_poses import CameraFrames, FirstPoses, first_poses
from calib.rig_reject import RigFit, reject_from_rig
from calib.rig_result import RigCalibration, RigConfig
from calib.rig_system import RigSystem
from calib.rig_turns import read_frames_alike, turned_frames
from calib.rig_views import RigCamera, RigObservations
from sfm.core.arrays import Points3D
from sfm.core.errors import Rejected
from sfm.core.graphs.union_find import connected_components
from sfm.core.optim.levenberg_marquardt import Summary

__all__ = ["RigCalibration", "RigConfig", "calibrate_rig"]

_MISFIT = 1.5
"""Noise of the rig over that of its cameras alone that is worth a word."""
_CONVERGED, _EXACT = 1e-9, 1e-20
"""Part of the cost, and px² a corner, that need not be gained."""


def calibrate_rig(
    board: Points3D, cameras: Sequence[RigCamera], config: RigConfig = RigConfig(), *, turns: Sequence[BoardTurn] = ()
) -> RigCalibration | Rejected:
    """The cameras that took photos of a board together.

    Args:
        board: (P, 3) its points in metres, or in any other unit; z = 0.
        cameras: with their views; the first is the reference.
        turns: of the board that nothing printed on it tells apart; see `board_turns`.
    Returns:
        `camera_without_board`, `too_few_views`, `undetermined_focal` … of a camera by itself, with its name;
        `same_photos` where two cameras have the same corners; `cameras_not_connected` with the groups that are.
    Raises:
        ValueError: fewer than two cameras, two of one name, or what `calibrate` refuses.
    """
    names = tuple(one.name for one in cameras)
    if len(names) < 2 or len(set(names)) < len(names):
        raise ValueError(f"expected two or more cameras of different names, got {', '.join(names)}")
    copied = _same_photos(cameras, turns)
    if copied is not None:
        return copied
    alone = []
    for one in cameras:
        by_itself = dataclasses.replace(config.alone(one.lens), turns=tuple(turns))
        found = camera_alone(board, one, by_itself, config.refine_known)
        if isinstance(found, Rejected):
            return found
        alone.append(found)
    turns = tuple(turns) or tuple(turn for turn in [turn_of(board, 0)] if turn is not None)
    frames = tuple(sorted({frame for one in alone for frame in one.frames}))
    first = _first(board, alone, frames, turns, config.min_frames)
    if isinstance(first, Rejected):
        return first
    fit = _fit(config, alone)
    observations, estimate = _gathered(board, alone, frames, first, turns, config)
    if not config.refine_intrinsics and config.shape == "flat":
        observations, estimate = _shared_frames(observations, estimate)
    observations, estimate = read_frames_alike(fit, observations, estimate, turns)
    system, summary = fit.solve(observations, estimate)
    views: list[list[RejectedView]] = [list(one.rejected) for one in alone]
    corners: list[list[tuple[str, int]]] = [
        list(one.calibration.rejected_corners) if one.calibration else [] for one in alone
    ]
    if config.reject:
        rejected = reject_from_rig(fit, system, summary, views, corners, estimate)
        if isinstance(rejected, Rejected):
            return rejected
        system, summary = rejected
    apart = _unconnected(names, system.observations, config.min_frames, views)
    if apart is not None:
        return apart
    return _result(cameras, alone, fit, system, summary, first, views, corners)


def _fit(config: RigConfig, alone: Sequence[AloneCamera]) -> RigFit:
    held = np.zeros(0, np.int64)
    return RigFit(
        config.keep_invertible, config.max_iterations, config.relative_cost_tolerance, config.reject_beyond_sigma,
        config.keep_within_sigma, config.min_corners, _typical_sigma(alone),
        tuple(one.columns if config.refine_intrinsics or one.calibration is None else held for one in alone),
    )  # fmt: skip


def _typical_sigma(alone: Sequence[AloneCamera]) -> float:
    """Of the corners of cameras alone, in whose units residuals are whitened."""
    return float(np.median([one.sigma_px for one in alone]))


def _same_photos(cameras: Sequence[RigCamera], turns: Sequence[BoardTurn]) -> Rejected | None:
    """Nothing looks alike to within a fraction of a pixel from two places."""
    for i, one in enumerate(cameras):
        seen = SeenBefore(turns)
        for view in one.views:
            seen.add(view)
        for other in cameras[i + 1 :]:
            for view in other.views:
                if same := seen.same(view):
                    detail = f"{same[0].name} and {view.name} have the same corners, to {same[1]:.2f} px"
                    return Rejected("same_photos", f"{one.name} and {other.name}: {detail}")
    return None


def _first(
    board: Points3D, alone: Sequence[AloneCamera], frames: tuple[str, ...], turns: Sequence[BoardTurn], min_frames: int
) -> FirstPoses | Rejected:
    seen = []
    for one in alone:
        at = _positions(frames, one.frames)
        order = np.argsort(at)
        corners = np.bincount(at, np.diff(one.observations.offsets), len(frames)).astype(np.int64)
        seen.append(CameraFrames(at[order], one.cams_from_board[order], corners))
    low, high = board.min(0), board.max(0)
    probes = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
    return first_poses(tuple(one.name for one in alone), seen, turns, probes, min_frames)


def _positions(frames: tuple[str, ...], some: tuple[str, ...]) -> np.ndarray:
    """Of some frames among all."""
    at = {frame: f for f, frame in enumerate(frames)}
    return np.array([at[frame] for frame in some], np.int64)


def _gathered(
    board: Points3D, alone: Sequence[AloneCamera], frames: tuple[str, ...], first: FirstPoses,
    turns: Sequence[BoardTurn], config: RigConfig,
) -> tuple[RigObservations, RigEstimate]:  # fmt: skip
    """All views, read from the same side and weighted, with where everything is at first."""
    typical = _typical_sigma(alone)
    cameras, frame_of = [], []
    for c, one in enumerate(alone):
        o = one.observations
        at = _positions(frames, one.frames)
        rows = np.stack([turn.rows for turn in turns])[first.turns[c][at][o.view_of], o.rows]
        weight = typical / one.sigma_px if config.weigh_cameras else 1.0
        cameras.append(dataclasses.replace(o, rows=rows, roots=weight * o.roots, board=board))
        frame_of.append(at)
    poses = first.rigs_from_board
    estimate = RigEstimate(
        tuple(one.camera for one in alone), first.cams_from_rig.rotation.matrix,
        np.array(first.cams_from_rig.translation), poses.rotation.matrix, np.array(poses.translation),
        shape_of(config.alone("opencv5"), board, alone),
    )  # fmt: skip
    return RigObservations(frames, tuple(cameras), tuple(frame_of)), estimate


def _shared_frames(observations: RigObservations, estimate: RigEstimate) -> tuple[RigObservations, RigEstimate]:
    """What only one camera saw says nothing of the rig if cameras and board are held."""
    shared = np.flatnonzero(observations.views_per_frame > 1)
    some, left = observations.of_frames(shared.tolist())
    return some, estimate.of_frames(left)


def _unconnected(
    names: tuple[str, ...], observations: RigObservations, needed: int, rejected: Sequence[Sequence[RejectedView]]
) -> Rejected | None:
    """Rejection may have left a camera without connection."""
    sets = [set(frames.tolist()) for frames in observations.frame_of]
    edges = [(i, j) for i in range(len(sets)) for j in range(i) if len(sets[i] & sets[j]) >= needed]
    groups = connected_components(len(names), np.array(edges, np.int64).reshape(-1, 2))
    if len(groups) == 1:
        return None
    told = " | ".join(", ".join(names[c] for c in group.tolist()) for group in groups)
    lost = sum(view.reason == "disagrees" for one in rejected for view in one)
    return Rejected(
        "cameras_disagree",
        f"{told}: {lost} views do not fit a rigid mount; are frames paired rightly, and taken at one moment?",
    )


def _result(
    given: Sequence[RigCamera], alone: Sequence[AloneCamera], fit: RigFit, system: RigSystem, summary: Summary,
    first: FirstPoses, views: Sequence[Sequence[RejectedView]], corners: Sequence[Sequence[tuple[str, int]]],
) -> RigCalibration:  # fmt: skip
    names = tuple(one.name for one in given)
    observations, residuals, estimate = system.observations, system.residuals(), system.estimate
    unknown = 6 * len(observations.frames) + system.shared_count
    freedom = 2 * observations.corner_count - unknown
    total = sum(float(np.sum(r**2)) for r in residuals)
    sigma = math.sqrt(2 * summary.final_cost / freedom) if freedom > 0 else math.nan
    return RigCalibration(
        names=names,
        cameras=estimate.cameras,
        cams_from_rig=estimate.cams_from_rig,
        rigs_from_board=estimate.rigs_from_board,
        shape=estimate.shape,
        free_names=tuple(
            tuple(camera.model_info.param_names[k] for k in columns)
            for camera, columns in zip(estimate.cameras, fit.columns, strict=True)
        ),
        observations=observations,
        residuals=tuple(residuals),
        alone=tuple(alone),
        turned=tuple(turned_frames(one, observations, c) for c, one in enumerate(given)),
        rejected_views=tuple(tuple(one) for one in views),
        rejected_corners=tuple(tuple(one) for one in corners),
        rms_px=math.sqrt(total / observations.corner_count),
        sigma_px=sigma,
        fallbacks=_fallbacks(names, alone, first, sigma),
        converged=system.newton_decrement() <= _CONVERGED * summary.final_cost + _EXACT * observations.corner_count,
        iterations=len(summary.iterations) - 1,
        cost=summary.final_cost,
    )


def _fallbacks(
    names: tuple[str, ...], alone: Sequence[AloneCamera], first: FirstPoses, sigma_px: float
) -> tuple[str, ...]:
    doubts = [
        f"{names[i]} and {names[j]}: the views do not tell which end of the board is which; the smaller turn between "
        "the cameras was taken"
        for i, j in first.doubtful
    ]
    typical = _typical_sigma(alone)
    if sigma_px > _MISFIT * typical:
        doubts.append(
            f"together corners are off by {sigma_px:.2f} px, alone by {typical:.2f} px: the cameras moved against each "
            "other, or photos of one frame were not taken at one moment"
        )
    return (*doubts, *(words for one in alone for words in one.fallbacks))
