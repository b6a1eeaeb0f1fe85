"""Bundle adjustment of a part of the model or of all of it."""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.bundle import BundleConfig, BundleProblem, adjust, squared_errors
from sfm.core.events import Observer
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.mapping.noise import learn_sigmas
from sfm.mapping.state import State

_SHORT_TRACK = 15
"""Tracks up to this length are adjusted with a neighbourhood even where they reach beyond it; longer ones are firm."""
_LOSS_SIGMAS = 3.0
"""Residual, in standard deviations, beyond which it is rather an outlier."""


def adjust_globally(
    state: State,
    config: BundleConfig,
    *,
    free_params: np.ndarray,
    threads: int,
    observer: Observer,
    weighted: bool = False,
) -> None:
    """Adjusts all poses and points, and the camera parameters that `free_params` (C, K) marks.

    Args:
        weighted: each residual counts as much as keypoints of its scale have proved precise, see `noise`.
    """
    rows = np.flatnonzero(state.on)
    _adjust(
        state,
        rows,
        free_poses=state.registered.copy(),
        free_points=state.has_point,
        free_params=free_params,
        config=config,
        threads=threads,
        observer=observer,
        scope="global",
        weighted=weighted,
    )


def adjust_locally(
    state: State,
    images: np.ndarray,
    config: BundleConfig,
    *,
    free_params: np.ndarray,
    threads: int,
    observer: Observer,
) -> None:
    """Adjusts a few images, of which the first is new, with what they see.

    All observations of the points of the new image count, those of other images with their poses held. Points that
    mostly others see are held, too.
    """
    scene = state.scene
    inside = np.zeros(len(scene.image_ids), bool)
    inside[images] = True
    lengths = np.bincount(scene.track_of[state.on], minlength=len(state.has_point))
    new = scene.observations_of(int(images[0]))
    of_new_image = np.zeros(len(state.has_point), bool)
    of_new_image[scene.track_of[new[state.on[new]]]] = True
    whole = of_new_image & (lengths <= _SHORT_TRACK)
    rows = np.flatnonzero(state.on & (inside[scene.image] | whole[scene.track_of]))
    counted = np.bincount(scene.track_of[rows], minlength=len(lengths))
    free_poses = inside.copy()
    _adjust(
        state,
        rows,
        free_poses=free_poses,
        free_points=counted == lengths,
        free_params=free_params,
        config=config,
        threads=threads,
        observer=observer,
        scope="local",
    )


def _adjust(
    state: State,
    rows: np.ndarray,
    *,
    free_poses: np.ndarray,
    free_points: np.ndarray,
    free_params: np.ndarray,
    config: BundleConfig,
    threads: int,
    observer: Observer,
    scope: str,
    weighted: bool = False,
) -> None:
    """Gathers the observations `rows` with the images, cameras and points that they touch, and writes the result."""
    scene = state.scene
    images, image_of = _numbered(scene.image[rows], len(scene.image_ids))
    tracks, track_of = _numbered(scene.track_of[rows], len(state.has_point))
    cameras, camera_of = _numbered(scene.image_camera[images], len(state.params))
    problem = BundleProblem(
        model_ids=state.model_ids[cameras],
        camera_params=state.params[cameras],
        image_cameras=camera_of,
        cams_from_world=Rigid3(Rotation3.from_matrix(state.R[images]), state.t[images]),
        points3D=state.points[tracks],
        obs_images=image_of,
        obs_points=track_of,
        obs_points2D=scene.xy[rows],
        free_params=free_params[cameras],
        free_poses=free_poses[images],
        free_points=free_points[tracks],
        prior_params=scene.expected_params[cameras],
        prior_sigmas=scene.param_sigmas[cameras],
    )
    if weighted:
        problem, config = _weighted(problem, config, scene.scale[rows])
    result = adjust(problem, config, threads=threads, observer=observer, scope=scope).problem
    state.R[images], state.t[images] = result.cams_from_world.rotation.matrix, result.cams_from_world.translation
    state.points[tracks] = result.points3D
    moved = np.flatnonzero(np.any(state.params[cameras] != result.camera_params, axis=1))
    state.params[cameras] = result.camera_params
    state.refresh_rays(cameras[moved].tolist())


def _numbered(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The rows that occur, of `count`, ascending, and the number of each among these."""
    numbers = np.zeros(count, np.int32)
    numbers[rows] = 1
    used = np.flatnonzero(numbers)
    numbers[used] = np.arange(len(used), dtype=np.int32)
    return used, numbers[rows]


def _weighted(problem: BundleProblem, config: BundleConfig, scales: np.ndarray) -> tuple[BundleProblem, BundleConfig]:
    """With standard deviations for the observations, 1 in the median: so residuals still are px, as the loss has them.

    The loss turns linear at `_LOSS_SIGMAS` standard deviations, if that is below the configured scale.
    """
    if not len(scales):
        return problem, config
    views = np.bincount(problem.obs_points, minlength=len(problem.points3D))[problem.obs_points]
    sigmas = learn_sigmas(np.sqrt(squared_errors(problem)), scales, views.astype(np.float64))
    typical = float(np.median(sigmas))
    return (
        dataclasses.replace(problem, obs_sigmas=sigmas / typical),
        dataclasses.replace(config, loss_scale_px=min(config.loss_scale_px, _LOSS_SIGMAS * typical)),
    )


def neighbourhood(state: State, image: int, count: int, min_angle: float) -> np.ndarray:
    """The image and up to `count` registered ones that share most of its points, preferring wide angles.

    An image is preferred when the third quartile of the angles between its rays and ours reaches `min_angle`
    (radians), since a narrow one adds no stiffness; narrower ones fill what is left.
    """
    scene = state.scene
    mine = scene.observations_of(image)
    tracks = scene.track_of[mine[state.on[mine]]]
    shared = np.zeros(len(state.has_point), bool)
    shared[tracks] = True
    rows = np.flatnonzero(state.on & shared[scene.track_of] & (scene.image != image))
    others, counts = np.unique(scene.image[rows], return_counts=True)
    order = np.lexsort((others, -counts))[: 4 * count]
    center = -state.R[image].T @ state.t[image]
    wide, narrow = [], []
    for k in order:
        other = int(others[k])
        points = state.points[scene.track_of[rows[scene.image[rows] == other]]]
        a, b = points - center, points + state.R[other].T @ state.t[other]
        angles = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ij,ij->i", a, b))
        (wide if np.quantile(angles, 0.75) >= min_angle else narrow).append(other)
    return np.array([image, *(wide + narrow)[:count]])


@dataclasses.dataclass(frozen=True, slots=True)
class _Bounds:
    """Focal lengths and distortions that a lens can have, as in COLMAP."""

    min_focal_ratio: float = 0.1
    max_focal_ratio: float = 10.0
    max_extra: float = 1.0


def has_bogus_params(state: State, camera_row: int, bounds: _Bounds = _Bounds()) -> bool:
    """Whether adjustment has driven a camera out of what a lens can be."""
    camera = state.camera(camera_row)
    info, size = camera.model_info, max(camera.width, camera.height)
    focals = camera.params[list(info.focal_indices)] / size
    extras = np.abs(camera.params[list(info.extra_indices)])
    if not np.all(np.isfinite(camera.params)):
        return True
    limits = (focals < bounds.min_focal_ratio) | (focals > bounds.max_focal_ratio)
    return bool(limits.any() or (info.name != "EUCM" and np.any(extras > bounds.max_extra)))
