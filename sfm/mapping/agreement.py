"""Whether matches agree with the poses of a model."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import Mask, Points2D
from sfm.core.cameras import Camera
from sfm.core.geometry.epipolar import essential_from_pose
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import ViewGraph
from sfm.mapping.state import State


def matches_on_epipolar_lines(
    cam2_from_cam1: Rigid3,
    camera1: Camera,
    camera2: Camera,
    points2D_1: Points2D,
    points2D_2: Points2D,
    max_error_px: float,
) -> Mask:
    """Which matches (M,) are within `max_error_px` of each other's epipolar lines, to first order (Sampson).

    Any camera model: a pixel is taken to span the same angle everywhere in the image.
    """
    rays1, rays2 = camera1.unproject(points2D_1)[0], camera2.unproject(points2D_2)[0]
    pixel1, pixel2 = 1 / camera1.mean_focal_length, 1 / camera2.mean_focal_length
    essential = essential_from_pose(cam2_from_cam1)
    line_in_2, line_in_1 = rays1 @ essential.T, rays2 @ essential
    gradient = np.hypot(
        pixel2 * np.linalg.norm(line_in_2[:, :2], axis=1), pixel1 * np.linalg.norm(line_in_1[:, :2], axis=1)
    )
    return np.abs(np.einsum("ni,ni->n", rays2, line_in_2)) <= max_error_px * gradient


def agreement_of_unused_matches(
    state: State, view_graph: ViewGraph, first: Mask, second: Mask, max_error_px: float
) -> tuple[int, int]:
    """How many matches between registered images of two groups agree with their poses, and how many there are.

    Matches of which both keypoints belong to points are left out, as the poses were made to agree with these.

    Args:
        first, second: (I,) which images are in which group.
    """
    scene = state.scene
    group = np.where(state.registered, first.astype(np.int64) - second, 0)
    agreeing, total = 0, 0
    for pair, geometry in view_graph.pairs.items():
        rows = np.searchsorted(scene.image_ids, pair).tolist()
        if group[rows[0]] * group[rows[1]] >= 0:
            continue
        used = [state.has_observed(row)[geometry.matches[:, k]] for k, row in enumerate(rows)]
        matches = geometry.matches[~(used[0] & used[1])]
        pose1, pose2 = (Rigid3(Rotation3.from_matrix(state.R[row]), state.t[row]) for row in rows)
        camera1, camera2 = (state.camera(int(scene.image_camera[row])) for row in rows)
        points2D_1, points2D_2 = (scene.keypoints[i][matches[:, k]] for k, i in enumerate(pair))
        agrees = matches_on_epipolar_lines(
            pose2 @ pose1.inverse(), camera1, camera2, points2D_1, points2D_2, max_error_px
        )
        agreeing, total = agreeing + int(agrees.sum()), total + len(agrees)
    return agreeing, total
