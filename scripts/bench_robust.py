"""Robust estimators beside PoseLib and OpenCV: accuracy, and the time of one problem on one thread and of many on two.

    python -m scripts.bench_robust pose DATA/sfm [--sets fountain-P11 Herz-Jesus-P8] [--max-error 1] [--json FILE]
    python -m scripts.bench_robust fundamental DATA/sfm [--sets …] [--max-error 1]
    python -m scripts.bench_robust matrices DATA/twoview [--json FILE]
    python -m scripts.bench_robust pnp [DATA/sfm] [--sets …] [--json FILE]

`pose` gives all estimators the same matches, ours, of pairs with at least 30 that agree with the true pose (4 px), and
the true cameras; errors are the larger of the angles of rotation and translation. `fundamental` are the F of the same
pairs, judged by their matches brought onto the true epipolar lines. `matrices` are the fundamental matrices and
homographies of cmp_adelaide_evd_magsac, judged by the exact validation points, and homographies of oxford_affine from
our matches of the first photo with each other one, judged by a grid under the true one: the median over pairs and
seeds of the root mean square (F: Sampson, H: of both transfers) in px. `pnp` is a made-up camera among outliers and,
with DATA, each photo of the sets against points that the other photos have, triangulated under their true poses from
our matches; errors are the larger of the angle of the rotation and that at which the true and the found centre are seen
from the points.

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
from sfm.core.geometry.triangulation import triangulate_midpoint
from sfm.core.robust import (
    RansacConfig,
    estimate_absolute_pose,
    estimate_fundamental,
    estimate_homography,
    estimate_relative_pose,
)
from sfm.core.scene import Reconstruction
from sfm.evaluation.accuracy import area_under_recall
from sfm.io.images import read_image
from sfm.matching import SearchableFeatures, match_features

MIN_AGREEING = 30
POSE_SETS = ("fountain-P11", "Herz-Jesus-P8")
AGREE_PX, SEEDS = 4.0, 5
Pose = tuple[np.ndarray, np.ndarray]


def main() -> int:
    options = parse_options()
    cv2.setNumThreads(1)
    parts = {"pose": poses, "fundamental": fundamentals, "matrices": matrices, "pnp": resections}
    rows = list(parts[options.part](options))
    if options.json:
        report = {"part": options.part, "environment": environment(2), "results": rows}
        options.json.write_text(json.dumps(report, indent=1))
    return 0


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("pose", "fundamental", "matrices", "pnp"))
    parser.add_argument("data", type=Path, nargs="?", help="folder of the sets")
    parser.add_argument(
        "--sets", nargs="+", choices=list(SETS), default=POSE_SETS, help="of parts pose, fundamental, pnp"
    )
    parser.add_argument("--max-error", type=float, default=1.0, help="px, of an inlier")
    parser.add_argument("--score", choices=("truncated", "marginalized"), default="marginalized", help="ours")
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
    # The mean of few small problems is that of the threads' start: enough of them, and the best of three times.
    many, walls = [*problems] * max(1, 200 // len(problems)), []
    for _ in range(3):
        start = time.perf_counter()
        list(ordered_map(estimate, many, threads=2))
        walls.append((time.perf_counter() - start) / len(many))
    times = (np.mean(seconds), np.median(seconds), min(walls))
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
    """One row for each kind of matrix, set and estimator."""
    pairs = options.data / "cmp_adelaide_evd_magsac"
    sets = {
        "cmp F": ("F", list(validated(pairs / "fundamental_matrix"))),
        "cmp H": ("H", list(validated(pairs / "homography"))),
        "oxford H": ("H", list(planar(options.data / "oxford_affine"))),
    }
    for name, (kind, problems) in sets.items():
        yield from judged(name, kind, problems, options)


def fundamentals(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each estimator: F of the pairs of part pose."""
    problems = []
    for pair in (pair for name in options.sets for pair in true_pairs(name, options)):
        K1, K2 = pair.camera1.calibration_matrix, pair.camera2.calibration_matrix
        F = np.linalg.inv(K2).T @ essential_from_pose(pair.cam2_from_cam1) @ np.linalg.inv(K1)
        exact1, exact2 = (p[0] for p in cv2.correctMatches(F, pair.points1[None], pair.points2[None]))
        moved = np.hypot(*(exact1 - pair.points1).T) ** 2 + np.hypot(*(exact2 - pair.points2).T) ** 2
        right = moved < (AGREE_PX / 2) ** 2
        problems.append((pair.points1, pair.points2, columns(exact1[right], exact2[right])))
    yield from judged("posed F", "F", problems, options)


def judged(name: str, kind: str, problems: list[Any], options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each estimator of the matrices of pairs of points with validation points."""
    for peer, estimate in matrix_estimators(kind, options.max_error, options.score).items():
        found, times = timed(estimate, problems)
        runs = [found] + [[estimate(p, seed) for p in problems] for seed in range(1, SEEDS)]
        errors = [
            [validation_error(kind, matrix, problem[2]) for matrix, problem in zip(run, problems, strict=True)]
            for run in runs
        ]
        # Pair by pair the median over the seeds, then over the pairs: nothing found counts as infinite.
        by_pair = np.median(errors, axis=0)
        row = {"set": name, "estimator": peer, "pairs": len(problems), "median_px": float(np.median(by_pair))}
        row |= {f"within_{px}_px": float(np.mean(np.array(errors) < px)) for px in (1, 2, 5)}
        shares = "/".join(f"{100 * row[f'within_{px}_px']:.1f}" for px in (1, 2, 5))
        print(f"{name:8} {peer:20} {row['median_px']:.2f} px  within 1/2/5 px {shares} %  {told(times)}", flush=True)
        yield {**row, "by_pair_px": by_pair.tolist(), **times}


def validated(folder: Path) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Tentative pairs of points and the validation points (6, N) of each pair of images that has them.

    Leuven1 is left out: its pairs of points are those of castle.
    """
    for path in sorted(folder.glob("*_vpts.mat")):
        if path.name.startswith("Leuven1_"):
            continue
        points = np.loadtxt(str(path).replace("_vpts.mat", "_pts.txt"))
        exact = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)["validation"].pts
        yield points[:, :2].copy(), points[:, 3:5].copy(), np.asarray(exact, dtype=np.float64)


def planar(folder: Path) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Our matches of the first photo with each other one, and a grid of the first under the true homography."""
    for scene in ("boat", "bikes"):
        photos = [folder / scene / f"img{k}.png" for k in range(1, 7)]
        features = [features_of(photo) for photo in photos]
        first, *others = (SearchableFeatures(f) for f in features)
        (height, width), half = read_image(photos[0], gray=True).shape, np.eye(3)
        half[:2, 2] = 0.5
        grid = np.stack(np.meshgrid(np.linspace(0, width, 12), np.linspace(0, height, 9)), axis=-1).reshape(-1, 2)
        for k, other in enumerate(others, 2):
            file = cv2.FileStorage(str(folder / scene / f"H1to{k}p.xml"), cv2.FILE_STORAGE_READ)
            # Given between centres of pixels that count from zero.
            mapped = transform_points(half @ file.getFirstTopLevelNode().mat() @ np.linalg.inv(half), grid)
            visible = ((mapped > 0) & (mapped < [width, height])).all(1)
            rows = match_features(first, other).indices
            points1, points2 = features[0].points2D[rows[:, 0]], features[k - 1].points2D[rows[:, 1]]
            yield points1, points2, columns(grid[visible], mapped[visible])


def columns(points1: np.ndarray, points2: np.ndarray) -> np.ndarray:
    """Homogeneous coordinates (6, N) of pairs of points."""
    ones = np.ones(len(points1))
    return np.stack([*points1.T, ones, *points2.T, ones])


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


@dataclasses.dataclass(frozen=True)
class Photo:
    """Pixels, the points of the world that they may show, the camera and its true pose."""

    points2D: np.ndarray
    points3D: np.ndarray
    camera: Camera
    cam_from_world: Rigid3


def resections(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each set and estimator: 100 made-up cameras with 300 points and noise of 1 px, and real photos."""
    camera = Camera("PINHOLE", 1600, 1200, np.array([1300.0, 1300, 800, 600]))
    sets = {f"{share:.0%} wrong": [made_up(camera, share, seed) for seed in range(100)] for share in (0.3, 0.7)}
    if options.data:
        sets["photos"] = [photo for name in options.sets for photo in posed_photos(name, options)]
    for name, photos in sets.items():
        for peer, estimate in resection_estimators(options.score).items():
            found, times = timed(estimate, photos)
            errors = np.array([resection_error(pose, photo) for pose, photo in zip(found, photos, strict=True)])
            row = {"set": name, "photos": len(photos), "estimator": peer, "median_mdeg": float(1e3 * np.median(errors))}
            row["failed"] = int(np.sum(errors > 1))
            print(
                f"{name:9} {peer:20} {row['median_mdeg']:.1f} mdeg, {row['failed']} failed  {told(times)}", flush=True
            )
            yield {**row, **times}


def posed_photos(name: str, options: argparse.Namespace) -> Iterator[Photo]:
    """Each photo with the points that two others have of its matches, to within `AGREE_PX` of their pixels."""
    image_set = SETS[name]
    if image_set.read_truth is None:
        raise SystemExit(f"{name} has no true poses")
    truth = image_set.read_truth(options.data / image_set.truth)
    features = [features_of(options.data / image_set.images / image) for image in truth.image_names]
    searchable, count = [SearchableFeatures(f) for f in features], len(features)
    matches = {
        (i, j): match_features(searchable[i], searchable[j]).indices for i, j in itertools.combinations(range(count), 2)
    }
    for k in range(count):
        pixels, points = [], []
        taken: set[int] = set()
        others = [i for i in range(count) if i != k]
        for i, j in itertools.combinations(others, 2):
            seen = positions(truth, features, i, j, matches[i, j])
            rows = matches[min(i, k), max(i, k)][:, :: 1 if k < i else -1].tolist()
            fresh = [(row, seen[other]) for row, other in rows if other in seen and row not in taken]
            taken.update(row for row, _ in fresh)
            pixels += [features[k].points2D[row] for row, _ in fresh]
            points += [point for _, point in fresh]
        if len(pixels) >= MIN_AGREEING:
            camera = truth.cameras[int(truth.image_camera_ids[k])]
            yield Photo(np.array(pixels), np.array(points), camera, truth.cams_from_world[k])


def positions(
    truth: Reconstruction, features: Sequence[Any], i: int, j: int, rows: np.ndarray
) -> dict[int, np.ndarray]:
    """The points of the world of matches of two photos that project near both pixels, by the row in the first photo."""
    cameras = [truth.cameras[int(truth.image_camera_ids[k])] for k in (i, j)]
    pixels = [features[k].points2D[rows[:, n]] for n, k in enumerate((i, j))]
    along = [camera.unproject(p)[0] for camera, p in zip(cameras, pixels, strict=True)]
    in_first, good = triangulate_midpoint(relative_pose(truth, i, j), along[0], along[1])
    points = truth.cams_from_world[i].inverse() @ in_first
    for camera, k, p in zip(cameras, (i, j), pixels, strict=True):
        projected, valid = camera.project(truth.cams_from_world[k] @ points)
        good = good & valid & (np.hypot(*(projected - p).T) < AGREE_PX)
    return dict(zip(rows[good, 0].tolist(), points[good], strict=True))


def made_up(camera: Camera, outliers: float, seed: int) -> Photo:
    rng = np.random.default_rng(seed)
    pose = Rigid3(Rotation3.exp(rng.normal(size=3)), rng.normal(size=3) * 3)
    points = pose.inverse() @ (rng.uniform(-1, 1, (300, 3)) * [2.5, 2, 1.5] + [0, 0, 5])
    pixels = camera.project(pose @ points)[0] + rng.normal(size=(300, 2))
    wrong = rng.permutation(300)[: int(300 * outliers)]
    pixels[wrong] = rng.uniform(0, 1, (len(wrong), 2)) * [1600, 1200]
    return Photo(pixels, points, camera, pose)


def resection_error(found: Pose | None, photo: Photo) -> float:
    """The larger of the angles, in degrees, of the rotation and of the shift of the centre seen from the points."""
    if found is None:
        return float("inf")
    R, t = found
    true = photo.cam_from_world
    turn = np.linalg.norm(cv2.Rodrigues(R @ true.rotation.matrix.T)[0])
    depth = np.median((true @ photo.points3D)[:, 2])
    shift = np.linalg.norm(-R.T @ t.ravel() - np.asarray(true.center))
    return float(np.rad2deg(max(turn, np.arctan2(shift, depth))))


def resection_estimators(score: Any) -> dict[str, Callable[[Photo], Pose | None]]:
    def ours(photo: Photo) -> Pose | None:
        config, rng = RansacConfig(max_error_px=4.0, score=score), np.random.default_rng(0)
        found = estimate_absolute_pose(photo.points2D, photo.points3D, photo.camera, config, rng=rng)
        if isinstance(found, Rejected):
            return None
        return found.cam_from_world.rotation.matrix, np.asarray(found.cam_from_world.translation)

    def theirs(photo: Photo) -> Pose | None:
        poselib, c = importlib.import_module("poselib"), photo.camera
        described = {"model": c.model, "width": c.width, "height": c.height, "params": c.params.tolist()}
        options = {"max_reproj_error": 4.0, "min_iterations": 100, "max_iterations": 10000}
        pose, _ = poselib.estimate_absolute_pose(photo.points2D, photo.points3D, described, options, {})
        return pose.R, pose.t

    def usac(photo: Photo, method: int) -> Pose | None:
        cv2.setRNGSeed(0)
        good, turn, shift, _ = cv2.solvePnPRansac(
            *(photo.points3D, photo.points2D, photo.camera.calibration_matrix, None),
            flags=method,
            reprojectionError=4.0,
            iterationsCount=10000,
            confidence=0.9999,
        )
        return (cv2.Rodrigues(turn)[0], shift) if good else None

    peers = {"PoseLib": theirs} if importlib.util.find_spec("poselib") else {}
    return {"Parallax": ours, **peers, "OpenCV RANSAC (P3P)": functools.partial(usac, method=cv2.SOLVEPNP_P3P)}


if __name__ == "__main__":
    sys.exit(main())
