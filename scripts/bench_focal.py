"""Poses with an unknown focal length beside PoseLib and pycolmap: accuracy, and the time of one problem on one thread.

    python -m scripts.bench_focal made_up [--json FILE]
    python -m scripts.bench_focal pairs DATA/sfm [--sets fountain-P11 Herz-Jesus-P8] [--json FILE]
    python -m scripts.bench_focal photos DATA/sfm [--sets fountain-P11 Herz-Jesus-P8] [--json FILE]

`made_up` are two views of random points, for relative poses, and one view of points of known position, for absolute
poses, of several focal lengths among wrong data. `pairs` gives all estimators the same matches, ours, of pairs with at
least 30 that agree with the true pose; `photos` resects each photo from points that our matches of two others and their
true poses give. No estimator is told the focal length but those called `known`.

Errors of poses are the larger of the angles of rotation and translation, or of the rotation alone for absolute poses;
errors of focal lengths are relative. PoseLib is left out where it is not installed (`pip install poselib`): it has the
shared focal length only. pycolmap has the absolute pose.
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

import numpy as np
import pycolmap

from scripts.bench_pairs import features_of
from scripts.bench_robust import Pair, pose_error_deg, true_pairs
from scripts.bench_sfm import SETS, environment
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.triangulation import triangulate_midpoint
from sfm.core.robust import (
    RansacConfig,
    estimate_absolute_pose,
    estimate_absolute_pose_with_focal,
    estimate_relative_pose,
    estimate_relative_pose_one_focal,
    estimate_relative_pose_shared_focal,
)
from sfm.evaluation.accuracy import area_under_recall
from sfm.matching import SearchableFeatures, match_features

GUESS = 1.2
"""Of the longer side: what is taken for a focal length of which nothing is known."""
RELATIVE_PX, ABSOLUTE_PX = 1.5, 6.0
LIMITS = {"min_iterations": 100, "max_iterations": 10000}
Found = tuple[Rigid3, float] | None
Estimator = Callable[[Any], Found]


@dataclasses.dataclass(frozen=True)
class Photo:
    """Pixels of one photo with the points that they show, its camera and its true pose."""

    points2D: np.ndarray
    points3D: np.ndarray
    camera: Camera
    cam_from_world: Rigid3


def main() -> int:
    options = parse_options()
    rows = list({"made_up": made_up, "pairs": pairs, "photos": photos}[options.part](options))
    if options.json:
        report = {"part": options.part, "environment": environment(1), "results": rows}
        options.json.write_text(json.dumps(report, indent=1))
    return 0


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("made_up", "pairs", "photos"))
    parser.add_argument("data", type=Path, nargs="?", default=Path(), help="folder of the sets")
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=["fountain-P11", "Herz-Jesus-P8"])
    parser.add_argument("--json", type=Path, help="write every figure to this file")
    return parser.parse_args()


def judged(
    label: str, estimators: dict[str, Estimator], problems: Sequence[Any], focal: Callable[[Any], float], error: Any
) -> Iterator[dict[str, Any]]:
    """One row for each estimator: `focal` and `error` take a problem, and `error` what was found too."""
    for name, estimate in estimators.items():
        estimate(problems[0])  # compiles
        found, seconds = [], []
        for problem in problems:
            start = time.thread_time()
            found.append(estimate(problem))
            seconds.append(time.thread_time() - start)
        angles = np.array([error(one, problem) for one, problem in zip(found, problems, strict=True)])
        focals = np.array(
            [np.inf if one is None else abs(one[1] / focal(p) - 1) for one, p in zip(found, problems, strict=True)]
        )
        row = {
            "problems": label,
            "estimator": name,
            "count": len(problems),
            "median_deg": float(np.median(angles)),
            "auc": [100 * value for value in area_under_recall(angles)],
            "median_focal_error": float(np.median(focals)),
            "focal_within_10_percent": float(np.mean(focals < 0.1)),
            "mean_ms": 1e3 * float(np.mean(seconds)),
            "median_ms": 1e3 * float(np.median(seconds)),
        }
        auc = " ".join(f"{value:5.1f}" for value in row["auc"][1:4])
        focals_told = (
            f"{100 * row['median_focal_error']:.2f} % off, {100 * row['focal_within_10_percent']:3.0f} % within 10"
        )
        print(
            f"{label:28} {name:16} {1e3 * row['median_deg']:4.0f} mdeg, AUC@1/3/5 {auc}, f {focals_told}"
            f"  mean {row['mean_ms']:.2f} ms median {row['median_ms']:.2f} ms",
            flush=True,
        )
        yield row


def guessed(camera: Camera) -> Camera:
    """The camera as if nothing were known of its focal length."""
    params = camera.params.copy()
    params[list(camera.model_info.focal_indices)] *= GUESS * max(camera.width, camera.height) / camera.mean_focal_length
    return dataclasses.replace(camera, params=params)


# --- relative pose -------------------------------------------------------------------------------------------------


def relative_error(found: Found, pair: Pair) -> float:
    pose = None if found is None else (found[0].rotation.matrix, np.asarray(found[0].translation))
    return pose_error_deg(pose, pair.cam2_from_cam1)


def relative_estimators() -> dict[str, Estimator]:
    config = RansacConfig(max_error_px=RELATIVE_PX)

    def shared(pair: Pair) -> Found:
        found = estimate_relative_pose_shared_focal(
            pair.points1, pair.points2, guessed(pair.camera1), config, rng=np.random.default_rng(0)
        )
        return None if isinstance(found, Rejected) else (found.cam2_from_cam1, found.camera1.mean_focal_length)

    def one_sided(pair: Pair) -> Found:
        found = estimate_relative_pose_one_focal(
            pair.points1, pair.points2, guessed(pair.camera1), pair.camera2, config, rng=np.random.default_rng(0)
        )
        return None if isinstance(found, Rejected) else (found.cam2_from_cam1, found.camera1.mean_focal_length)

    def known(pair: Pair) -> Found:
        found = estimate_relative_pose(
            pair.points1, pair.points2, pair.camera1, pair.camera2, config, rng=np.random.default_rng(0)
        )
        return None if isinstance(found, Rejected) else (found.cam2_from_cam1, pair.camera1.mean_focal_length)

    chosen = {"shared": shared}
    if importlib.util.find_spec("poselib"):
        poselib = importlib.import_module("poselib")

        def theirs(pair: Pair) -> Found:
            options = {"max_epipolar_error": RELATIVE_PX, **LIMITS}
            center = np.array(pair.camera1.principal_point)
            found, _ = poselib.estimate_shared_focal_relative_pose(pair.points1, pair.points2, center, options, {})
            return Rigid3(Rotation3.from_matrix(found.pose.R), found.pose.t), found.camera1.focal()

        chosen["PoseLib shared"] = theirs
    return {**chosen, "one-sided": one_sided, "known": known}


def pairs(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each set and estimator."""
    for name in options.sets:
        found = list(true_pairs(name, options))
        yield from judged(
            f"{name}, {len(found)} pairs",
            relative_estimators(),
            found,
            lambda pair: pair.camera1.mean_focal_length,
            relative_error,
        )


# --- absolute pose -------------------------------------------------------------------------------------------------


def absolute_error(found: Found, photo: Photo) -> float:
    """The angle of the rotation in degrees."""
    if found is None:
        return float("inf")
    return float(np.rad2deg((found[0].rotation @ photo.cam_from_world.rotation.inverse()).angle))


def absolute_estimators() -> dict[str, Estimator]:
    config = RansacConfig(max_error_px=ABSOLUTE_PX)

    def by_p4pf(photo: Photo) -> Found:
        found = estimate_absolute_pose_with_focal(
            photo.points2D, photo.points3D, guessed(photo.camera), config, rng=np.random.default_rng(0)
        )
        return None if isinstance(found, Rejected) else (found.cam_from_world, found.camera.mean_focal_length)

    def by_p3p(photo: Photo, refine_focal: bool) -> Found:
        camera = guessed(photo.camera) if refine_focal else photo.camera
        found = estimate_absolute_pose(
            *(photo.points2D, photo.points3D, camera, config),
            rng=np.random.default_rng(0),
            refine_focal=refine_focal,
        )
        return None if isinstance(found, Rejected) else (found.cam_from_world, found.camera.mean_focal_length)

    def theirs(photo: Photo) -> Found:
        sampling, refinement = pycolmap.AbsolutePoseEstimationOptions(), pycolmap.AbsolutePoseRefinementOptions()
        sampling.estimate_focal_length = refinement.refine_focal_length = True
        sampling.ransac.max_error, sampling.ransac.random_seed = ABSOLUTE_PX, 0
        sampling.ransac.min_num_trials, sampling.ransac.max_num_trials = LIMITS.values()
        guess = guessed(photo.camera)
        camera = pycolmap.Camera(model=guess.model, width=guess.width, height=guess.height, params=guess.params)
        found = pycolmap.estimate_and_refine_absolute_pose(photo.points2D, photo.points3D, camera, sampling, refinement)
        if found is None:
            return None
        matrix = found["cam_from_world"].matrix()
        pose = Rigid3(Rotation3.from_matrix(matrix[:, :3]), matrix[:, 3])
        return pose, found.get("camera", camera).mean_focal_length()

    return {
        "P4Pf": by_p4pf,
        "nine guesses": functools.partial(by_p3p, refine_focal=True),
        "pycolmap": theirs,
        "known": functools.partial(by_p3p, refine_focal=False),
    }


def photos(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each set and estimator."""
    for name in options.sets:
        found = list(true_photos(name, options.data))
        yield from judged(
            f"{name}, {len(found)} photos",
            absolute_estimators(),
            found,
            lambda photo: photo.camera.mean_focal_length,
            absolute_error,
        )


def true_photos(name: str, data: Path) -> Iterator[Photo]:
    """Each photo with the points of the next two: their matches, triangulated, and matched to it, right or wrong."""
    image_set = SETS[name]
    if image_set.read_truth is None:
        raise SystemExit(f"{name} has no true poses")
    truth = image_set.read_truth(data / image_set.truth)
    features = [features_of(data / image_set.images / image) for image in truth.image_names]
    searchable = [SearchableFeatures(f) for f in features]
    count = len(features)
    for k in range(count):
        i, j = sorted((other for other in range(count) if other != k), key=lambda other: (abs(other - k), other))[:2]
        camera_i, camera_j, camera_k = (truth.cameras[int(truth.image_camera_ids[n])] for n in (i, j, k))
        linked = match_features(searchable[i], searchable[j]).indices
        rays_i, rays_j = (
            camera.unproject(features[n].points2D[linked[:, side]])[0]
            for side, (n, camera) in enumerate(((i, camera_i), (j, camera_j)))
        )
        poses = truth.cams_from_world
        in_i, front = triangulate_midpoint(poses[j] @ poses[i].inverse(), rays_i, rays_j)
        seen = camera_j.project((poses[j] @ poses[i].inverse()) @ in_i)[0]
        good = front & (np.linalg.norm(seen - features[j].points2D[linked[:, 1]], axis=1) < 2.0)
        point_of = dict(zip(linked[good, 0].tolist(), (poses[i].inverse() @ in_i[good]), strict=True))
        rows = [row for row in match_features(searchable[k], searchable[i]).indices.tolist() if row[1] in point_of]
        if len(rows) >= 30:
            points2D = features[k].points2D[[row[0] for row in rows]]
            yield Photo(points2D, np.array([point_of[row[1]] for row in rows]), camera_k, poses[k])


# --- made-up problems ----------------------------------------------------------------------------------------------


def made_up(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each share of wrong data, focal length and estimator: 60 problems, noise of 0.5 or 1 px."""
    for outliers, focal in itertools.product((0.3, 0.6), (1200.0, 2500.0)):
        views = [two_views(np.random.default_rng(seed), focal, outliers) for seed in range(60)]
        label = f"relative, {outliers:.0%} wrong, f {focal:.0f}"
        yield from judged(label, relative_estimators(), views, lambda p: p.camera1.mean_focal_length, relative_error)
    for outliers, thickness in itertools.product((0.3, 0.7), (1.5, 0.05)):
        seen = [one_view(np.random.default_rng(seed), thickness, outliers) for seed in range(60)]
        label = f"absolute, {outliers:.0%} wrong, " + ("solid" if thickness > 1 else "flat")
        yield from judged(label, absolute_estimators(), seen, lambda p: p.camera.mean_focal_length, absolute_error)


def pinhole(focal: float) -> Camera:
    return Camera("SIMPLE_PINHOLE", 1600, 1200, np.array([focal, 800.0, 600.0]))


def scattered(rng: np.random.Generator, pixels: np.ndarray, noise_px: float, outliers: float) -> np.ndarray:
    """The pixels with noise, of which a share is anywhere in the image."""
    moved = pixels + noise_px * rng.normal(size=pixels.shape)
    wrong = rng.permutation(len(pixels))[: int(outliers * len(pixels))]
    moved[wrong] = rng.uniform(0, 1, (len(wrong), 2)) * [1600, 1200]
    return moved


def two_views(rng: np.random.Generator, focal: float, outliers: float) -> Pair:
    """Two cameras that look at a box of 250 points, roughly at its middle."""
    points = rng.uniform(-1, 1, (250, 3)) * [1.6, 1.2, 1] + [0, 0, 4]
    turn = Rotation3.exp(rng.normal(size=3) * 0.3)
    pose = Rigid3(turn, rng.normal(size=3) * 0.2 + [0, 0, rng.uniform(3.5, 6)] - turn @ np.array([0, 0, 4.0]))
    camera = pinhole(focal)
    far = np.array([0, 0, 4 * (focal / 1600 - 1)])  # the box fills the image whatever the focal length
    first, second = camera.project(points + far)[0], camera.project(pose @ points + far)[0]
    pose = Rigid3(pose.rotation, pose.translation + far - pose.rotation @ far)
    return Pair(scattered(rng, first, 0.5, 0.0), scattered(rng, second, 0.5, outliers), camera, camera, pose)


def one_view(rng: np.random.Generator, thickness: float, outliers: float) -> Photo:
    """A camera before 200 points of a tilted slab."""
    tilt, turn = Rotation3.exp(np.append(rng.normal(size=2) * 0.5, 0.0)), Rotation3.exp(rng.normal(size=3))
    points = tilt @ (rng.uniform(-1, 1, (200, 3)) * [1.5, 1.2, thickness]) + np.array([0, 0, 5.0])
    pose, camera = Rigid3(turn, rng.normal(size=3) * 3), pinhole(rng.uniform(1000, 4000))
    return Photo(scattered(rng, camera.project(points)[0], 1.0, outliers), pose.inverse() @ points, camera, pose)


if __name__ == "__main__":
    sys.exit(main())
