"""Compiling the kernels before the first run.

numba compiles under one lock for all threads of a process, so a second thread gains nothing. Two processes fill the
cache that the run then reads from: one takes a made-up pair of photos through matching and verification, the other a
made-up scene through mapping. Nothing that a run computes depends on them.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sfm.core.arrays import Points2D
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.events import Note, Observer
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.optim._block_kernels import WIDTH
from sfm.core.optim._cholesky_kernels import PANEL
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optim.dense_cholesky import DenseCholesky
from sfm.core.robust import estimate_fundamental
from sfm.core.scene import Features, Matches, PairKind, Reconstruction, TwoViewGeometry, ViewGraph
from sfm.features import extract_features
from sfm.io.colmap_model import write_model
from sfm.io.kernel_cache import is_complete, mark_complete
from sfm.mapping import map_incrementally
from sfm.matching import MatchingConfig, match_features
from sfm.retrieval import RetrievalConfig, similar_images
from sfm.verification import verify_pair

_IMAGES, _POINTS, _STRAYS = 6, 240, 24
_ROWS = 2 * PANEL
_COMPILE = "import sys; from sfm.pipeline.warm_up import run_parts; run_parts(sys.argv[1:])"


def compile_kernels(observer: Observer, *, threads: int) -> None:
    """Compiles what numba's cache lacks, and says so before and after; at once done if it lacks nothing.

    A failure is told as a warning: the stages compile what they need by themselves then.

    Args:
        threads: with one, the parts are compiled one after the other.
    """
    folder = os.environ.get("NUMBA_CACHE_DIR")
    if folder is None or is_complete(Path(folder)) or os.environ.get("NUMBA_DISABLE_JIT", "0") != "0":
        return
    observer(Note(message="compiling kernels (first run only), about half a minute on two cores"))
    began = time.perf_counter()
    parts = list(_PARTS)
    try:
        failures = _in_processes([parts] if threads == 1 else [[part] for part in parts])
    except OSError as error:  # no memory for a process, or none may be started
        failures = [str(error)]
    if failures:
        message = f"compiling ahead failed, so the stages will take longer: {'; '.join(failures)}"
        observer(Note(message=message, level="warning"))
        return
    mark_complete(Path(folder))
    observer(Note(message=f"kernels compiled in {time.perf_counter() - began:.0f} s"))


def _in_processes(shares: Sequence[Sequence[str]]) -> list[str]:
    """Runs each share of the parts in a process of its own, all at once; the last words of those that fail.

    The processes import what this one would. None outlives the call; if this process is killed, they end by
    themselves when their parts are compiled.
    """
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    environment = {**os.environ, "PYTHONPATH": path}
    with contextlib.ExitStack() as stack:
        workers = []
        for share in shares:
            command = [sys.executable, "-P", "-c", _COMPILE, *share]
            worker = subprocess.Popen(
                command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
            )
            stack.enter_context(worker)
            stack.callback(worker.kill)
            workers.append(worker)
        said = [worker.communicate()[1].decode(errors="replace").strip() for worker in workers]
        outcomes = zip(workers, said, strict=True)
        return [
            words.splitlines()[-1] if words else f"exit code {worker.returncode}"
            for worker, words in outcomes
            if worker.returncode != 0
        ]


def run_parts(names: Sequence[str]) -> None:
    """Takes the made-up scene through these parts of the pipeline."""
    # Compilation makes many objects that live long: looking through them again and again is a tenth of its time, and
    # the garbage among them takes 150 MB.
    gc.disable()
    for name in names:
        _PARTS[name]()


def _features() -> None:
    """Features of a small image of squares."""
    squares = np.random.default_rng(0).integers(0, 255, (8, 8), dtype=np.uint8)
    extract_features(np.kron(squares, np.ones((8, 8), np.uint8)))


def _pair() -> None:
    """Matching and verification of two images, with known and with unknown focal lengths.

    The estimators come first: they take so long that another process has compiled the cameras when those are needed.
    """
    noise = np.random.default_rng(0).uniform(0, 500, (2, 50, 2))
    estimate_fundamental(noise[0], noise[1], rng=np.random.default_rng(0))
    descriptors = np.random.default_rng(0).integers(0, 90, (8, 128), dtype=np.uint8)
    zeros = np.zeros(8, np.float32)
    features = Features(np.zeros((8, 2)), zeros, zeros, descriptors)
    for exact_below in (3000, 0):
        match_features(features, features, MatchingConfig(exact_below=exact_below))
    similar_images(lambda image: features, 2, RetrievalConfig())
    for calibrated in (True, False):
        _verified(calibrated)


def _verified(calibrated: bool) -> TwoViewGeometry | Rejected:
    keypoints, camera = _keypoints(), _camera(calibrated)
    return verify_pair(keypoints[1], keypoints[2], _matches(), camera, camera, rng=np.random.default_rng(0))


def _models() -> list[Reconstruction]:
    """Mapping of the scene from the true poses of its pairs, written to disk once."""
    keypoints = _keypoints()
    graph = ViewGraph(
        {
            (i, j): TwoViewGeometry(
                PairKind.CALIBRATED, _matches().indices, cam2_from_cam1=_pose(j) @ _pose(i).inverse(), tri_angle=0.15
            )
            for i, j in itertools.combinations(keypoints, 2)
        }
    )
    _factor()
    owners, names = dict.fromkeys(keypoints, 1), {k: str(k) for k in keypoints}
    models = map_incrementally(graph, keypoints, {1: _camera(False)}, owners, names)
    with tempfile.TemporaryDirectory() as folder:
        for model in models:
            write_model(model, Path(folder))
    return models


def _factor() -> None:
    """A dense factor of more unknowns than the made-up scene has, of several panels."""
    pattern = BlockPattern.full(_ROWS)
    blocks, unknowns = np.zeros((len(pattern.columns), BLOCK, WIDTH)), BLOCK * _ROWS
    DenseCholesky(pattern, np.zeros(unknowns, bool)).factor(blocks[:, :, :BLOCK], np.ones(unknowns))


_PARTS = {"pair": _pair, "models": _models, "features": _features}


def _camera(calibrated: bool) -> Camera:
    return Camera("SIMPLE_RADIAL", 800, 600, np.array([700.0, 400.0, 300.0, 0.01]), calibrated)


def _pose(image: int) -> Rigid3:
    """On an arc around the points."""
    turn = Rotation3.exp(np.array([0.0, 0.15 * image, 0.02 * image]))
    return Rigid3(turn, np.array([0.0, 0.0, 5.0]))


def _matches() -> Matches:
    return Matches(np.stack([np.arange(_POINTS, dtype=np.int32)] * 2, axis=1))


def _keypoints() -> dict[int, Points2D]:
    """Points of a ball as the cameras see them, to within noise, and a few that belong to nothing."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (_POINTS, 3))
    keypoints: dict[int, Points2D] = {}
    for image in range(1, _IMAGES + 1):
        pixels, _ = _camera(True).project(_pose(image) @ points)
        pixels += rng.normal(0, 0.3, pixels.shape)
        pixels[rng.permutation(_POINTS)[:_STRAYS]] = rng.uniform(100, 500, (_STRAYS, 2))
        keypoints[image] = pixels
    return keypoints
