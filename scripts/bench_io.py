"""Loading and saving a large COLMAP model, against pycolmap in the same run.

scripts/bench_io.py --points 1000000 --json
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import Reconstruction, Tracks
from sfm.io.colmap_model import read_model, write_model


def random_model(points: int, track_length: int = 5, images: int = 500, seed: int = 0) -> Reconstruction:
    """Tracks through `track_length` successive images; a fifth of the keypoints are seen by no point."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, images, points)
    rows = ((first[:, None] + np.arange(track_length)) % images).ravel()
    order = np.argsort(rows, kind="stable")
    observed = np.bincount(rows, minlength=images)
    feature_ids = np.empty(len(rows), np.int64)
    feature_ids[order] = np.arange(len(rows)) - np.repeat(np.cumsum(observed) - observed, observed)
    offsets = np.concatenate([[0], np.cumsum(observed + observed // 4)])
    return Reconstruction(
        cameras={1: Camera("SIMPLE_RADIAL", 4000, 3000, np.array([3000.0, 2000.0, 1500.0, 0.01]))},
        image_ids=np.arange(1, images + 1, dtype=np.int32),
        image_names=tuple(f"image{row:06d}.jpg" for row in range(images)),
        image_camera_ids=np.ones(images, np.int32),
        cams_from_world=Rigid3.exp(rng.normal(size=(images, 6))),
        keypoint_offsets=offsets,
        keypoints=rng.uniform(0, 3000, (offsets[-1], 2)),
        points3D=rng.normal(size=(points, 3)),
        point_ids=np.arange(1, points + 1),
        colors=rng.integers(0, 256, (points, 3), np.uint8),
        errors=rng.uniform(0, 1, points),
        tracks=Tracks(np.arange(points + 1) * track_length, (rows + 1).astype(np.int32), feature_ids.astype(np.int32)),
    )


def seconds(work: Callable[[], object]) -> tuple[float, float]:
    """Wall and processor time of one call; the latter is steadier on a machine that does other things as well."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - processor


def measure(points: int, repeats: int) -> dict[str, float]:
    """Median seconds of both sides, and their ratios (below 1: we are faster)."""
    ours = random_model(points)
    with tempfile.TemporaryDirectory() as folder:
        here, there = Path(folder, "ours"), Path(folder, "theirs")
        there.mkdir()
        write_model(ours, here)
        theirs = pycolmap.Reconstruction(here)
        works: dict[str, Callable[[], object]] = {
            "save_ours": lambda: write_model(ours, here),
            "save_pycolmap": lambda: theirs.write_binary(there),
            "load_ours": lambda: read_model(here),
            "load_pycolmap": lambda: pycolmap.Reconstruction(here),
        }
        times = {name: [seconds(work)] for name, work in works.items()}  # also compiles and warms the caches
        for _ in range(repeats):
            for name, work in works.items():
                times[name].append(seconds(work))
    result = {}
    for clock, unit in enumerate(("wall_s", "cpu_s")):
        medians = {name: statistics.median(t[clock] for t in values[1:]) for name, values in times.items()}
        result |= {f"{name}_{unit}": value for name, value in medians.items()}
        for kind in ("save", "load"):
            result[f"{kind}_ratio_{unit[:-2]}"] = medians[f"{kind}_ours"] / medians[f"{kind}_pycolmap"]
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    result = {"points": arguments.points, "observations": 5 * arguments.points}
    result |= {name: round(value, 3) for name, value in measure(arguments.points, arguments.repeats).items()}
    if arguments.json:
        print(json.dumps(result))
    else:
        for name, value in result.items():
            print(f"{name:24} {value}")


if __name__ == "__main__":
    main()
