"""Compiling the kernels while photos are read.

On the first run every stage would wait for its kernels, about as long as it takes to match a hundred pairs. Compiling
keeps one core busy and features and matches mostly leave the interpreter alone, so one thread compiles ahead of the
stages: it takes them in their order through a made-up scene of a few cameras, whose results are thrown away. What it
has not reached when a stage comes is compiled there and then. Nothing that a run computes depends on it.
"""

from __future__ import annotations

import contextlib
import gc
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from sfm.core.arrays import Points2D
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.events import Note, Observer
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Features, Matches, Reconstruction, TwoViewGeometry, ViewGraph
from sfm.io.kernel_cache import is_complete, mark_complete
from sfm.mapping import map_incrementally
from sfm.matching import match_features
from sfm.verification import verify_pair

_IMAGES, _POINTS, _STRAYS = 6, 240, 24


@contextlib.contextmanager
def kernels_compiled_ahead(observer: Observer, *, calibrated: bool) -> Iterator[None]:
    """While kernels are missing in numba's cache: says so, compiles them on a thread, and notes when all are there.

    The thread ends with the block, at the latest when the step that it is at is done. A failure of it is told as a
    warning: the kernels that the run itself needs were compiled by the stages then.

    Args:
        calibrated: focal lengths are known, so that this kind of verification will be needed.
    """
    folder = os.environ.get("NUMBA_CACHE_DIR")
    if folder is None or is_complete(Path(folder)):
        yield
        return
    observer(Note(message="compiling kernels (first run only), about 25 seconds, partly beside the first stages"))
    compiles = os.environ.get("NUMBA_DISABLE_JIT", "0") == "0"
    steps = _steps(calibrated) if compiles else []
    with _rare_garbage_collection(), _in_background(steps, observer) as done:
        yield
    if compiles and len(done) == len(steps):
        mark_complete(Path(folder))


@contextlib.contextmanager
def _in_background(steps: Sequence[Callable[[], object]], observer: Observer) -> Iterator[list[int]]:
    """Takes the steps on a thread, and tells which are done; leaves out those that are left when the block ends."""
    over = threading.Event()
    done: list[int] = []

    def take() -> None:
        for number, step in enumerate(steps):
            if not over.is_set():
                step()
                done.append(number)

    with ThreadPoolExecutor(1, thread_name_prefix="warm-up") as pool:
        work = pool.submit(take)
        try:
            yield done
        finally:
            over.set()
    if (error := work.exception()) is not None:
        observer(Note(message=f"compiling ahead failed: {type(error).__name__}: {error}", level="warning"))


@contextlib.contextmanager
def _rare_garbage_collection() -> Iterator[None]:
    """Compilation makes many objects that live long: looking through them again and again is a tenth of its time."""
    before = gc.get_threshold()
    gc.set_threshold(100_000, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


def _steps(calibrated: bool) -> list[Callable[[], object]]:
    """In the order of the stages."""
    return [_match, lambda: _verified(calibrated, pairs=1), lambda: _map(calibrated)]


def _match() -> None:
    descriptors = np.random.default_rng(0).integers(0, 90, (8, 128), dtype=np.uint8)
    zeros = np.zeros(8, np.float32)
    features = Features(np.zeros((8, 2)), zeros, zeros, descriptors)
    match_features(features, features)


def _verified(calibrated: bool, pairs: int) -> ViewGraph:
    """The first `pairs` of the made-up scene."""
    camera, keypoints = _camera(calibrated), _keypoints()
    matches = Matches(np.stack([np.arange(_POINTS, dtype=np.int32)] * 2, axis=1))
    found: dict[tuple[int, int], TwoViewGeometry] = {}
    for i, j in [(i, j) for i in keypoints for j in keypoints if i < j][:pairs]:
        rng = np.random.default_rng([i, j])
        geometry = verify_pair(keypoints[i], keypoints[j], matches, camera, camera, rng=rng)
        if not isinstance(geometry, Rejected):
            found[i, j] = geometry
    return ViewGraph(found)


def _map(calibrated: bool) -> list[Reconstruction]:
    graph, keypoints = _verified(calibrated, pairs=_IMAGES**2), _keypoints()
    owners, names = dict.fromkeys(keypoints, 1), {k: str(k) for k in keypoints}
    return map_incrementally(graph, keypoints, {1: _camera(calibrated)}, owners, names)


def _camera(calibrated: bool) -> Camera:
    return Camera("SIMPLE_RADIAL", 800, 600, np.array([700.0, 400.0, 300.0, 0.01]), calibrated)


def _keypoints() -> dict[int, Points2D]:
    """Points of a ball as cameras on an arc around it see them, to within noise, and a few that belong to nothing."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (_POINTS, 3))
    keypoints: dict[int, Points2D] = {}
    for k in range(_IMAGES):
        turn = Rotation3.exp(np.array([0.0, 0.15 * k, 0.02 * k]))
        pixels, _ = _camera(True).project(Rigid3(turn, np.array([0.0, 0.0, 5.0])) @ points)
        pixels += rng.normal(0, 0.3, pixels.shape)
        pixels[rng.permutation(_POINTS)[:_STRAYS]] = rng.uniform(100, 500, (_STRAYS, 2))
        keypoints[k + 1] = pixels
    return keypoints
