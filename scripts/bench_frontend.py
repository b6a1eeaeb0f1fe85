"""Features, pairs, matches and two-view geometry beside pycolmap: the time, and what a mapper makes of them.

    python -m scripts.bench_frontend DATA [--sets fountain-P11 ...] [--max-image-size 1600] [--repeat 3] [--json FILE]

Both sides start from an empty database, ours through the stages of `sfm run`, pycolmap at its defaults (exhaustive
matching); with `--max-image-size` both reduce larger images to that size. A round runs one side after the other;
medians count. Then pycolmap's incremental mapper makes models of both databases, and so does ours, with the true
cameras where they are known, so that registered images and pose errors compare the front ends alone.

Robust estimators have a benchmark of their own (bench_robust), and so has the choice of pairs (bench_pairs).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from scripts.bench_sfm import SETS, environment, image_names, score, set_cameras
from sfm.core.events import SILENT, Event, Observer, StageFinished, StageStarted
from sfm.core.scene import Reconstruction
from sfm.io.colmap_model import write_model
from sfm.io.database import Database
from sfm.mapping import map_incrementally
from sfm.pipeline.config import DEFAULTS, with_settings
from sfm.pipeline.pairs import match_and_verify
from sfm.pipeline.scene import read_scene
from sfm.pipeline.stages import Run, extract_all
from sfm.pipeline.warm_up import run_parts
from sfm.viewgraph import calibrate_focal_lengths, cycle_consistency, poses_under, without_contradictions

STAGE_SETS = ("fountain-P11", "Herz-Jesus-P8", "SceauxCastle", "lund", "middlebury_templeRing")


def main() -> int:
    options = parse_options()
    if "OPENBLAS_NUM_THREADS" not in os.environ:  # as the command sets it, which must be before NumPy is loaded
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, [sys.executable, "-m", "scripts.bench_frontend", *sys.argv[1:]])
    cv2.setNumThreads(1)
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR.value)
    run_parts(["pair", "models", "features"])
    rows = list(results(options))
    if options.json:
        report = {"environment": environment(options.threads), "results": rows}
        options.json.write_text(json.dumps(report, indent=1))
    return 0


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of the image sets")
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=STAGE_SETS)
    parser.add_argument("--max-image-size", type=int, help="both sides; else each side's default")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--only-ours", action="store_true")
    parser.add_argument("--no-mapping", action="store_true", help="times only")
    parser.add_argument("--json", type=Path, help="write every figure to this file")
    return parser.parse_args()


def results(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each set: the median seconds of both sides, and the models from their databases."""
    for name in options.sets:
        images = options.data / SETS[name].images
        if not images.is_dir():
            print(f"{name}: no folder {images}, skipped", file=sys.stderr)
            continue
        sides = {"ours": our_seconds} if options.only_ours else {"ours": our_seconds, "pycolmap": their_seconds}
        row: dict[str, Any] = {"set": name, "max_image_size": options.max_image_size}
        truth = truth_of(name, options)
        one_each = truth is not None and len(truth.cameras) > 1
        with tempfile.TemporaryDirectory(prefix="bench_frontend_") as folder:
            rounds: dict[str, list[dict[str, float]]] = {side: [] for side in sides}
            for number in range(options.repeat):
                for side, run in sides.items():
                    (Path(folder) / side).mkdir(exist_ok=True)
                    database = Path(folder) / side / f"database{number}.db"
                    rounds[side].append(run(images, database, one_each, options))
            for side in sides:
                seconds = {stage: float(np.median([r[stage] for r in rounds[side]])) for stage in rounds[side][0]}
                row[side] = {"seconds": seconds, "total_s": sum(seconds.values())}
                if not options.no_mapping:
                    row[side]["model"] = mapped(images, Path(folder) / side, truth, options)
                    row[side]["our model"] = mapped_by_us(images, Path(folder) / side, truth, options)
                print(f"{name:22} {side:9} {told(row[side])}", flush=True)
        if not options.only_ours:
            row["ratio"] = row["ours"]["total_s"] / row["pycolmap"]["total_s"]
            print(f"{name:22} ratio     {row['ratio']:.3f} = 1/{1 / row['ratio']:.1f}", flush=True)
        yield row


def told(side: dict[str, Any]) -> str:
    parts = " ".join(f"{stage} {value:.2f}" for stage, value in side["seconds"].items())
    text = f"{side['total_s']:6.2f} s ({parts})"
    for key, mapper in (("model", "pycolmap's mapper"), ("our model", "ours")):
        if key in side:
            auc, model = auc_at_1(side[key]), side[key]
            text += f"   {mapper}: {model['registered']}/{model['images']} {model['models']}"
            text += f" AUC@1° {auc:.1f}" if auc is not None else ""
    return text


def auc_at_1(model: dict[str, Any]) -> float | None:
    """Per cent, or None where there is no truth or no model."""
    return 100 * model["comparison"]["relative_pose"]["auc_deg"]["1"] if "comparison" in model else None


def our_seconds(images: Path, database: Path, camera_per_image: bool, options: argparse.Namespace) -> dict[str, float]:
    """The pipeline's own stages; kernels are compiled before."""
    settings: dict[str, Any] = {"cameras.sharing": "image" if camera_per_image else "auto"}
    if options.max_image_size:
        settings["features.max_image_size"] = options.max_image_size
    config = with_settings(DEFAULTS, settings, "the benchmark")
    stopwatch, start = _Stopwatch(), time.perf_counter()
    with Database.open(database) as db:
        observer: Observer = stopwatch
        scene = read_scene(db, images, config.cameras, threads=options.threads, observer=SILENT)
        run = Run(db, config, options.threads, observer, scene.images)
        match_and_verify(run, extract_all(run))
    rest = time.perf_counter() - start - sum(stopwatch.seconds.values())
    return {**stopwatch.seconds, "rest": rest}


class _Stopwatch:
    """Wall time of each stage, all its rounds."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._started = 0.0

    def __call__(self, event: Event, /) -> None:
        match event:
            case StageStarted():
                self._started = time.perf_counter()
            case StageFinished(stage=stage):
                self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - self._started


def their_seconds(
    images: Path, database: Path, camera_per_image: bool, options: argparse.Namespace
) -> dict[str, float]:
    """pycolmap's extraction, and its exhaustive matching, which verifies as well."""
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    for some in (extraction, matching):
        some.num_threads, some.use_gpu = options.threads, False
    if options.max_image_size:
        extraction.max_image_size = options.max_image_size
    mode = pycolmap.CameraMode.PER_IMAGE if camera_per_image else pycolmap.CameraMode.AUTO
    start = time.perf_counter()
    pycolmap.extract_features(
        database, images, image_names=image_names(images), camera_mode=mode, extraction_options=extraction
    )
    extracted = time.perf_counter()
    pycolmap.match_exhaustive(database, matching_options=matching)
    return {"features": extracted - start, "matching and verification": time.perf_counter() - extracted}


def truth_of(name: str, options: argparse.Namespace) -> Reconstruction | None:
    image_set = SETS[name]
    return image_set.read_truth(options.data / image_set.truth) if image_set.read_truth else None


def mapped(images: Path, folder: Path, truth: Reconstruction | None, options: argparse.Namespace) -> dict[str, Any]:
    """What pycolmap's mapper makes of the database of the first round."""
    database, mapping = folder / "database0.db", pycolmap.IncrementalPipelineOptions()
    mapping.num_threads = options.threads
    if truth is not None:
        set_cameras(database, truth)
        mapping.ba_refine_focal_length = mapping.ba_refine_principal_point = mapping.ba_refine_extra_params = False
    (folder / "sparse").mkdir()
    pycolmap.incremental_mapping(database, images, folder / "sparse", mapping)
    return score(folder / "sparse", image_names(images), truth)


def mapped_by_us(
    images: Path, folder: Path, truth: Reconstruction | None, options: argparse.Namespace
) -> dict[str, Any]:
    """What our mapper makes of the same database."""
    with Database.open(folder / "database0.db") as db:
        keypoints = {row.image_id: db.read_keypoints(row.image_id) for row in db.images()}
        scales = {image_id: db.read_keypoint_scales(image_id) for image_id in keypoints}
        image_cameras = {row.image_id: row.camera_id for row in db.images()}
        names = {row.image_id: row.name for row in db.images()}
        graph, cameras = db.read_view_graph(), db.cameras()
    if truth is None:
        cameras = calibrate_focal_lengths(graph, cameras, image_cameras, doubt_known=True)
    graph = poses_under(graph, keypoints, cameras, image_cameras)
    graph = without_contradictions(graph, cycle_consistency(graph, DEFAULTS.cycles))
    models = map_incrementally(
        graph,
        keypoints,
        cameras,
        image_cameras,
        names,
        DEFAULTS.mapping,
        keypoint_scales=scales,
        seed=0,
        threads=options.threads,
        refine_intrinsics=truth is None,
        observer=SILENT,
    )
    for k, model in enumerate(models):
        write_model(model, folder / "ours" / str(k))
    return score(folder / "ours", image_names(images), truth)


if __name__ == "__main__":
    sys.exit(main())
