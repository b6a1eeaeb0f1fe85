"""Robust estimators beside PoseLib and OpenCV: accuracy, and the time of one problem on one thread and of many on two.

    python -m scripts.bench_robust pose DATA/sfm [--sets fountain-P11 Herz-Jesus-P8] [--max-error 1] [--json FILE]
    python -m scripts.bench_robust matrices DATA/twoview [--json FILE]
    python -m scripts.bench_robust pnp [--json FILE]

`pose` gives all estimators the same matches, ours, of pairs with at least 30 that agree with the true pose (4 px), and
the true cameras; errors are the larger of the angles of rotation and translation. `matrices` are the fundamental
matrices and homographies of cmp_adelaide_evd_magsac, judged by the exact validation points: the median over pairs and
seeds of the root mean square (F: Sampson, H: of both transfers) in px. `pnp` is a made-up camera among outliers.

PoseLib is left out where it is not installed (`pip install poselib`). Times are of the thread, but for `batch`, which
is the wall time of all problems on two threads over their number.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import importlib
import importlib.util
import itertools
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy.io

from scripts.bench_pairs import features_of
from scripts.bench_sfm import SETS, environment
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.execution import ordered_map
from sfm.core.geometry.epipolar import essential_from_pose, squared_sampson_errors
from sfm.core.geometry.homogeneous import transform_points
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.robust import (
    RansacConfig,
    estimate_absolute_pose,
    estimate_fundamental,
    estimate_homography,
    estimate_relative_pose,
)
from sfm.core.scene import Reconstruction
from sfm.evaluation.accuracy import area_under_recall
from sfm.matching import SearchableFeatures, match_features

MIN_AGREEING = 30
POSE_SETS = ("fountain-P11", "Herz-Jesus-P8")
AGREE_PX, SEEDS = 4.0, 5
Pose = tuple[np.ndarray, np.ndarray]


def main() -> int:
    options = parse_options()
    cv2.setNumThreads(1)
    rows = list({"pose": poses, "matrices": matrices, "pnp": resections}[options.part](options))
    if options.json:
        report = {"part": options.part, "environment": environment(2), "results": rows}
        options.json.write_text(json.dumps(report, indent=1))
    return 0


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("pose", "matrices", "pnp"))
    parser.add_argument("data", type=Path, nargs="?", default=Path(), help="folder of the sets")
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=POSE_SETS, help="of part pose")
    parser.add_argument("--max-error", type=float, default=1.0, help="px, of an inlier")
    parser.add_argument("--score", choices=("truncated", "marginalized"), default="truncated", help="ours")
    parser.add_argument("--json", type=Path, help="write every figure to this file")
    return parser.parse_args()


def timed(estimate: Callable[[Any], Any], problems: Sequence[Any]) -> tuple[list[Any], dict[str, float]]:
    """The results, and ms a problem: the mean and the median of the thread, and the mean of a batch on two threads."""
    estimate(problems[0])
    results, seconds = [], []
    for problem in problems:
        start = time.thread_time()
        results.append(estimate(problem))
        seconds.append(time.thread_time() - start)
    start = time.perf_counter()
    list(ordered_map(estimate, problems, threads=2))
    batch = time.perf_counter() - start
    times = (np.mean(seconds), np.median(seconds), batch / len(problems))
    return results, dict(zip(("mean_ms", "median_ms", "batch_ms"), (float(1e3 * t) for t in times), strict=True))


def told(times: dict[str, float]) -> str:
    return "  ".join(f"{name[:-3]} {value:.2f} ms" for name, value in times.items())


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
    pairs = [pair for name in options.sets for pair in true_pairs(name, options)]
    if not pairs:
        raise SystemExit(f"no pair has {MIN_AGREEING} matches that agree with the truth")
    print(f"{len(pairs)} pairs, {np.median([len(p.points1) for p in pairs]):.0f} matches in the median")
    for name, estimate in estimators(options.max_error, options.score).items():
        found, times = timed(estimate, pairs)
        aucs = []
        for seed in range(1 if name.startswith("OpenCV") else SEEDS):
            some = found if seed == 0 else [estimate(pair, seed) for pair in pairs]
            errors = [pose_error_deg(pose, pair.cam2_from_cam1) for pose, pair in zip(some, pairs, strict=True)]
            aucs.append(100 * area_under_recall(np.array(errors)))
        auc = dict(zip((0.5, 1, 3, 5, 10), np.mean(aucs, axis=0).tolist(), strict=True))
        told_auc = " ".join(f"{auc[limit]:5.1f}" for limit in (1, 3, 5))
        print(f"{name:24} AUC@1/3/5 {told_auc}   {told(times)}", flush=True)
        yield {"estimator": name, "auc": auc, "runs": len(aucs), **times}


def true_pairs(name: str, options: argparse.Namespace) -> Iterator[Pair]:
    """Our matches of all pairs that have enough true ones."""
    image_set = SETS[name]
    if image_set.read_truth is None:
        raise SystemExit(f"{name} has no true poses")
    truth = image_set.read_truth(options.data / image_set.truth)
    features = [features_of(options.data / image_set.images / image) for image in truth.image_names]
    searchable = [SearchableFeatures(f) for f in features]
    for i, j in itertools.combinations(range(len(features)), 2):
        rows = match_features(searchable[i], searchable[j]).indices
        camera1, camera2 = (truth.cameras[int(truth.image_camera_ids[k])] for k in (i, j))
        points1, points2 = features[i].points2D[rows[:, 0]], features[j].points2D[rows[:, 1]]
        pair = Pair(points1, points2, camera1, camera2, relative_pose(truth, i, j))
        if agreeing(pair) >= MIN_AGREEING:
            yield pair


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


def estimators(max_error_px: float, score: Any) -> dict[str, Callable[..., Pose | None]]:
    """Each takes a pair and returns R and t, or None."""

    def ours(pair: Pair, seed: int = 0) -> Pose | None:
        found = estimate_relative_pose(
            *(pair.points1, pair.points2, pair.camera1, pair.camera2),
            RansacConfig(max_error_px=max_error_px, score=score),
            rng=np.random.default_rng(seed),
        )
        if isinstance(found, Rejected):
            return None
        return found.cam2_from_cam1.rotation.matrix, np.asarray(found.cam2_from_cam1.translation)

    def magsac(pair: Pair) -> Pose | None:
        # In the pixels of one pinhole camera, for the cameras of some sets differ.
        f = pair.camera1.mean_focal_length
        K = np.diag([f, f, 1.0])
        points1, points2 = (
            f * rays(p, c)[:, :2] for p, c in ((pair.points1, pair.camera1), (pair.points2, pair.camera2))
        )
        cv2.setRNGSeed(0)
        E, inliers = cv2.findEssentialMat(points1, points2, K, cv2.USAC_MAGSAC, 0.9999, max_error_px)
        if E is None or E.shape != (3, 3):
            return None
        _, R, t, _ = cv2.recoverPose(E, points1, points2, K, mask=inliers)
        return R, t.ravel()

    chosen: dict[str, Callable[..., Pose | None]] = {"Parallax": ours}
    if importlib.util.find_spec("poselib"):
        for limit in (1000, 100_000):
            chosen[f"PoseLib, 100 to {limit:,}"] = poselib_estimator(max_error_px, limit)
    return {**chosen, "OpenCV USAC_MAGSAC": magsac}


def poselib_estimator(max_error_px: float, limit: int) -> Callable[..., Pose | None]:
    poselib = importlib.import_module("poselib")
    options = {"max_epipolar_error": max_error_px, "min_iterations": 100, "max_iterations": limit}

    def camera(c: Camera) -> dict[str, Any]:
        return {"model": c.model, "width": c.width, "height": c.height, "params": c.params.tolist()}

    def estimate(pair: Pair, seed: int = 0) -> Pose | None:
        pose, _ = poselib.estimate_relative_pose(
            pair.points1, pair.points2, camera(pair.camera1), camera(pair.camera2), {**options, "seed": seed}, {}
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


# --- fundamental matrices and homographies -------------------------------------------------------------------------


def matrices(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each kind and estimator."""
    for kind, folder in (("F", "fundamental_matrix"), ("H", "homography")):
        problems = list(validated(options.data / "cmp_adelaide_evd_magsac" / folder))
        for name, estimate in matrix_estimators(kind, options.max_error, options.score).items():
            found, times = timed(estimate, problems)
            runs = [found] + [[estimate(p, seed) for p in problems] for seed in range(1, SEEDS)]
            errors = [
                [validation_error(kind, matrix, problem[2]) for matrix, problem in zip(run, problems, strict=True)]
                for run in runs
            ]
            # Pair by pair the median over the seeds, then over the pairs: nothing found counts as infinite.
            by_pair = np.median(errors, axis=0)
            row = {"kind": kind, "estimator": name, "pairs": len(problems), "median_px": float(np.median(by_pair))}
            row["within_2_px"], row["within_5_px"] = (float(np.mean(np.array(errors) < px)) for px in (2, 5))
            print(
                f"{kind} {name:20} {row['median_px']:.2f} px  within 2/5 px {100 * row['within_2_px']:.0f}"
                f"/{100 * row['within_5_px']:.0f} %  {told(times)}",
                flush=True,
            )
            yield {**row, "by_pair_px": by_pair.tolist(), **times}


def validated(folder: Path) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Tentative pairs of points and the validation points (6, N) of each pair of images that has them."""
    for path in sorted(folder.glob("*_vpts.mat")):
        points = np.loadtxt(str(path).replace("_vpts.mat", "_pts.txt"))
        exact = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)["validation"].pts
        yield points[:, :2].copy(), points[:, 3:5].copy(), np.asarray(exact, dtype=np.float64)


def validation_error(kind: str, matrix: np.ndarray | None, exact: np.ndarray) -> float:
    if matrix is None:
        return float("inf")
    points1, points2 = (exact[:2] / exact[2]).T, (exact[3:5] / exact[5]).T
    if kind == "F":
        return float(np.sqrt(np.mean(squared_sampson_errors(matrix, points1, points2))))
    there = transform_points(matrix, points1) - points2
    back = transform_points(np.linalg.inv(matrix), points2) - points1
    return float(np.sqrt(np.mean(np.square(there).sum(1) + np.square(back).sum(1)) / 2))


def matrix_estimators(kind: str, max_error_px: float, score: Any) -> dict[str, Callable[..., np.ndarray | None]]:
    def ours(problem: Any, seed: int = 0) -> np.ndarray | None:
        estimate = estimate_fundamental if kind == "F" else estimate_homography
        config = RansacConfig(max_error_px=max_error_px, score=score, min_inliers=8)
        found = estimate(problem[0], problem[1], config, rng=np.random.default_rng(seed))
        return None if isinstance(found, Rejected) else np.asarray(found.matrix)

    def theirs(problem: Any, seed: int = 0) -> np.ndarray | None:
        options = {"max_epipolar_error": max_error_px, "max_reproj_error": max_error_px, "min_iterations": 100}
        poselib = importlib.import_module("poselib")
        estimate = poselib.estimate_fundamental if kind == "F" else poselib.estimate_homography
        matrix, _ = estimate(problem[0], problem[1], {**options, "max_iterations": 10000, "seed": seed}, {})
        return matrix

    def magsac(problem: Any, seed: int = 0) -> np.ndarray | None:
        cv2.setRNGSeed(seed)
        if kind == "F":
            matrix, _ = cv2.findFundamentalMat(problem[0], problem[1], cv2.USAC_MAGSAC, max_error_px, 0.9999, 10000)
        else:
            matrix, _ = cv2.findHomography(
                *(problem[0], problem[1], cv2.USAC_MAGSAC, max_error_px), maxIters=10000, confidence=0.9999
            )
        return matrix if matrix is not None and matrix.shape == (3, 3) else None

    peers = {"PoseLib": theirs} if importlib.util.find_spec("poselib") else {}
    return {"Parallax": ours, **peers, "OpenCV USAC_MAGSAC": magsac}


# --- absolute pose -------------------------------------------------------------------------------------------------


def resections(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each share of outliers and estimator: 100 cameras, 300 points, noise of 1 px, bound of 4."""
    camera = Camera("PINHOLE", 1600, 1200, np.array([1300.0, 1300, 800, 600]))
    for outliers in (0.3, 0.7):
        problems = [made_up(camera, outliers, seed) for seed in range(100)]
        for name, estimate in resection_estimators(camera, options.score).items():
            found, times = timed(estimate, problems)
            errors = np.array([pose_error(R, problem[2]) for R, problem in zip(found, problems, strict=True)])
            row = {"outliers": outliers, "estimator": name, "median_mdeg": float(1e3 * np.median(errors))}
            row["failed"] = int(np.sum(errors > 1))
            print(
                f"{outliers:.0%} wrong {name:20} {row['median_mdeg']:.1f} mdeg, {row['failed']} failed  {told(times)}"
            )
            yield {**row, **times}


def made_up(camera: Camera, outliers: float, seed: int) -> tuple[np.ndarray, np.ndarray, Rigid3]:
    rng = np.random.default_rng(seed)
    pose = Rigid3(Rotation3.exp(rng.normal(size=3)), rng.normal(size=3) * 3)
    points = pose.inverse() @ (rng.uniform(-1, 1, (300, 3)) * [2.5, 2, 1.5] + [0, 0, 5])
    pixels = camera.project(pose @ points)[0] + rng.normal(size=(300, 2))
    wrong = rng.permutation(300)[: int(300 * outliers)]
    pixels[wrong] = rng.uniform(0, 1, (len(wrong), 2)) * [1600, 1200]
    return pixels, points, pose


def pose_error(rotation: np.ndarray | None, true: Rigid3) -> float:
    """The angle of the rotation in degrees."""
    if rotation is None:
        return float("inf")
    turn = rotation @ true.rotation.matrix.T
    return float(np.rad2deg(np.linalg.norm(cv2.Rodrigues(turn)[0])))


def resection_estimators(camera: Camera, score: Any) -> dict[str, Callable[[Any], np.ndarray | None]]:
    K = camera.calibration_matrix

    def ours(problem: Any) -> np.ndarray | None:
        config = RansacConfig(max_error_px=4.0, score=score)
        found = estimate_absolute_pose(problem[0], problem[1], camera, config, rng=np.random.default_rng(0))
        return None if isinstance(found, Rejected) else found.cam_from_world.rotation.matrix

    def theirs(problem: Any) -> np.ndarray | None:
        poselib = importlib.import_module("poselib")
        described = {"model": "PINHOLE", "width": 1600, "height": 1200, "params": camera.params.tolist()}
        options = {"max_reproj_error": 4.0, "min_iterations": 100, "max_iterations": 10000}
        pose, _ = poselib.estimate_absolute_pose(problem[0], problem[1], described, options, {})
        return pose.R

    def usac(problem: Any, method: int) -> np.ndarray | None:
        cv2.setRNGSeed(0)
        good, turn, _, _ = cv2.solvePnPRansac(
            *(problem[1], problem[0], K, None),
            flags=method,
            reprojectionError=4.0,
            iterationsCount=10000,
            confidence=0.9999,
        )
        return cv2.Rodrigues(turn)[0] if good else None

    peers = {"PoseLib": theirs} if importlib.util.find_spec("poselib") else {}
    return {"Parallax": ours, **peers, "OpenCV RANSAC (P3P)": functools.partial(usac, method=cv2.SOLVEPNP_P3P)}


if __name__ == "__main__":
    sys.exit(main())
