"""Features, matches and two-view geometry beside pycolmap, PoseLib and OpenCV.

    python -m scripts.bench_frontend stages DATA [--sets fountain-P11 ...] [--max-image-size 1600] [--json FILE]
    python -m scripts.bench_frontend pose DATA [--sets fountain-P11 Herz-Jesus-P8] [--json FILE]

`stages` times extraction, matching and verification of a set from empty databases, pycolmap at its defaults and, with
`--max-image-size`, both sides at that size. A round runs one side after the other; `--repeat` rounds, medians count.
Accuracy with the rest of the pipeline is the matter of bench_sfm.

`pose` gives all estimators the same matches, ours, of pairs with at least 30 that agree with the true pose (4 px), and
the true cameras; errors are the larger of the angles of rotation and translation. PoseLib is left out where it is not
installed (`pip install poselib`).
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import itertools
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from scripts.bench_sfm import SETS, environment, image_names
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.events import SILENT
from sfm.core.geometry.epipolar import essential_from_pose
from sfm.core.geometry.rigid import Rigid3
from sfm.core.robust import RansacConfig, estimate_relative_pose
from sfm.core.scene import Features, Reconstruction
from sfm.evaluation.accuracy import area_under_recall
from sfm.features import extract_features
from sfm.io.database import Database
from sfm.io.images import read_image
from sfm.matching import SearchableFeatures, match_features
from sfm.pipeline.config import DEFAULTS, with_settings
from sfm.pipeline.scene import read_scene
from sfm.pipeline.stages import Run, extract_all, match_all, verify_all
from sfm.pipeline.warm_up import run_parts
from sfm.retrieval import exhaustive_pairs

STAGE_SETS = ("fountain-P11", "Herz-Jesus-P8", "SceauxCastle", "lund", "middlebury_templeRing")
POSE_SETS = ("fountain-P11", "Herz-Jesus-P8")
MIN_AGREEING, AGREE_PX = 30, 4.0
Pose = tuple[np.ndarray, np.ndarray]


def main() -> int:
    options = parse_options()
    if "OPENBLAS_NUM_THREADS" not in os.environ:  # as the command sets it, which must be before NumPy is loaded
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, [sys.executable, "-m", "scripts.bench_frontend", *sys.argv[1:]])
    rows = list({"stages": stages, "pose": poses}[options.part](options))
    if options.json:
        report = {"part": options.part, "environment": environment(options.threads), "results": rows}
        options.json.write_text(json.dumps(report, indent=1))
    return 0


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("stages", "pose"))
    parser.add_argument("data", type=Path, help="folder of the image sets")
    parser.add_argument("--sets", nargs="+", choices=list(SETS))
    parser.add_argument("--max-image-size", type=int, help="both sides; else each side's default")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--max-error", type=float, default=1.0, help="px, of an inlier (part pose)")
    parser.add_argument("--json", type=Path, help="write every figure to this file")
    return parser.parse_args()


# --- stages --------------------------------------------------------------------------------------------------------


def stages(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each set, with the median seconds of both sides."""
    run_parts(["pair"])
    for name in options.sets or STAGE_SETS:
        images = options.data / SETS[name].images
        if not images.is_dir():
            print(f"{name}: no folder {images}, skipped", file=sys.stderr)
            continue
        rounds = [(our_seconds(images, options), their_seconds(images, options)) for _ in range(options.repeat)]
        ours, theirs = (
            {stage: float(np.median([r[side][stage] for r in rounds])) for stage in rounds[0][side]} for side in (0, 1)
        )
        ratio = sum(ours.values()) / sum(theirs.values())
        row = {"set": name, "max_image_size": options.max_image_size, "ours_s": ours, "pycolmap_s": theirs}
        print(f"{name:22} ours {told(ours)}   pycolmap {told(theirs)}   {ratio:.3f} = 1/{1 / ratio:.1f}", flush=True)
        yield {**row, "ratio": ratio}


def told(seconds: dict[str, float]) -> str:
    parts = " ".join(f"{stage} {value:.2f}" for stage, value in seconds.items())
    return f"{sum(seconds.values()):6.2f} s ({parts})"


def our_seconds(images: Path, options: argparse.Namespace) -> dict[str, float]:
    """The pipeline's own stages into an empty database; kernels are compiled before."""
    size = {"features.max_image_size": options.max_image_size} if options.max_image_size else {}
    config = with_settings(DEFAULTS, size, "the benchmark")
    seconds = {}
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory(prefix="bench_frontend_") as work, Database.open(Path(work) / "database.db") as db:
        start = time.perf_counter()
        scene = read_scene(db, images, config.cameras, threads=options.threads, observer=SILENT)
        run = Run(db, config, options.threads, SILENT, scene.images)
        features = extract_all(run)
        seconds["features"], start = time.perf_counter() - start, time.perf_counter()
        matches = match_all(run, features, exhaustive_pairs(features))
        seconds["matching"], start = time.perf_counter() - start, time.perf_counter()
        verify_all(run, matches)
        seconds["verification"] = time.perf_counter() - start
    return seconds


def their_seconds(images: Path, options: argparse.Namespace) -> dict[str, float]:
    """pycolmap's extraction, and its exhaustive matching, which verifies as well."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR.value)
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    for some in (extraction, matching):
        some.num_threads, some.use_gpu = options.threads, False
    if options.max_image_size:
        extraction.max_image_size = options.max_image_size
    seconds = {}
    with tempfile.TemporaryDirectory(prefix="bench_frontend_") as work:
        database = Path(work) / "database.db"
        start = time.perf_counter()
        pycolmap.extract_features(database, images, image_names=image_names(images), extraction_options=extraction)
        seconds["features"], start = time.perf_counter() - start, time.perf_counter()
        pycolmap.match_exhaustive(database, matching_options=matching)
        seconds["matching and verification"] = time.perf_counter() - start
    return seconds


# --- relative pose -------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Pair:
    """Matched pixels of two images with their cameras and true relative pose."""

    points1: np.ndarray
    points2: np.ndarray
    camera1: Camera
    camera2: Camera
    cam2_from_cam1: Rigid3


def poses(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each estimator over the pairs of all sets."""
    pairs = [pair for name in options.sets or POSE_SETS for pair in true_pairs(name, options)]
    if not pairs:
        raise SystemExit(f"no pair has {MIN_AGREEING} matches that agree with the truth")
    print(f"{len(pairs)} pairs, {np.median([len(p.points1) for p in pairs]):.0f} matches in the median, one thread")
    for name, estimate in estimators(options.max_error).items():
        errors, seconds = [], []
        for pair in pairs:
            start = time.perf_counter()
            found = estimate(pair)
            seconds.append(time.perf_counter() - start)
            errors.append(pose_error_deg(found, pair.cam2_from_cam1))
        auc = dict(zip((0.5, 1, 3, 5, 10), (100 * area_under_recall(np.array(errors))).tolist(), strict=True))
        mean, median = 1e3 * np.mean(seconds), 1e3 * np.median(seconds)
        told_auc = " ".join(f"{auc[limit]:5.1f}" for limit in (1, 3, 5))
        print(f"{name:24} AUC@1/3/5 {told_auc}   {mean:6.1f} ms, {median:.1f} in the median", flush=True)
        yield {"estimator": name, "auc": auc, "mean_ms": mean, "median_ms": median}


def true_pairs(name: str, options: argparse.Namespace) -> Iterator[Pair]:
    """Our matches of all pairs that have enough true ones."""
    image_set = SETS[name]
    if image_set.read_truth is None:
        raise SystemExit(f"{name} has no true poses")
    truth = image_set.read_truth(options.data / image_set.truth)
    cv2.setNumThreads(options.threads)
    features = [features_of(options.data / image_set.images / image) for image in truth.image_names]
    searchable = [SearchableFeatures(f) for f in features]
    for i, j in itertools.combinations(range(len(features)), 2):
        rows = match_features(searchable[i], searchable[j]).indices
        camera1, camera2 = (truth.cameras[int(truth.image_camera_ids[k])] for k in (i, j))
        points1, points2 = features[i].points2D[rows[:, 0]], features[j].points2D[rows[:, 1]]
        pair = Pair(points1, points2, camera1, camera2, relative_pose(truth, i, j))
        if agreeing(pair) >= MIN_AGREEING:
            yield pair


def features_of(path: Path) -> Features:
    found = extract_features(read_image(path, gray=True))
    if isinstance(found, Rejected):
        raise SystemExit(f"{path} has no features")
    return found


def relative_pose(truth: Reconstruction, i: int, j: int) -> Rigid3:
    return truth.cams_from_world[j] @ truth.cams_from_world[i].inverse()


def agreeing(pair: Pair) -> int:
    """Matches within `AGREE_PX` of the epipolar lines of the true pose, by Sampson's distance."""
    rays1, rays2 = (rays(p, c) for p, c in ((pair.points1, pair.camera1), (pair.points2, pair.camera2)))
    E = essential_from_pose(pair.cam2_from_cam1)
    lines2, lines1 = rays1 @ E.T, rays2 @ E
    scale = np.sqrt(np.sum(lines1[:, :2] ** 2, 1) + np.sum(lines2[:, :2] ** 2, 1)) / pair.camera1.mean_focal_length
    return int(np.sum(np.abs(np.sum(rays2 * lines2, 1)) < AGREE_PX * scale))


def rays(points: np.ndarray, camera: Camera) -> np.ndarray:
    """(x, y, 1) in the frame of the camera."""
    along, _ = camera.unproject(points)
    return along / along[:, 2:]


def estimators(max_error_px: float) -> dict[str, Callable[[Pair], Pose | None]]:
    """Each takes a pair and returns R and t, or None."""

    def ours(pair: Pair) -> Pose | None:
        found = estimate_relative_pose(
            *(pair.points1, pair.points2, pair.camera1, pair.camera2),
            RansacConfig(max_error_px=max_error_px),
            rng=np.random.default_rng(0),
        )
        if isinstance(found, Rejected):
            return None
        return found.cam2_from_cam1.rotation.matrix, np.asarray(found.cam2_from_cam1.translation)

    def magsac(pair: Pair) -> Pose | None:
        K = pair.camera1.calibration_matrix  # one camera took all images of these sets
        cv2.setRNGSeed(0)
        E, inliers = cv2.findEssentialMat(pair.points1, pair.points2, K, cv2.USAC_MAGSAC, 0.9999, max_error_px)
        if E is None or E.shape != (3, 3):
            return None
        _, R, t, _ = cv2.recoverPose(E, pair.points1, pair.points2, K, mask=inliers)
        return R, t.ravel()

    def colmap(pair: Pair) -> Pose | None:
        options = pycolmap.RANSACOptions()
        options.max_error = max_error_px
        camera1, camera2 = (
            pycolmap.Camera(model=c.model, width=c.width, height=c.height, params=c.params)
            for c in (pair.camera1, pair.camera2)
        )
        found = pycolmap.estimate_essential_matrix(pair.points1, pair.points2, camera1, camera2, options)
        if not found:
            return None
        pose = found["cam2_from_cam1"]
        return pose.rotation.matrix(), pose.translation

    chosen: dict[str, Callable[[Pair], Pose | None]] = {"Parallax": ours}
    if importlib.util.find_spec("poselib"):
        for limit in (1000, 100_000):
            chosen[f"PoseLib, 100 to {limit:,}"] = poselib_estimator(max_error_px, limit)
    return {**chosen, "OpenCV USAC_MAGSAC": magsac, "pycolmap essential": colmap}


def poselib_estimator(max_error_px: float, limit: int) -> Callable[[Pair], Pose | None]:
    poselib = importlib.import_module("poselib")
    options = {"max_epipolar_error": max_error_px, "min_iterations": 100, "max_iterations": limit}

    def camera(c: Camera) -> dict[str, Any]:
        return {"model": c.model, "width": c.width, "height": c.height, "params": c.params.tolist()}

    def estimate(pair: Pair) -> Pose | None:
        pose, _ = poselib.estimate_relative_pose(
            pair.points1, pair.points2, camera(pair.camera1), camera(pair.camera2), options, {}
        )
        return pose.R, pose.t

    return estimate


def pose_error_deg(found: Pose | None, true: Rigid3) -> float:
    """The larger of the angles of rotation and translation; infinite where nothing was found."""
    if found is None:
        return float("inf")
    R, t = found
    turn = R @ true.rotation.matrix.T
    rotation = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    direction = np.asarray(true.translation) / np.linalg.norm(true.translation)
    translation = np.arccos(np.clip(t @ direction / np.linalg.norm(t), -1, 1))
    return float(np.rad2deg(max(rotation, translation)))


if __name__ == "__main__":
    sys.exit(main())
