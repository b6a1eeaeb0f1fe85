"""Which image comes next, and where it was taken."""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.errors import Rejected
from sfm.core.robust import RansacConfig, estimate_absolute_pose
from sfm.mapping import _kernels
from sfm.mapping.state import State

_PYRAMID_LEVELS = 6


@dataclasses.dataclass(frozen=True, slots=True)
class Resection:
    """A registered image: how many of the points that it could see agree with its pose."""

    inliers: int
    visible: int


def next_images(state: State, min_visible: int) -> list[tuple[int, int]]:
    """Unregistered images that could see at least `min_visible` points, as (image, visible), best first.

    Reference:
        Schönberger & Frahm, Structure-from-Motion Revisited, CVPR 2016, section 4.2 (the visibility pyramid).
    """
    scene = state.scene
    images = np.flatnonzero(~state.registered)
    counts, scores = _kernels.visibility_scores(
        images,
        scene.image_offsets,
        scene.image_observations,
        scene.track_of,
        state.has_point,
        scene.xy,
        scene.sizes,
        _PYRAMID_LEVELS,
    )
    order = np.lexsort((images, -scores))
    return [(int(images[k]), int(counts[k])) for k in order if counts[k] >= min_visible]


def resect(
    state: State,
    image: int,
    *,
    max_error_px: float,
    min_inliers: int,
    min_inlier_ratio: float,
    refine_focal: bool,
    rng: np.random.Generator,
) -> Resection | Rejected:
    """Finds the pose of an image from the points that its tracks have, and registers it.

    With `refine_focal` the focal length of its camera is estimated too (for a camera that no image used before).
    """
    scene = state.scene
    rows = scene.observations_of(image)
    rows = rows[state.has_point[scene.track_of[rows]]]
    camera_row = int(scene.image_camera[image])
    camera = state.camera(camera_row)
    found = estimate_absolute_pose(
        scene.xy[rows],
        state.points[scene.track_of[rows]],
        camera,
        RansacConfig(max_error_px=max_error_px, min_inliers=min(min_inliers, RansacConfig.min_inliers)),
        rng=rng,
        refine_focal=refine_focal,
    )
    if isinstance(found, Rejected):
        return found
    inliers = int(found.inliers.sum())
    if inliers < min_inliers:
        return Rejected("too_few_pose_inliers", f"{inliers} of {len(rows)} visible points agree, {min_inliers} needed")
    if inliers < min_inlier_ratio * len(rows):
        return Rejected("low_pose_inlier_ratio", f"{inliers} of {len(rows)} visible points agree")
    if refine_focal:
        state.set_camera(camera_row, found.camera.params)
    state.set_pose(image, found.cam_from_world)
    state.on[rows[found.inliers]] = True
    return Resection(inliers, len(rows))
