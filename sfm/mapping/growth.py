"""Growing a model from two images, one image at a time.

    start from a good pair → adjust
    while an image sees enough points:
        resect it → triangulate what it adds → adjust its neighbourhood
        when the model has grown by a tenth: adjust everything, complete tracks, drop what does not fit
    while an image sees half as many, and nothing speaks against it (see `leftovers`):
        resect it → triangulate → adjust its neighbourhood → keep it or undo all this → go on above
    adjust everything to convergence

What does not hold is taken out on the way, down to nothing where the first pair was wrong.
"""

from __future__ import annotations

import numpy as np

from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.mapping.initialization import InitialPair, acceptable_pairs, rank_initial_pairs
from sfm.mapping.leftovers import chance_doubt, loss_doubt, match_doubt
from sfm.mapping.refinement import adjust_around, drop_misplaced_images, refine, triangulate_seen_by
from sfm.mapping.registration import Resection, next_images, resect
from sfm.mapping.state import State
from sfm.mapping.task import MappingTask


def grow_model(task: MappingTask, state: State, used: np.ndarray) -> None:
    """Adds all images that fit and are not `used` to a model of two; what does not hold may fall apart again."""
    tried_at: dict[int, list[int]] = {}
    refused_at: dict[int, int] = {}
    _add_images(task, state, used, tried_at)
    if _leftovers(task, state, used, refused_at):
        refine(task, state, rounds=2)
        _add_images(task, state, used, tried_at)
        while _register_leftover(task, state, used, refused_at):
            _add_images(task, state, used, tried_at)
    refine(task, state, rounds=5, final=True)


def _add_images(task: MappingTask, state: State, used: np.ndarray, tried_at: dict[int, list[int]]) -> None:
    """Registers image after image with adjustments in between, until no more fits."""
    images_then, points_then = int(state.registered.sum()), int(state.has_point.sum())
    registered = _register_next(task, state, used, tried_at)
    while registered is not None:
        images, points = int(state.registered.sum()), int(state.has_point.sum())
        growth = task.config.global_growth
        if images >= growth * images_then or points >= growth * points_then:
            refine(task, state, rounds=2)
            images_then, points_then = images, int(state.has_point.sum())
        else:
            adjust_around(task, state, registered)
        registered = _register_next(task, state, used, tried_at)
        if registered is None and drop_misplaced_images(task, state):
            registered = _register_next(task, state, used, tried_at)


def start_from_best_pair(
    task: MappingTask, used: np.ndarray, failed: set[tuple[int, int]]
) -> tuple[State, InitialPair] | None:
    """A model of two images that are not `used`, by a pair that has not `failed`; None where no pair starts one.

    Pairs that do not start a model are added to `failed`; `init_trials` may be there.
    """
    config = task.config
    blank = State.start(task.scene)
    blank.registered |= used
    candidates = rank_initial_pairs(blank, task.view_graph)
    acceptable = acceptable_pairs(
        candidates, config.init_min_inliers, np.deg2rad(config.init_min_angle_deg), config.init_max_forward
    )
    for pair in acceptable:
        if len(failed) >= config.init_trials:
            break
        rows = (pair.image1, pair.image2)
        if rows in failed:
            continue
        state = _start_from(task, pair)
        if state is not None:
            return state, pair
        failed.add(rows)
    return None


def _start_from(task: MappingTask, pair: InitialPair) -> State | None:
    """The two-image model of a pair, if enough of its points survive adjustment."""
    state = State.start(task.scene)
    state.set_pose(pair.image1, Rigid3.identity())
    state.set_pose(pair.image2, pair.cam2_from_cam1)
    triangulate_seen_by(task, state, np.array([pair.image1, pair.image2]))
    refine(task, state, rounds=2)
    points = int(state.has_point.sum())
    if points < task.config.resection_min_inliers:
        return None
    for image in (pair.image1, pair.image2):
        task.tell(state, image, Resection(points, points))
    return state


def _register_next(task: MappingTask, state: State, used: np.ndarray, tried_at: dict[int, list[int]]) -> int | None:
    """Registers the image that sees the points best; None when no image can be registered any more."""
    config = task.config
    for image, visible in next_images(state, config.resection_min_inliers):
        attempts = tried_at.setdefault(image, [])
        if used[image] or len(attempts) >= config.resection_trials or (attempts and visible <= attempts[-1]):
            continue
        camera_row = task.scene.image_camera[image]
        is_new = not np.any(state.registered & (task.scene.image_camera == camera_row))
        outcome = resect(
            state,
            image,
            max_error_px=config.resection_max_error_px,
            min_inliers=config.resection_min_inliers,
            min_inlier_ratio=config.resection_min_inlier_ratio,
            refine_focal=task.refine_intrinsics
            and is_new
            and not task.scene.cameras[camera_row].has_prior_focal_length,
            rng=np.random.default_rng([task.seed, int(task.scene.image_ids[image]), len(attempts)]),
        )
        attempts.append(visible)
        task.tell(state, image, outcome)
        if isinstance(outcome, Resection):
            triangulate_seen_by(task, state, np.array([image]))
            return image
    return None


def _leftovers(task: MappingTask, state: State, used: np.ndarray, refused_at: dict[int, int]) -> list[tuple[int, int]]:
    """Images with the number of points that they see, enough for the last round and more than when refused."""
    config = task.config
    if config.leftover_min_inliers >= config.resection_min_inliers:
        return []
    candidates = next_images(state, config.leftover_min_inliers)
    return [(image, n) for image, n in candidates if not used[image] and n > refused_at.get(image, 0)]


def _register_leftover(task: MappingTask, state: State, used: np.ndarray, refused_at: dict[int, int]) -> bool:
    """Registers an image that sees few points if nothing speaks against it; False where there is none."""
    config = task.config
    for image, visible in _leftovers(task, state, used, refused_at):
        outcome = resect(
            state,
            image,
            max_error_px=config.resection_max_error_px,
            min_inliers=config.leftover_min_inliers,
            min_inlier_ratio=config.resection_min_inlier_ratio,
            refine_focal=False,  # which so few points do not determine
            rng=np.random.default_rng([task.seed, int(task.scene.image_ids[image]), visible, 1]),
        )
        if isinstance(outcome, Resection):
            before = state.copy()
            doubt = _settle_leftover(task, state, image)
            if doubt is not None:
                state.become(before)
                state.unregister(image)
                outcome = doubt
        task.tell(state, image, outcome, config.leftover_min_inliers)
        if isinstance(outcome, Resection):
            return True
        refused_at[image] = visible
    return False


def _settle_leftover(task: MappingTask, state: State, image: int) -> Rejected | None:
    """Triangulates and adjusts what a newly registered image sees; why it had better be undone, if it had."""
    config = task.config
    doubt = chance_doubt(state, image, config.resection_max_error_px)
    if doubt is None:
        triangulate_seen_by(task, state, np.array([image]))
        adjust_around(task, state, image)
        doubt = loss_doubt(state, image, config.leftover_min_inliers)
    if doubt is None:
        alone = np.arange(len(state.registered)) == image
        doubt = match_doubt(state, alone, ~alone, task.view_graph, config.max_error_px)
    return doubt
