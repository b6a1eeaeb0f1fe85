"""Models are kept right while they grow: adjusted, their tracks completed, and rid of what does not fit."""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.bundle import BundleConfig
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.errors import Rejected
from sfm.mapping.adjustment import adjust_globally, adjust_locally, has_bogus_params, neighbourhood
from sfm.mapping.state import State
from sfm.mapping.task import MappingTask


def triangulate_seen_by(task: MappingTask, state: State, images: np.ndarray) -> None:
    """Makes and completes points on the tracks of these images."""
    config, tracks = task.config, state.tracks_seen_by(images)
    # A point needs two registered images.
    tracks = tracks[state.registered_views()[tracks] >= 2]
    if len(tracks):
        long = np.diff(task.scene.offsets)[tracks] >= config.min_track_length
        tracks = tracks[long] if long.sum() >= config.init_min_inliers else tracks
        state.triangulate(tracks, config.triangulation_max_error_px, np.deg2rad(config.min_angle_deg))


def adjust_around(task: MappingTask, state: State, image: int) -> None:
    """Local adjustment after a registration."""
    config = task.config
    images = neighbourhood(state, image, config.local_images, np.deg2rad(6.0))
    bundle = BundleConfig(
        loss="soft_l1", loss_scale_px=config.loss_scale_px, max_iterations=15, relative_cost_tolerance=1e-4
    )
    fixed = np.zeros((len(task.scene.cameras), MAX_PARAMS), bool)
    adjust_locally(state, images, bundle, free_params=fixed, threads=task.threads, observer=task.observer)
    tracks = state.tracks_seen_by(images)
    state.filter(tracks, config.max_error_px, np.deg2rad(config.min_angle_deg))


def refine(task: MappingTask, state: State, *, rounds: int, final: bool = False) -> None:
    """Adjusts everything, then completes tracks and drops what does not fit, until little changes."""
    config = task.config
    min_angle = np.deg2rad(config.min_angle_deg)
    bundle = BundleConfig(
        loss="soft_l1",
        loss_scale_px=config.loss_scale_px,
        max_iterations=100 if final else 30,
        relative_cost_tolerance=1e-6 if final else 1e-4,
    )
    for _ in range(rounds):
        before = state.on.copy()
        _adjust_all(task, state, bundle)
        all_tracks = np.arange(len(state.has_point))
        state.filter(all_tracks, config.max_error_px, min_angle)
        triangulate_seen_by(task, state, np.flatnonzero(state.registered))
        state.filter(all_tracks, config.max_error_px, min_angle)
        _drop_lost_images(task, state)
        drop_misplaced_images(task, state)
        if np.sum(state.on != before) <= 0.0005 * np.sum(before):
            break
    if final:
        exact = dataclasses.replace(bundle, relative_cost_tolerance=1e-8)
        _adjust_all(task, state, bundle, principal_points=True)
        for _ in range(2):  # better poses show the noise better
            _adjust_all(task, state, exact, principal_points=True, weighted=True)
        state.filter(np.arange(len(state.has_point)), config.max_error_px, min_angle)


def _drop_lost_images(task: MappingTask, state: State) -> None:
    """Takes out images whose pose hardly any observation supports any more; they may be tried again."""
    views = np.bincount(task.scene.image[state.on], minlength=len(state.registered))
    for image in np.flatnonzero(state.registered & (views < task.config.min_observations)).tolist():
        state.unregister(image)
        task.tell(state, image, Rejected("lost_observations", f"{views[image]} of its observations still fit"))


def drop_misplaced_images(task: MappingTask, state: State) -> bool:
    """Takes out images that disagree with most points of the model that they should see; True if there are any.

    A wrong pose can hold itself up by the few false matches that it comes from, e.g. that of the first pair.
    """
    on, observed = np.zeros(len(state.registered)), np.zeros(len(state.registered))
    np.add.at(on, task.scene.image[state.on], 1)
    np.add.at(observed, task.scene.image[state.has_point[task.scene.track_of]], 1)
    share = on / np.maximum(observed, 1)
    misplaced = np.flatnonzero(state.registered & (share < task.config.min_agreeing_share))
    if state.registered.sum() - len(misplaced) < 2:
        return False
    for image in misplaced.tolist():
        state.unregister(image)
        detail = f"agrees with {100 * share[image]:.0f} % of the points that it should see"
        task.tell(state, image, Rejected("misplaced", detail))
    return len(misplaced) > 0


def _adjust_all(
    task: MappingTask, state: State, bundle: BundleConfig, *, principal_points: bool = False, weighted: bool = False
) -> None:
    """Adjusts everything; a camera that this drives out of bounds goes back and is held."""
    free = _free_params(task, state, principal_points)
    before = state.copy()

    def adjust() -> None:
        adjust_globally(
            state, bundle, free_params=free, threads=task.threads, observer=task.observer, weighted=weighted
        )

    adjust()
    bogus = [row for row in np.flatnonzero(free.any(1)).tolist() if has_bogus_params(state, row)]
    if bogus:
        for name in ("params", "ray", "R", "t", "points"):
            setattr(state, name, getattr(before, name))
        free[bogus] = False
        adjust()


def _free_params(task: MappingTask, state: State, principal_points: bool) -> np.ndarray:
    """Which parameters (C, K) are adjusted.

    Two images show little of a lens: then only a guessed focal length is. The principal point, which a rotation
    imitates, is left to the end and to cameras with several images.
    """
    free = np.zeros((len(task.scene.cameras), MAX_PARAMS), bool)
    if not task.refine_intrinsics:
        return free
    images = np.bincount(task.scene.image_camera[state.registered], minlength=len(free))
    enough = images.sum() > 2
    for row in np.flatnonzero(images):
        camera = task.scene.cameras[row]
        if enough or not camera.has_prior_focal_length:
            free[row, list(camera.model_info.focal_indices)] = True
        if enough:
            free[row, list(camera.model_info.extra_indices)] = True
        if principal_points and images[row] >= task.config.principal_point_min_images:
            free[row, list(camera.model_info.principal_point_indices)] = True
    return free
