"""The seven motions of the whole scene that no observation sees, and how an adjustment holds them.

Rotating, moving and scaling the world together with all cameras changes no residual. Holding the pose of one image
takes six of the seven freedoms. Scaling about that image's centre then moves a second image along their baseline:
holding the largest entry of υ along the baseline, in the frame of the second, takes the last. It is held in every
step, not as a coordinate; the scale may thus creep within a run, which costs nothing.
"""

from __future__ import annotations

import numpy as np

from sfm.bundle.layout import Layout
from sfm.bundle.problem import BundleProblem


def held_by_two_cameras(problem: BundleProblem, layout: Layout) -> np.ndarray:
    """(S, 6) tangent entries of the moving poses to hold; none where the constant parts fix the gauge already."""
    held = np.zeros((len(layout.slot_image), 6), bool)
    seen = np.bincount(layout.image, minlength=len(layout.pose_slot))
    constant = np.flatnonzero(~problem.free_poses & (seen > 0))
    constant_points = np.unique(layout.point[~problem.free_points[layout.point]])
    if not len(held) or len(constant) >= 2 or len(constant_points) >= 3:
        return held
    anchor = int(constant[0]) if len(constant) else int(np.argmax(seen))
    if not len(constant):
        held[layout.pose_slot[anchor]] = True
    second = _second_image(problem, layout, anchor)
    if second is not None:
        image, axis = second
        held[layout.pose_slot[image], 3 + axis] = True
    return held


def _second_image(problem: BundleProblem, layout: Layout, anchor: int) -> tuple[int, int] | None:
    """The moving image farthest from `anchor` among those that share many points with it, and the axis to hold."""
    poses = problem.cams_from_world
    with_anchor = np.zeros(len(problem.points3D), bool)
    with_anchor[layout.point[layout.image == anchor]] = True
    shared = np.bincount(layout.image[with_anchor[layout.point]], minlength=len(layout.pose_slot))
    shared[anchor] = 0
    shared[layout.pose_slot < 0] = 0
    if not shared.any():
        return None
    baselines = np.einsum("iab,ib->ia", poses.rotation.matrix, poses.center[anchor] - poses.center)
    lengths = np.where(2 * shared >= shared.max(), np.linalg.norm(baselines, axis=1), -1.0)
    image = int(np.argmax(lengths))
    if not lengths[image] > 0:
        return None
    return image, int(np.argmax(np.abs(baselines[image])))
