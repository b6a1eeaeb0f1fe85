"""The seven motions of the whole scene that no observation sees, and how an adjustment holds them.

Rotating, moving and scaling the world together with all cameras changes no residual. Holding the pose of one frame
takes six of the seven freedoms. Scaling about that frame's centre then moves a second one along their baseline:
holding the coordinate of its centre in which this baseline is longest takes the last. Where a sensor sits on its rig at
a known distance, the scale is seen and nothing of a second frame is held. Priors see some of the motions, and then
less is held: see `prior_gauge`.
"""

from __future__ import annotations

import numpy as np

from sfm.bundle.layout import Layout
from sfm.bundle.prior_gauge import entries_to_hold
from sfm.bundle.problem import BundleProblem
from sfm.core.arrays import BoolArray, FloatArray


def held_by_two_cameras(problem: BundleProblem, layout: Layout) -> BoolArray:
    """(S, 6) tangent entries of the moving poses to hold; none where the constant parts fix the gauge already."""
    held = np.zeros((len(layout.slot_frame), 6), bool)
    frame = layout.image_frame[layout.image]
    seen = np.bincount(frame, minlength=len(layout.frame_slot))
    constant = np.flatnonzero((layout.frame_slot < 0) & (seen > 0))
    constant_points = np.unique(layout.point[~problem.free_points[layout.point]])
    if not len(held) or len(constant) >= 2 or len(constant_points) >= 3:
        return held
    anchor = int(constant[0]) if len(constant) else int(np.argmax(seen))
    second = None if _scale_is_seen(problem, layout) else _second_frame(problem, layout, frame, anchor)
    centers = frame_centers(problem)
    entries = _entries(problem, centers[anchor], centers[second] if second is not None else None)
    if not len(constant):
        held[layout.frame_slot[anchor]] = entries[0]
    if second is not None:
        held[layout.frame_slot[second]] = entries[1]
    return held


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


def frame_centers(problem: BundleProblem) -> FloatArray:
    """(F, 3) the centres of the frames in the world."""
    return (problem.cams_from_world if problem.rigs is None else problem.rigs.rigs_from_world).center


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
    with_anchor = np.zeros(len(problem.points3D), bool)
    with_anchor[layout.point[frame == anchor]] = True
    shared = np.bincount(frame[with_anchor[layout.point]], minlength=len(layout.frame_slot))
    shared[anchor] = 0
    shared[layout.frame_slot < 0] = 0
    if not shared.any():
        return None
    centers = frame_centers(problem)
    baselines = centers - centers[anchor]
    lengths = np.where(2 * shared >= shared.max(), np.linalg.norm(baselines, axis=1), -1.0)
    chosen = int(np.argmax(lengths))
    return chosen if lengths[chosen] > 0 else None
