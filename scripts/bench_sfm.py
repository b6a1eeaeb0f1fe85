"""Parallax beside pycolmap on real photos with known poses: quality, and the time of each stage.

    python -m scripts.bench_sfm DATA [--sets fountain-P11 ...] [--json FILE] [--threads 2] [--repeat 1]

DATA is a folder with the image sets (see SETS). Both sides get the same images and threads, one after the other in
the same run, at their defaults (`default`), and where the truth has intrinsics also with these given and held
(`given`). The best total time of `--repeat` runs counts; the figures of quality are those of the last run.

Scores come from `sfm.evaluation` for both sides; points, track length and reprojection error from pycolmap's reader,
for both sides. With several models, the one with most images is scored; `reg` counts images over all models.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from datasets.benchmarks import read_bundler, read_imc, read_kitti, read_middlebury, read_strecha
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Reconstruction, Tracks
from sfm.evaluation import compare_models

ROOT = Path(__file__).resolve().parents[1]
SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}


@dataclasses.dataclass(frozen=True)
class ImageSet:
    """Where a set's images lie below DATA, and how its truth is read (None: it has none)."""

    images: str
    read_truth: Callable[[Path], Reconstruction] | None = None
    truth: str = ""
    unit: str = "m"
    per_image_cameras: bool = False


TURNED_TEMPLES = tuple(f"templeR{number:04}.png" for number in range(32, 48))
"""Images that this copy of templeRing holds the other way up than its calibration says."""

SETS = {
    "fountain-P11": ImageSet("fountain-P11/images", read_strecha, "fountain-P11"),
    "Herz-Jesus-P8": ImageSet("Herz-Jesus-P8/images", read_strecha, "Herz-Jesus-P8"),
    "SceauxCastle": ImageSet("SceauxCastle/images"),
    "middlebury_templeRing": ImageSet(
        "middlebury_templeRing",
        functools.partial(read_middlebury, turned=TURNED_TEMPLES),
        "middlebury_templeRing/templeR_par.txt",
    ),
    "imc_sacre_coeur10": ImageSet(
        "imc_sacre_coeur10/mapping", read_imc, "imc_sacre_coeur10/ground_truth", unit="-", per_image_cameras=True
    ),
    "lund": ImageSet("lund/images"),
    "kermit": ImageSet("bundler_kermit", read_bundler, "bundler_kermit/results.example/bundle.out", unit="-"),
    "kitti": ImageSet(
        "kitti_odometry_clips/KITTI_sequence_1/image_l", read_kitti, "kitti_odometry_clips/KITTI_sequence_1"
    ),
}
DEFAULT_SETS = ("fountain-P11", "Herz-Jesus-P8", "SceauxCastle", "middlebury_templeRing", "imc_sacre_coeur10")
GIVEN_KINDS = ("PINHOLE",)
"""Truth whose cameras are all of these models is good enough to hold them fixed."""


def main() -> int:
    options = parse_options()
    sides = [side for side, skip in (("ours", options.only_peer), ("pycolmap", options.only_ours)) if not skip]
    report: dict[str, Any] = {"environment": environment(options.threads), "results": []}
    for name in options.sets:
        for row in bench_set(name, options, sides):
            report["results"].append(row)
            if options.json:
                options.json.write_text(json.dumps(report, indent=1))
    print_table(report["results"])
    print_verdict(report["results"])
    return 0


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of the image sets")
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(DEFAULT_SETS))
    parser.add_argument("--modes", nargs="+", choices=("default", "given"), default=["default", "given"])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write every figure to this file")
    parser.add_argument("--only-peer", action="store_true", help="run pycolmap only")
    parser.add_argument("--only-ours", action="store_true", help="run Parallax only")
    parser.add_argument("--reference-cache", type=Path, help="keep pycolmap's features here between runs")
    parser.add_argument("--keep", type=Path, help="keep the workspaces and models below this folder")
    parser.add_argument("--args", default="", help="further arguments for `sfm run`, in one string")
    return parser.parse_args()


def environment(threads: int) -> dict[str, Any]:
    return {
        "pycolmap": pycolmap.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": threads,
    }


def bench_set(name: str, options: argparse.Namespace, sides: list[str]) -> Iterator[dict[str, Any]]:
    """One row for each mode and side."""
    image_set = SETS[name]
    images = options.data / image_set.images
    if not images.is_dir():
        print(f"{name}: no folder {images}, skipped", file=sys.stderr)
        return
    truth = image_set.read_truth(options.data / image_set.truth) if image_set.read_truth else None
    has_intrinsics = truth is not None and all(camera.model in GIVEN_KINDS for camera in truth.cameras.values())
    for mode in options.modes:
        if mode == "given" and not has_intrinsics:
            continue
        for side in sides:
            runs = [run_side(side, name, mode, images, truth, options) for _ in range(options.repeat)]
            times = min((run["seconds"] for run in runs), key=lambda seconds: seconds["total"])
            row = {"set": name, "mode": mode, "side": side, "unit": image_set.unit, **runs[-1], "seconds": times}
            row["total_seconds_of_runs"] = [run["seconds"]["total"] for run in runs]
            print(one_line(row), file=sys.stderr, flush=True)
            yield row


def run_side(
    side: str, name: str, mode: str, images: Path, truth: Reconstruction | None, options: argparse.Namespace
) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="bench_sfm_") as scratch:
        work = Path(scratch)
        if options.keep:
            work = options.keep / f"{name}-{mode}-{side}"
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
        given = truth if mode == "given" else None
        run = run_pycolmap if side == "pycolmap" else run_ours
        seconds, sparse = run(name, images, work, given, options)
        return {"seconds": seconds, **score(sparse, image_names(images), truth)}


def image_names(images: Path) -> list[str]:
    return sorted(path.name for path in images.iterdir() if path.suffix.lower() in SUFFIXES)


# --- the two sides -------------------------------------------------------------------------------------------------


def run_ours(
    name: str, images: Path, work: Path, given: Reconstruction | None, options: argparse.Namespace
) -> tuple[dict[str, float], Path]:
    """`sfm run` as a user calls it; stage times from its manifest."""
    workspace = work / "workspace"
    command = [sys.executable, "-m", "sfm", "run", str(images), "-o", str(workspace), "--threads", str(options.threads)]
    command += options.args.split()
    if given is not None:
        cameras = work / "cameras.txt"
        write_cameras(cameras, given)
        command += ["--intrinsics", str(cameras)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    start = time.perf_counter()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    total = time.perf_counter() - start
    if done.returncode != 0:
        print(f"{name}: sfm run returned {done.returncode}\n{done.stderr[-3000:]}", file=sys.stderr)
    return {**manifest_seconds(workspace / "manifest.json"), "total": total}, workspace / "sparse"


def manifest_seconds(path: Path) -> dict[str, float]:
    """Seconds by stage."""
    if not path.is_file():
        return {}
    return {stage: float(entry["time_s"]) for stage, entry in json.loads(path.read_text())["stages"].items()}


def write_cameras(path: Path, truth: Reconstruction) -> None:
    """A COLMAP cameras.txt: one camera shared by all, or one an image in the order of the image names."""
    ids = dict(zip(truth.image_names, truth.image_camera_ids.tolist(), strict=True))
    cameras = list(truth.cameras.values()) if len(truth.cameras) == 1 else [truth.cameras[ids[n]] for n in sorted(ids)]
    lines = [
        f"{row} {camera.model} {camera.width} {camera.height} {' '.join(f'{p:.17g}' for p in camera.params)}"
        for row, camera in enumerate(cameras, start=1)
    ]
    path.write_text("\n".join(["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", *lines, ""]))


def run_pycolmap(
    name: str, images: Path, work: Path, given: Reconstruction | None, options: argparse.Namespace
) -> tuple[dict[str, float], Path]:
    """Extraction, exhaustive matching and the incremental mapper at pycolmap's defaults."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR.value)
    database, sparse, seconds = work / "database.db", work / "sparse", {}
    sparse.mkdir()
    one_each = SETS[name].per_image_cameras or (given is not None and len(given.cameras) > 1)
    seconds["features"] = extract_with_pycolmap(name, images, database, one_each, options)
    if given is not None:
        set_cameras(database, given)

    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = options.threads, False
    start = time.perf_counter()
    pycolmap.match_exhaustive(database, matching_options=matching)
    seconds["matching"] = time.perf_counter() - start

    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads = options.threads
    if given is not None:
        mapping.ba_refine_focal_length = False
        mapping.ba_refine_principal_point = False
        mapping.ba_refine_extra_params = False
    start = time.perf_counter()
    pycolmap.incremental_mapping(database, images, sparse, mapping)
    seconds["mapping"] = time.perf_counter() - start
    return {**seconds, "total": sum(seconds.values())}, sparse


def extract_with_pycolmap(
    name: str, images: Path, database: Path, camera_per_image: bool, options: argparse.Namespace
) -> float:
    """Fills the database; the seconds that it took, now or when the cached features were made."""
    mode = pycolmap.CameraMode.PER_IMAGE if camera_per_image else pycolmap.CameraMode.AUTO
    cached = options.reference_cache / f"{name}-{mode.name}-{options.threads}.db" if options.reference_cache else None
    if cached is not None and cached.is_file():
        shutil.copy(cached, database)
        return float(cached.with_suffix(".seconds").read_text())
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu = options.threads, False
    start = time.perf_counter()
    pycolmap.extract_features(
        database, images, image_names=image_names(images), camera_mode=mode, extraction_options=extraction
    )
    seconds = time.perf_counter() - start
    if cached is not None:
        cached.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(database, cached)
        cached.with_suffix(".seconds").write_text(str(seconds))
    return seconds


def set_cameras(database: Path, truth: Reconstruction) -> None:
    """Gives every image of the database its true camera, as trusted."""
    rows = {name: row for row, name in enumerate(truth.image_names)}
    with pycolmap.Database.open(database) as store:
        seen: dict[int, int] = {}
        for image in store.read_all_images():
            true_id = int(truth.image_camera_ids[rows[image.name]])
            if seen.setdefault(image.camera_id, true_id) != true_id:
                raise RuntimeError(f"{image.name} shares a camera that it must not share")
            camera = store.read_camera(image.camera_id)
            true_camera = truth.cameras[true_id]
            camera.model = getattr(pycolmap.CameraModelId, true_camera.model)
            camera.params = true_camera.params.tolist()
            camera.has_prior_focal_length = True
            store.update_camera(camera)


# --- scores --------------------------------------------------------------------------------------------------------


def score(sparse: Path, names: list[str], truth: Reconstruction | None) -> dict[str, Any]:
    """Figures of the models below `sparse`."""
    folders = [path for path in sorted(sparse.glob("*")) if path.is_dir()] if sparse.is_dir() else []
    models = sorted((pycolmap.Reconstruction(path) for path in folders), key=lambda m: -m.num_reg_images())
    registered = {image.name for model in models for image in model.images.values() if image.has_pose}
    figures: dict[str, Any] = {
        "images": len(names),
        "registered": len(registered),
        "models": [model.num_reg_images() for model in models],
    }
    if not models:
        return figures
    best = models[0]
    figures |= {
        "cameras": best.num_cameras(),
        "points": best.num_points3D(),
        "track_length": best.compute_mean_track_length(),
        "reprojection_px": best.compute_mean_reprojection_error(),
    }
    if truth is not None:
        figures["comparison"] = compare_models(poses_of(best), truth).to_json()
    return figures


def poses_of(model: pycolmap.Reconstruction) -> Reconstruction:
    """Names, cameras and poses of a pycolmap model; its points do not matter here."""
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.image_id)
    poses = [image.cam_from_world() for image in images]
    xyzw = np.array([pose.rotation.quat for pose in poses]).reshape(-1, 4)
    count = len(images)
    return Reconstruction(
        cameras={i: Camera(c.model.name, c.width, c.height, c.params) for i, c in model.cameras.items()},
        image_ids=np.array([image.image_id for image in images], dtype=np.int32),
        image_names=tuple(image.name for image in images),
        image_camera_ids=np.array([image.camera_id for image in images], dtype=np.int32),
        cams_from_world=Rigid3(
            Rotation3(xyzw[:, [3, 0, 1, 2]]), np.array([pose.translation for pose in poses]).reshape(-1, 3)
        ),
        keypoint_offsets=np.zeros(count + 1, dtype=np.int64),
        keypoints=np.zeros((0, 2)),
        points3D=np.zeros((0, 3)),
        point_ids=np.zeros(0, dtype=np.int64),
        colors=np.zeros((0, 3), dtype=np.uint8),
        errors=np.zeros(0),
        tracks=Tracks.empty(),
    )


# --- what a person reads -------------------------------------------------------------------------------------------


HEADER = (
    f"{'set':22} {'mode':8} {'side':9} {'reg':>7} {'models':>9} {'points':>7} {'track':>5} {'reproj':>6} "
    f"{'AUC@1':>6} {'AUC@3':>6} {'AUC@5':>6} {'pos med':>9} {'rot med':>8} {'total':>7}  stages (s)"
)


def one_line(row: dict[str, Any]) -> str:
    auc, position, rotation = dict.fromkeys(("1", "3", "5")), None, None
    if "comparison" in row:
        auc = row["comparison"]["relative_pose"]["auc_deg"]
        position = row["comparison"]["position_error"]["median"]
        rotation = row["comparison"]["rotation_error_deg"]["median"]
    stages = " ".join(f"{stage} {value:.1f}" for stage, value in row["seconds"].items() if stage != "total")
    return (
        f"{row['set']:22} {row['mode']:8} {row['side']:9} {row['registered']:3}/{row['images']:<3} "
        f"{'+'.join(map(str, row['models'])) or '-':>9} {cell(row.get('points'), '7d')} "
        f"{cell(row.get('track_length'), '5.2f')} {cell(row.get('reprojection_px'), '6.3f')} "
        f"{percent(auc['1'])} {percent(auc['3'])} {percent(auc['5'])} {cell(position, '7.4f')} {row['unit']} "
        f"{cell(rotation, '7.3f')}° {row['seconds']['total']:7.1f}  {stages}"
    )


def cell(value: float | None, form: str) -> str:
    return format(value, form) if value is not None else "-".rjust(int(form.split(".")[0].rstrip("d")))


def percent(share: float | None) -> str:
    return cell(None if share is None else 100 * share, "6.2f")


def print_table(rows: list[dict[str, Any]]) -> None:
    print(HEADER)
    for row in rows:
        print(one_line(row))


def print_verdict(rows: list[dict[str, Any]]) -> None:
    """At least as many images; with given intrinsics AUC@1° within a point and position within 10 % of the peer's."""
    for ours in (row for row in rows if row["side"] == "ours"):
        peers = [r for r in rows if r["side"] == "pycolmap" and (r["set"], r["mode"]) == (ours["set"], ours["mode"])]
        for peer in peers:
            misses = shortcomings(ours, peer)
            ratio = ours["seconds"]["total"] / peer["seconds"]["total"]
            verdict = "ok" if not misses else "MISSED: " + "; ".join(misses)
            print(f"{ours['set']:22} {ours['mode']:8} {verdict} (time {ratio:.2f} x pycolmap's)")


def shortcomings(ours: dict[str, Any], peer: dict[str, Any]) -> list[str]:
    misses = []
    if max(ours["models"], default=0) < max(peer["models"], default=0):
        misses.append(f"{max(ours['models'], default=0)} images in the largest model, {max(peer['models'])} there")
    if ours["registered"] < peer["registered"]:
        misses.append(f"{ours['registered']} images registered, {peer['registered']} there")
    if ours["mode"] == "given" and "comparison" in peer and "comparison" in ours:
        mine, theirs = (row["comparison"]["relative_pose"]["auc_deg"]["1"] for row in (ours, peer))
        if mine < theirs - 0.01:
            misses.append(f"AUC@1° {100 * mine:.1f}, {100 * theirs:.1f} there")
        mine, theirs = (row["comparison"]["position_error"]["median"] for row in (ours, peer))
        if mine is None or mine > 1.1 * theirs:
            misses.append(f"median position error {mine}, {theirs} there")
    return misses


if __name__ == "__main__":
    sys.exit(main())
