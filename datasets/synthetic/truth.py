"""What is true of a scene: points with tracks, flow between views, disparity of rectified pairs.

All of it comes from the same rays as the pictures, in double precision; nothing is measured in images.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float64

from datasets.synthetic.render import Renderer, Rendering, pixel_centers
from datasets.synthetic.sensor import gamma
from datasets.synthetic.world import Scene, View
from sfm.core.arrays import Mask, Points2D, Points3D
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Reconstruction, Tracks

_FACING = 0.05
"""Cosine of incidence below which a point does not count as seen."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """Motion of the surface from one view to another.

    Attributes:
        flow: px; where the surface at the centre of a pixel of view 1 lies in view 2, minus that centre. NaN where
            there is no surface or view 2 has no pixel for it; it may point outside the image.
        visible: it is inside the image of view 2 and nothing stands before it.
    """

    flow: Float64[np.ndarray, "H W 2"]
    visible: Bool[np.ndarray, "H W"]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RectifiedPair:
    """Two views side by side.

    Attributes:
        left, right: what the cameras see; the right one stands at +x of the left one.
        disparity: px, x_left − x_right = f b / z of the pixels of the left view; NaN where there is no surface.
        visible: the point is seen in the right view, too.
    """

    left: Rendering
    right: Rendering
    disparity: Float64[np.ndarray, "H W"]
    visible: Bool[np.ndarray, "H W"]


def sightings(renderer: Renderer, view: View, points3D: Points3D, normals: Points3D) -> tuple[Points2D, Mask]:
    """Pixels at which a view has surface points, and whether it sees them: inside, facing and not hidden.

    Args:
        normals: unit normals of the surface at the points, in the world.
    """
    camera, center = view.camera, view.cam_from_world.center
    points2D, valid = camera.project(view.cam_from_world @ points3D)
    inside = np.zeros(len(points3D), bool)
    inside[valid] = np.all((points2D[valid] >= 0) & (points2D[valid] <= (camera.width, camera.height)), axis=1)
    toward = center - points3D
    facing = np.einsum("ij,ij->i", toward, normals) > _FACING * np.linalg.norm(toward, axis=-1)
    candidates = np.flatnonzero(inside & facing)
    seen = np.zeros(len(points3D), bool)
    seen[candidates] = renderer.visible(points3D[candidates], center)
    return points2D, seen


def flow(renderer: Renderer, view1: View, view2: View) -> Flow:
    """Optical flow from view 1 to view 2 and where it can be seen."""
    shape = (view1.camera.height, view1.camera.width)
    pixels = pixel_centers(view1.camera)
    points3D, normals = renderer.surface_points(view1.camera, view1.cam_from_world, pixels)
    points2D, seen = np.full(pixels.shape, np.nan), np.zeros(len(pixels), bool)
    hit = np.isfinite(points3D[:, 0])
    points2D[hit], seen[hit] = sightings(renderer, view2, points3D[hit], normals[hit])
    return Flow((points2D - pixels).reshape(*shape, 2), seen.reshape(shape))


def rectified_pair(renderer: Renderer, camera: Camera, left_from_world: Rigid3, baseline: float) -> RectifiedPair:
    """Two pictures of a rectified pair and the true disparity between them.

    Args:
        camera: of both views.
        baseline: metres.
    Raises:
        ValueError: the camera has distortion, so that the rows of the two images do not correspond; or the baseline
            is not positive.
    """
    if camera.model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise ValueError(f"a rectified pair needs a pinhole camera, got {camera.model}")
    if baseline <= 0:
        raise ValueError(f"the baseline must be positive, got {baseline}")
    right_from_world = Rigid3(Rotation3.identity(), np.array([-baseline, 0.0, 0.0])) @ left_from_world
    left, right = View("left", 1, camera, left_from_world), View("right", 1, camera, right_from_world)
    pictures = renderer.view(left), renderer.view(right)
    return RectifiedPair(
        *pictures,
        disparity=camera.focal_lengths[0] * baseline / pictures[0].depth,
        visible=flow(renderer, left, right).visible,
    )


def reconstruction(
    scene: Scene, renderer: Renderer, *, points_per_image: int = 400, suffix: str = "", seed: int = 0
) -> Reconstruction:
    """The model that a perfect reconstruction of the scene would find.

    Random pixels of each view give points; each is tracked through all views that see it, and kept if two do. The
    observations are the exact projections.

    Args:
        suffix: appended to the names of the views, as those of the image files.
    """
    points3D, normals, colors = _surface_samples(scene, renderer, points_per_image, seed)
    seen = np.zeros((len(scene.views), len(points3D)), bool)
    pixels = np.empty((len(scene.views), len(points3D), 2))
    for row, view in enumerate(scene.views):
        pixels[row], seen[row] = sightings(renderer, view, points3D, normals)
    kept = seen.sum(0) >= 2
    seen, pixels = seen[:, kept], pixels[:, kept]
    feature_ids = np.cumsum(seen, axis=1) - 1
    point_rows, image_rows = np.nonzero(seen.T)
    counts = seen.sum(1)
    image_ids = np.arange(1, len(scene.views) + 1, dtype=np.int32)
    return Reconstruction(
        cameras=scene.cameras,
        image_ids=image_ids,
        image_names=tuple(view.name + suffix for view in scene.views),
        image_camera_ids=np.array([view.camera_id for view in scene.views], np.int32),
        cams_from_world=scene.cams_from_world,
        keypoint_offsets=np.concatenate([[0], np.cumsum(counts)]),
        keypoints=pixels[seen],
        points3D=points3D[kept],
        point_ids=np.arange(1, kept.sum() + 1),
        colors=colors[kept],
        errors=np.zeros(kept.sum()),
        tracks=Tracks(
            np.concatenate([[0], np.cumsum(seen.sum(0))]),
            image_ids[image_rows],
            feature_ids[image_rows, point_rows].astype(np.int32),
        ),
        rigs=scene.rigs,
        frames=scene.frames,
    )


def _surface_samples(
    scene: Scene, renderer: Renderer, points_per_image: int, seed: int
) -> tuple[Points3D, Points3D, np.ndarray]:
    """Points, normals and 8-bit colours of random pixels of all views."""
    points, normals, colours = [], [], []
    for row, view in enumerate(scene.views):
        rng = np.random.default_rng([seed, row, 11])
        pixels = rng.uniform((0, 0), (view.camera.width, view.camera.height), (points_per_image, 2))
        found, facing, radiance = renderer.samples(view.camera, view.cam_from_world, pixels)
        hit = np.isfinite(found[:, 0])
        points.append(found[hit])
        normals.append(facing[hit])
        colours.append(np.rint(255 * gamma(np.clip(radiance[hit], 0, 1))).astype(np.uint8))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(colours)
