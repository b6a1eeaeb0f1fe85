"""Incremental mapping: models that grow from two images, one image at a time (see `growth`).

Images that are left start the next model. Models that prove to lie in one world are joined (see `joining`). A model
that folds two places onto each other (see `ambiguity`) is grown anew without the matches that mistake one for the
other.

Reference:
    Schönberger & Frahm, Structure-from-Motion Revisited, CVPR 2016.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sfm.core.arrays import FloatArray, Points2D
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.events import SILENT, Note, Observer
from sfm.core.scene import PairKind, Reconstruction, ViewGraph
from sfm.mapping.ambiguity import unfolded
from sfm.mapping.config import MappingConfig
from sfm.mapping.growth import grow_model, start_from_best_pair
from sfm.mapping.joining import find_join, join_doubt, merged
from sfm.mapping.leftovers import match_doubt
from sfm.mapping.refinement import refine
from sfm.mapping.state import Scene, State
from sfm.mapping.task import MappingTask
from sfm.mapping.tracks import build_tracks


def map_incrementally(
    view_graph: ViewGraph,
    keypoints: Mapping[int, Points2D],
    cameras: Mapping[int, Camera],
    image_cameras: Mapping[int, int],
    image_names: Mapping[int, str],
    config: MappingConfig = MappingConfig(),
    *,
    keypoint_scales: Mapping[int, FloatArray] | None = None,
    seed: int = 0,
    threads: int = 1,
    refine_intrinsics: bool = True,
    observer: Observer = SILENT,
) -> list[Reconstruction]:
    """Models of all images that hang together, the one with most images first; empty where no pair starts one.

    Args:
        keypoints: by image id, in px; the rows are what the matches of `view_graph` count.
        cameras: by camera id. Their focal lengths and distortions are refined unless `refine_intrinsics` is false.
        image_cameras: camera id of each image id.
        keypoint_scales: by image id, in px, row by row with `keypoints`: how precise each scale is will be learnt.
        seed: of the resections' random samples.
        threads: changes the time, not the result.
    """

    # Logos and time stamps would chain photos of different places together.
    view_graph = ViewGraph({k: g for k, g in view_graph.pairs.items() if g.kind != PairKind.WATERMARK})

    def grow(graph: ViewGraph) -> list[Reconstruction]:
        tracks = build_tracks(graph, keypoints, min_length=2)
        scene = Scene.build(tracks, keypoints, cameras, image_cameras, image_names, keypoint_scales)
        return _grow_models(MappingTask(scene, graph, config, seed, threads, refine_intrinsics, observer))

    models = grow(view_graph)
    for attempt in range(config.max_unfoldings):
        graphs = (unfolded(view_graph, model, suspected=attempt > 0) for model in models)
        if (graph := next((g for g in graphs if g is not None), None)) is None:
            break
        dropped = len(view_graph) - len(graph)
        observer(Note(message=f"two places look alike: leaving out {dropped} pairs that mistake one for the other"))
        view_graph, models = graph, grow(graph)
    return models


def _grow_models(task: MappingTask) -> list[Reconstruction]:
    """Models of all images that hang together, the one with most images first."""
    states: list[State] = []
    used = np.zeros(len(task.scene.image_ids), bool)
    failed: set[tuple[int, int]] = set()
    while len(states) < task.config.max_models and (start := start_from_best_pair(task, used, failed)) is not None:
        state, pair = start
        grow_model(task, state, used)
        if state.registered.sum() >= 2:
            used |= state.registered
            states.append(state)
        else:  # grown from a wrong pair, nothing in it agreed in the end
            failed.add((pair.image1, pair.image2))
    states.sort(key=lambda s: (-s.registered.sum(), -s.has_point.sum()))
    states = _joined(task, states)
    states.sort(key=lambda s: (-s.registered.sum(), -s.has_point.sum()))
    kept = [s for k, s in enumerate(states) if k == 0 or s.registered.sum() >= task.config.min_model_images]
    return [state.to_reconstruction() for state in kept]


def _joined(task: MappingTask, states: list[State]) -> list[State]:
    """The models, where one of them lies in another's world as one of both, with the images that now fit."""
    states, first = list(states), 0
    while first < len(states):
        for second in range(first + 1, len(states)):
            both = _join(task, states[first], states[second])
            if both is None:
                continue
            others = np.zeros(len(both.registered), bool)
            for k, state in enumerate(states):
                others |= state.registered & (k not in (first, second))
            grow_model(task, both, others)
            if both.registered.sum() >= 2:  # else it fell apart, and two models are better than none
                states[first] = both
                del states[second]
                break
        else:
            first += 1
    return states


def _join(task: MappingTask, a: State, b: State) -> State | None:
    """One model of two that have enough tracks in common, adjusted; None where they do not fit."""
    config, ids = task.config, task.scene.image_ids
    rng = np.random.default_rng([task.seed, int(ids[a.registered][0]), int(ids[b.registered][0]), 2])
    found = find_join(a, b, config.resection_max_error_px, config.join_min_tracks, rng)
    if isinstance(found, Rejected):
        return None
    both = merged(a, b, found.a_from_b)
    refine(task, both, rounds=3)
    doubt = join_doubt(both, a.registered, b.registered, config.join_min_tracks)
    if doubt is None:
        doubt = match_doubt(both, a.registered, b.registered, task.view_graph, config.max_error_px)
    sizes = f"models of {a.registered.sum()} and {b.registered.sum()} images"
    if doubt is not None:
        task.observer(Note(message=f"{sizes} stay apart: {doubt.detail}"))
        return None
    task.observer(Note(message=f"{sizes} joined by {found.agreeing} common tracks"))
    return both
