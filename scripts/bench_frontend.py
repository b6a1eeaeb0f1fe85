"""Features, matches and verification beside pycolmap; the estimators alone are the matter of bench_robust.

    python -m scripts.bench_frontend stages DATA [--sets fountain-P11 ...] [--max-image-size 1600] [--json FILE]
    python -m scripts.bench_frontend pairs DATA [--folders RENDERED/orbit/images ...] [--json FILE]

`stages` times extraction, matching and verification of a set from empty databases, pycolmap at its defaults and, with
`--max-image-size`, both sides at that size. A round runs one side after the other; `--repeat` rounds, medians count.
Accuracy with the rest of the pipeline is the matter of bench_sfm.

`pairs` pools the images of all sets and folders and tells which share of the pairs within a set that are verified with
at least 30 inliers the cheap look finds promising, and which share is among the 20 best partners of either image.
"""

from __future__ import annotations

import argparse
import itertools
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
from PIL import Image

from scripts.bench_sfm import SETS, environment, image_names
from sfm.core.cameras.priors import infer_camera
from sfm.core.errors import Rejected
from sfm.core.events import SILENT
from sfm.core.execution import ordered_map
from sfm.core.scene import Features
from sfm.features import extract_features
from sfm.io.database import Database
from sfm.io.images import read_image
from sfm.matching import SearchableFeatures, match_features
from sfm.pipeline.config import DEFAULTS, with_settings
from sfm.pipeline.scene import read_scene
from sfm.pipeline.stages import Run, extract_all, match_all, verify_all
from sfm.pipeline.warm_up import run_parts
from sfm.retrieval import RetrievalConfig, exhaustive_pairs, pair_scores, probes_of, promising_pairs
from sfm.verification import verify_pair

STAGE_SETS = ("fountain-P11", "Herz-Jesus-P8", "SceauxCastle", "lund", "middlebury_templeRing")
MIN_AGREEING = 30


def main() -> int:
    options = parse_options()
    if "OPENBLAS_NUM_THREADS" not in os.environ:  # as the command sets it, which must be before NumPy is loaded
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, [sys.executable, "-m", "scripts.bench_frontend", *sys.argv[1:]])
    rows = list({"stages": stages, "pairs": pairs_of_pool}[options.part](options))
    if options.json:
        report = {"part": options.part, "environment": environment(options.threads), "results": rows}
        options.json.write_text(json.dumps(report, indent=1))
    return 0


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=("stages", "pairs"))
    parser.add_argument("data", type=Path, help="folder of the image sets")
    parser.add_argument("--sets", nargs="+", choices=list(SETS))
    parser.add_argument("--folders", nargs="*", type=Path, default=[], help="more images (part pairs)")
    parser.add_argument("--max-image-size", type=int, help="both sides; else each side's default")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=1)
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


# --- pairs ---------------------------------------------------------------------------------------------------------


def pairs_of_pool(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row: how many of the true pairs the cheap look finds, and what it costs."""
    folders = [options.data / SETS[name].images for name in options.sets or SETS] + options.folders
    paths = [(k, path / name) for k, path in enumerate(folders) if path.is_dir() for name in image_names(path)]
    cv2.setNumThreads(1)
    features = list(ordered_map(features_of, [path for _, path in paths], threads=options.threads))
    home = np.array([k for k, _ in paths])
    true = true_links(features, home, [path for _, path in paths], options.threads)

    if not true:
        raise SystemExit("no two images of one set show the same place")

    config = RetrievalConfig()
    start = time.perf_counter()
    scores = pair_scores([probes_of(f, config) for f in features], config, threads=options.threads)
    seconds = time.perf_counter() - start
    promising = set(promising_pairs(scores, config))
    rank = np.argsort(np.argsort(-scores, axis=1, kind="stable"), axis=1, kind="stable")
    best = {(i, j) for i, j in true if min(rank[i, j], rank[j, i]) < 20 and scores[i, j] > 0}
    count = len(features) * (len(features) - 1) // 2
    row = {
        "images": len(features),
        "pairs": count,
        "true": len(true),
        "promising": len(promising),
        "found": len(true & promising) / len(true),
        "found_among_20": len(best) / len(true),
        "seconds": seconds,
    }
    print(f"{len(features)} images, {count} pairs, {len(true)} of them true; the look takes {seconds:.1f} s")
    print(f"promising: {len(promising)} pairs, {100 * row['found']:.1f} % of the true ones")
    print(f"among the 20 best partners: {100 * row['found_among_20']:.1f} %")
    by_set = {folders[k].as_posix(): [p for p in true if home[p[0]] == k] for k in np.unique(home).tolist()}
    for name, mine in by_set.items():
        if mine:
            print(f"  {100 * len(promising.intersection(mine)) / len(mine):5.1f} % of {len(mine):4}  {name}")
    yield row


def features_of(path: Path) -> Features:
    found = extract_features(read_image(path, gray=True))
    if isinstance(found, Rejected):
        raise SystemExit(f"{path} has no features")
    return found


def true_links(features: list[Features], home: np.ndarray, paths: list[Path], threads: int) -> set[tuple[int, int]]:
    """Pairs of rows within a folder that are verified with at least `MIN_AGREEING` inliers."""
    searchable = [SearchableFeatures(f) for f in features]
    cameras = [infer_camera("SIMPLE_RADIAL", *Image.open(path).size) for path in paths]

    def is_true(pair: tuple[int, int]) -> bool:
        i, j = pair
        matches = match_features(searchable[i], searchable[j])
        rng = np.random.default_rng(pair)
        found = verify_pair(features[i].points2D, features[j].points2D, matches, cameras[i], cameras[j], rng=rng)
        return not isinstance(found, Rejected) and len(found) >= MIN_AGREEING

    within = [(i, j) for i, j in itertools.combinations(range(len(features)), 2) if home[i] == home[j]]
    return {pair for pair, good in zip(within, ordered_map(is_true, within, threads=threads), strict=True) if good}


if __name__ == "__main__":
    sys.exit(main())
