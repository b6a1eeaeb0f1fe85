"""From which end each frame reads a board that looks the same after a turn.

Cameras of one frame agree on an end by where they stand (`rig_poses`); from frame to frame the end may be another one,
which matters to boards that are not flat, as with one camera. So frames are compared as views are there
(`refine_turns`): about a rig with what turns leave alone of the shape, by what each frame says of mounts, cameras and
shape with its pose eliminated.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from calib.board_turns import BoardTurn
from calib.refine_board import smooth_shape
from calib.refine_ends import Quadratics, most_likely_turns
from calib.refine_reject import spread_of
from calib.refine_turns import Ends, ends_of, prior_of, read_after
from calib.rig_estimate import RigEstimate
from calib.rig_reject import RigFit
from calib.rig_system import RigSystem
from calib.rig_views import RigCamera, RigObservations
from sfm.core.geometry.rigid import Rigid3


def read_frames_alike(
    fit: RigFit, observations: RigObservations, estimate: RigEstimate, turns: Sequence[BoardTurn]
) -> tuple[RigObservations, RigEstimate]:
    """The frames with corners renamed such that all read the board from the same end, and where all is then.

    They stay as they are where it does not matter to the shape that is to be estimated, or cannot be told.
    """
    shape = estimate.shape
    if len(observations.frames) < 2 or len(turns) < 2 or not shape.basis.shape[2]:
        return observations, estimate
    movable = np.all([observations.shown[turn.rows] >= 2 for turn in turns], axis=0)
    ends = ends_of(smooth_shape(shape.kind, shape.given, movable), turns)
    if ends is None:
        return observations, estimate
    system, _ = fit.solve(observations, dataclasses.replace(estimate, shape=ends.same))
    chosen, now = most_likely_turns(_quadratics(fit, system, ends), ends.composed), system.estimate
    now = dataclasses.replace(now, shape=shape.moved_as(now.shape.displacements))
    if chosen is None or not chosen.any():
        return observations, now
    turn_of = ends.turns[chosen]
    cameras = tuple(
        read_after(camera, turn_of[frames], turns)
        for camera, frames in zip(observations.cameras, observations.frame_of, strict=True)
    )
    back = Rigid3.stack([turn.motion.inverse() for turn in turns])
    poses = now.rigs_from_board @ back[turn_of]
    return dataclasses.replace(observations, cameras=cameras), dataclasses.replace(
        now, frame_rotations=poses.rotation.matrix, frame_translations=np.array(poses.translation)
    )


def _quadratics(fit: RigFit, system: RigSystem, ends: Ends) -> Quadratics:
    """The frames about a solution, by all coefficients of the shape; corners that are far off take little part."""
    now = system.estimate
    sigma = spread_of(np.concatenate(system.whitened_lengths()))
    about = dataclasses.replace(now, shape=dataclasses.replace(ends.all, given=now.shape.points3D))
    A, gradient = fit.system(system.observations, about, "cauchy", 2 * sigma).by_frame()
    A, b = A / sigma**2, -gradient / sigma**2
    return Quadratics(A, b, ends.changes, prior_of(A, A.shape[1] - ends.all.basis.shape[2], ends))


def turned_frames(given: RigCamera, observations: RigObservations, camera: int) -> tuple[str, ...]:
    """Frames of which a camera, by its position in the rig, reads the board from another end than it was given with."""
    of_view, seen, turned = {view.name: view for view in given.views}, observations.cameras[camera], []
    frames = observations.frame_of[camera]
    for v, name in enumerate(seen.names):
        # One corner may be the middle of the board.
        part = slice(seen.offsets[v], min(seen.offsets[v] + 2, seen.offsets[v + 1]))
        view = of_view[name]
        same = [np.flatnonzero(np.all(view.points2D == point, axis=1))[0] for point in seen.points2D[part]]
        if np.any(view.corner_ids[same] != seen.rows[part]):
            turned.append(observations.frames[frames[v]])
    return tuple(turned)
