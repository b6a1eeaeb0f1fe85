"""The seven motions of the whole scene that no observation sees, and how they are held.

A covariance needs them held, and so does a user who compares models. An adjustment is faster without: its steps are
free, and a similarity puts the scene back in the end (`put_back`).

Rotating, moving and scaling the world together with all cameras changes no residual. Holding the pose of one frame
takes six of the seven freedoms. Scaling about that frame's centre then moves a second one along their baseline:
holding the coordinate of its centre in which this baseline is longest takes the last. Where a sensor sits on its rig at
a known distance, the scale is seen and nothing of a second frame is held.

Three points do as well: one stays where it is, a second, too (on its ray from the first, where the scale is seen),
and a third in the plane of the three.

Priors see some of the motions, and then
less is held: see `prior_gauge`.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from sfm.bundle.layout import Layout
from sfm.bundle.prior_gauge import entries_to_hold
from sfm.bundle.problem import BundleProblem
from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.similarity import Sim3


class HeldPoints(NamedTuple):
    """Three points, and orthonormal bases (3, k) of the directions that are left to each."""

    points: tuple[int, int, int]
    bases: tuple[FloatArray, FloatArray, FloatArray]


def held_by_three_points(problem: BundleProblem, layout: Layout) -> HeldPoints | None:
    """Three points far apart and seen often; None where anything is constant or known, or all are on a line."""
    chosen, seen = _anchor_and_second(problem, layout), np.diff(layout.offsets)
    if chosen is None or layout.frame_slot[chosen[0]] < 0 or problem.priors:
        return None
    if not problem.free_points[seen > 0].all():
        return None
    often = np.flatnonzero(2 * seen >= seen.max(initial=0))
    places = problem.points3D[often]
    first = int(np.argmax(seen[often]))
    arms = places - places[first]
    second = int(np.argmax(np.linalg.norm(arms, axis=1)))
    along = arms[second] / max(float(np.linalg.norm(arms[second])), 1e-300)
    across = arms - np.outer(arms @ along, along)
    third = int(np.argmax(np.linalg.norm(across, axis=1)))
    distance = float(np.linalg.norm(across[third]))
    if not distance > 1e-6 * np.linalg.norm(arms[second]):
        return None
    none, ray = np.zeros((3, 0)), along[:, None] if _scale_is_seen(problem, layout) else np.zeros((3, 0))
    plane = np.stack([along, across[third] / distance], axis=1)
    return HeldPoints((int(often[first]), int(often[second]), int(often[third])), (none, ray, plane))


def put_back_by_points(before: BundleProblem, after: BundleProblem, layout: Layout) -> BundleProblem:
    """`after`, moved as a whole so that it agrees with `before` in what `held_by_three_points` holds."""
    held = held_by_three_points(before, layout)
    if held is None:
        return put_back(before, after, layout)
    old, new = before.points3D[list(held.points)], after.points3D[list(held.points)]
    axes = _axes(old) @ _axes(new).T
    scale = 1.0
    if not held.bases[1].shape[1]:
        scale = float(np.linalg.norm(old[1] - old[0]) / np.linalg.norm(new[1] - new[0]))
    if not np.isfinite(axes).all() or not 0 < scale < np.inf:
        return after
    turn = Rotation3.from_matrix(axes)
    return _transformed(after, layout, Sim3(np.array(scale), turn, old[0] - scale * (turn @ new[0])))


def _axes(corners: FloatArray) -> FloatArray:
    """(3, 3) columns: along the first side of a triangle, in its plane, and normal to it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
        normal = np.cross(along, corners[2] - corners[0])
        normal = normal / np.linalg.norm(normal)
    return np.stack([along, np.cross(normal, along), normal], axis=1)


def held_by_two_cameras(problem: BundleProblem, layout: Layout) -> BoolArray:
    """(S, 6) tangent entries of the moving poses to hold; none where the constant parts fix the gauge already."""
    held = np.zeros((len(layout.slot_frame), 6), bool)
    chosen = _anchor_and_second(problem, layout)
    if chosen is None:
        return held
    anchor, second = chosen
    centers = frame_centers(problem)
    entries = _entries(problem, centers[anchor], centers[second] if second is not None else None)
    if layout.frame_slot[anchor] >= 0:
        held[layout.frame_slot[anchor]] = entries[0]
    if second is not None:
        held[layout.frame_slot[second]] = entries[1]
    return held


def _anchor_and_second(problem: BundleProblem, layout: Layout) -> tuple[int, int | None] | None:
    """The frame that holds the pose of the scene, and one that holds its size; None where constant parts do."""
    frame = layout.image_frame[layout.image]
    seen = np.bincount(frame, minlength=len(layout.frame_slot))
    constant = np.flatnonzero((layout.frame_slot < 0) & (seen > 0))
    constant_points = int(np.sum(_seen(layout) & ~problem.free_points))
    if not len(layout.slot_frame) or len(constant) >= 2 or constant_points >= 3:
        return None
    anchor = int(constant[0]) if len(constant) else int(np.argmax(seen))
    return anchor, None if _scale_is_seen(problem, layout) else _second_frame(problem, layout, frame, anchor)


def _entries(problem: BundleProblem, anchor: FloatArray, second: FloatArray | None) -> tuple[BoolArray, BoolArray]:
    """Entries of the tangents of two frames, at these centres, to hold."""
    if problem.priors:
        centers = problem.cams_from_world.center
        centers = np.where(np.isfinite(centers), centers, anchor)
        return entries_to_hold(problem.priors, centers, problem.points3D, anchor, second)
    of_second = np.zeros(6, bool)
    if second is not None:
        of_second[3 + int(np.argmax(np.abs(second - anchor)))] = True
    return np.ones(6, bool), of_second


def put_back(before: BundleProblem, after: BundleProblem, layout: Layout) -> BundleProblem:
    """`after`, moved as a whole so that it agrees with `before` in what `held_by_two_cameras` holds.

    Left as it is where something else holds it: constant points, more than one constant pose, priors.
    """
    chosen = _anchor_and_second(before, layout)
    if before.priors or chosen is None or not before.free_points[_seen(layout)].all():
        return after
    anchor, second = chosen
    old, new = _frames(before), _frames(after)
    were, are = old.center, new.center
    turn, scale = old.rotation[anchor].inverse() @ new.rotation[anchor], 1.0
    if second is not None:
        baseline, here = were[second] - were[anchor], turn @ (are[second] - are[anchor])
        axis = int(np.argmax(np.abs(baseline)))
        # The coordinate that is held, unless the second camera has gone far astray.
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = float(baseline[axis] / here[axis])
            if not 0.1 < scale < 10:
                scale = float(np.linalg.norm(baseline) / np.linalg.norm(here))
    if not 0 < scale < np.inf:
        return after
    shift = were[anchor] - scale * (turn @ are[anchor])
    return _transformed(after, layout, Sim3(np.array(scale), turn, shift), (anchor, old[anchor]))


def _transformed(
    problem: BundleProblem, layout: Layout, motion: Sim3, exact: tuple[int, Rigid3] | None = None
) -> BundleProblem:
    """The observed parts of the problem, moved; one frame gets a pose to the last bit."""
    frames, moving = _frames(problem), layout.slot_frame
    turns, translations = frames.rotation.wxyz.copy(), frames.translation.copy()
    turned = frames.rotation[moving] @ motion.rotation.inverse()
    turns[moving] = turned.wxyz
    translations[moving] = -(turned @ (motion @ frames.center[moving]))
    if exact is not None:
        turns[exact[0]], translations[exact[0]] = exact[1].rotation.wxyz, exact[1].translation
    frames, points3D = Rigid3(Rotation3(turns), translations), problem.points3D.copy()
    seen = _seen(layout)
    points3D[seen] = motion @ points3D[seen]
    if problem.rigs is None:
        return dataclasses.replace(problem, cams_from_world=frames, points3D=points3D)
    sensors = problem.rigs.sensors_from_rig
    lengths = np.where(problem.rigs.free_sensors, float(motion.scale), 1.0)
    sensors = Rigid3(sensors.rotation, lengths[:, None] * sensors.translation)
    rigs = dataclasses.replace(problem.rigs, rigs_from_world=frames, sensors_from_rig=sensors)
    return dataclasses.replace(problem, cams_from_world=rigs.cams_from_world, points3D=points3D, rigs=rigs)


def _seen(layout: Layout) -> BoolArray:
    """(P,) which points have an observation."""
    return np.diff(layout.offsets) > 0


def _frames(problem: BundleProblem) -> Rigid3:
    return problem.cams_from_world if problem.rigs is None else problem.rigs.rigs_from_world


def frame_centers(problem: BundleProblem) -> FloatArray:
    """(F, 3) the centres of the frames in the world."""
    return _frames(problem).center


def _scale_is_seen(problem: BundleProblem, layout: Layout) -> bool:
    """Whether an observing sensor has a fixed place on its rig away from the rig's centre."""
    if problem.rigs is None:
        return False
    sensors = problem.rigs.image_sensors[layout.image]
    fixed = np.unique(sensors[sensors >= 0])
    fixed = fixed[~problem.rigs.free_sensors[fixed]]
    return bool(np.any(np.linalg.norm(problem.rigs.sensors_from_rig.center[fixed], axis=1) > 0))


def _second_frame(problem: BundleProblem, layout: Layout, frame: np.ndarray, anchor: int) -> int | None:
    """The moving frame farthest from `anchor` among those that share many points with it."""
    with_anchor, point = np.zeros(len(problem.points3D), bool), layout.point
    with_anchor[point[frame == anchor]] = True
    shared = np.bincount(frame[with_anchor[point]], minlength=len(layout.frame_slot))
    shared[anchor] = 0
    shared[layout.frame_slot < 0] = 0
    if not shared.any():
        return None
    centers = frame_centers(problem)
    baselines = centers - centers[anchor]
    lengths = np.where(2 * shared >= shared.max(), np.linalg.norm(baselines, axis=1), -1.0)
    chosen = int(np.argmax(lengths))
    return chosen if lengths[chosen] > 0 else None
