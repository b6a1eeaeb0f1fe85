"""Our bundle adjustment against Ceres, which pycolmap runs on the same problem in the same process.

    scripts/bench_bundle.py [BAL_FILE ...] [--synthetic 20x5000 100x20000x10 ...] [--repeats 3] [--threads 2] [--json]

A synthetic size is IMAGESxPOINTS or IMAGESxPOINTSxTRACK_LENGTH. Both sides start from the same numbers, free the same
parameters (poses, points, focal lengths and distortion; only poses and points with --fix-intrinsics), minimise the
same loss and stop at the same relative decrease of the cost. Ceres' final cost is computed by our code. The time of
each side is that of the one call a user makes; ratios are medians over the repeats, the sides taking turns.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import pycolmap

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from sfm.bundle import BundleConfig, BundleProblem, BundleResult, adjust
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

LOSSES = {
    "trivial": pycolmap.LossFunctionType.TRIVIAL,
    "soft_l1": pycolmap.LossFunctionType.SOFT_L1,
    "cauchy": pycolmap.LossFunctionType.CAUCHY,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """One problem, both sides."""

    name: str
    images: int
    points: int
    observations: int
    invalid: int
    initial_cost: float
    our_cost: float
    their_cost: float
    our_iterations: int
    our_reason: str
    our_seconds: float
    their_seconds: float
    ratio: float

    def __str__(self) -> str:
        return (
            f"{self.name:28} {self.images:5} {self.points:7} {self.observations:8}  {self.our_cost:14.6e} "
            f"{self.our_cost / self.their_cost - 1:+9.1e}  {self.our_seconds:8.3f} s {self.their_seconds:8.3f} s "
            f"{self.ratio:6.2f}x  ({self.our_iterations} steps, {self.our_reason}, {self.invalid} invalid)"
        )


def read_bal(path: Path) -> pycolmap.Reconstruction:
    """A problem of Bundle Adjustment in the Large, whose cameras look along −z with y up, as RADIAL cameras."""
    numbers = np.array(path.read_text().split(), float)
    images, _, observations = numbers[:3].astype(int)
    table = numbers[3 : 3 + 4 * observations].reshape(-1, 4)
    rest = numbers[3 + 4 * observations :]
    cameras, points3D = rest[: 9 * images].reshape(-1, 9), rest[9 * images :].reshape(-1, 3)
    flip = Rotation3(np.array([0.0, 1.0, 0.0, 0.0]))
    reconstruction = pycolmap.Reconstruction()
    features = [np.flatnonzero(table[:, 0] == k) for k in range(images)]
    position = np.empty(observations, int)
    for k, (rows, (rx, ry, rz, tx, ty, tz, f, k1, k2)) in enumerate(zip(features, cameras, strict=True)):
        position[rows] = np.arange(len(rows))
        pose = Rigid3(flip @ Rotation3.exp(np.array([rx, ry, rz])), flip @ np.array([tx, ty, tz]))
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera(model="RADIAL", width=2000, height=2000, params=[f, 0, 0, k1, k2], camera_id=k + 1)
        )
        keypoints = table[rows, 2:] * [1.0, -1.0]
        reconstruction.add_image_with_trivial_frame(
            pycolmap.Image(name=f"{k}.jpg", points2D=pycolmap.Point2DList(list(map(pycolmap.Point2D, keypoints))),
                           camera_id=k + 1, image_id=k + 1),
            pycolmap.Rigid3d(pose.matrix),
        )  # fmt: skip
    by_point = np.split(np.argsort(table[:, 1], kind="stable"), np.cumsum(np.bincount(table[:, 1].astype(int)))[:-1])
    for xyz, rows in zip(points3D, by_point, strict=True):
        elements = [pycolmap.TrackElement(int(table[o, 0]) + 1, int(position[o])) for o in rows]
        reconstruction.add_point3D(xyz, pycolmap.Track(elements))
    return reconstruction


def synthesize(images: int, points: int, track_length: int = -1) -> pycolmap.Reconstruction:
    """One shared SIMPLE_RADIAL camera, 0.5 px noise, poses and points displaced."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig = 1, images
    options.num_points3D, options.track_length = points, track_length
    options.num_points2D_without_point3D = 0
    reconstruction = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev = 0.5, 0.02
    noise.rig_from_world_translation_stddev, noise.rig_from_world_rotation_stddev = 0.02, 0.3
    pycolmap.synthesize_noise(noise, reconstruction)
    return reconstruction


def problem_of(reconstruction: pycolmap.Reconstruction, refine: bool) -> BundleProblem:
    """The same numbers for our side."""
    cameras, images = sorted(reconstruction.cameras), sorted(reconstruction.reg_image_ids())
    params, free = np.zeros((len(cameras), 12)), np.zeros((len(cameras), 12), bool)
    for row, camera_id in enumerate(cameras):
        camera = reconstruction.cameras[camera_id]
        params[row, : len(camera.params)] = camera.params
        free[row, [*camera.focal_length_idxs(), *camera.extra_params_idxs()]] = refine
    poses = [reconstruction.images[k].cam_from_world() for k in images]
    keypoints = {k: np.array([p.xy for p in reconstruction.images[k].points2D]) for k in images}
    row_of = {k: row for row, k in enumerate(images)}
    points3D, columns = [], []
    for row, k in enumerate(sorted(reconstruction.points3D)):
        point = reconstruction.points3D[k]
        points3D.append(point.xyz)
        columns += [(row_of[e.image_id], row, *keypoints[e.image_id][e.point2D_idx]) for e in point.track.elements]
    table = np.array(columns)
    return BundleProblem(
        model_ids=np.array([int(reconstruction.cameras[k].model) for k in cameras], np.int32),
        camera_params=params,
        image_cameras=np.searchsorted(cameras, [reconstruction.images[k].camera_id for k in images]).astype(np.int32),
        cams_from_world=Rigid3(
            Rotation3(np.array([p.rotation.quat for p in poses])[:, [3, 0, 1, 2]]),
            np.array([p.translation for p in poses]),
        ),
        points3D=np.array(points3D),
        obs_images=table[:, 0].astype(np.int32),
        obs_points=table[:, 1].astype(np.int32),
        obs_points2D=np.ascontiguousarray(table[:, 2:]),
        free_params=free,
        free_poses=np.ones(len(images), bool),
        free_points=np.ones(len(points3D), bool),
    )


def ceres_options(args: argparse.Namespace) -> pycolmap.BundleAdjustmentOptions:
    """What makes Ceres do the same."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = not args.fix_intrinsics
    options.ceres.loss_function_type, options.ceres.loss_function_scale = LOSSES[args.loss], args.loss_scale
    solver = options.ceres.solver_options
    solver.function_tolerance, solver.max_num_iterations = args.tolerance, args.max_iterations
    solver.num_threads = args.threads
    return options


def race(
    problem: BundleProblem, config: BundleConfig, start: pycolmap.Reconstruction,
    options: pycolmap.BundleAdjustmentOptions, threads: int,
) -> tuple[BundleResult, pycolmap.Reconstruction, float, float]:  # fmt: skip
    """Both sides once: our result, their model, and the seconds of each."""
    began = time.perf_counter()
    result = adjust(problem, config, threads=threads)
    ours = time.perf_counter() - began
    reconstruction = pycolmap.Reconstruction(start)
    began = time.perf_counter()
    pycolmap.bundle_adjustment(reconstruction, options)
    return result, reconstruction, ours, time.perf_counter() - began


def compare(name: str, start: pycolmap.Reconstruction, args: argparse.Namespace) -> Row:
    """Runs both sides `args.repeats` times in turns."""
    config = BundleConfig(
        loss=args.loss, loss_scale_px=args.loss_scale,
        relative_cost_tolerance=args.tolerance, max_iterations=args.max_iterations,
    )  # fmt: skip
    problem, options = problem_of(start, not args.fix_intrinsics), ceres_options(args)
    runs = [race(problem, config, start, options, args.threads) for _ in range(max(args.repeats, 1))]
    result, reconstruction, _, _ = runs[-1]
    their_problem = problem_of(reconstruction, not args.fix_intrinsics)
    their_result = adjust(their_problem, dataclasses.replace(config, max_iterations=0))
    return Row(
        name=name,
        images=len(problem.free_poses),
        points=len(problem.free_points),
        observations=len(problem.obs_images),
        invalid=result.invalid,
        initial_cost=result.initial_cost,
        our_cost=result.final_cost,
        their_cost=their_result.final_cost,
        our_iterations=result.iterations,
        our_reason=result.reason,
        our_seconds=statistics.median(ours for _, _, ours, _ in runs),
        their_seconds=statistics.median(theirs for _, _, _, theirs in runs),
        ratio=statistics.median(theirs / ours for _, _, ours, theirs in runs),
    )


def main() -> None:
    """Prints a row for each problem, or all rows as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bal", nargs="*", type=Path)
    parser.add_argument("--synthetic", nargs="*", default=["6x350", "20x5000", "100x20000x10"])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--tolerance", type=float, default=1e-8)
    parser.add_argument("--max-iterations", type=int, default=100)
    parser.add_argument("--loss", choices=list(LOSSES), default="trivial")
    parser.add_argument("--loss-scale", type=float, default=1.0)
    parser.add_argument("--fix-intrinsics", action="store_true")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value

    warm_up = synthesize(3, 40)
    for refine in (True, False):
        adjust(problem_of(warm_up, refine), threads=args.threads)
    rows = []
    problems = [(str(path.name), lambda path=path: read_bal(path)) for path in args.bal]
    problems += [(size, lambda size=size: synthesize(*map(int, size.split("x")))) for size in args.synthetic]
    if not args.json:
        head = ("problem", "img", "points", "obs", "our cost", "rel.", "ours", "Ceres")
        print("{:28} {:>5} {:>7} {:>8}  {:>14} {:>9}  {:>10} {:>10}".format(*head))
    for name, make in problems:
        rows.append(compare(name, make(), args))
        if not args.json:
            print(rows[-1], flush=True)
    if args.json:
        print(json.dumps([dataclasses.asdict(row) for row in rows], indent=2))


if __name__ == "__main__":
    main()
