"""Which pairs are found, and what finding them costs.

    python -m scripts.bench_pairs pool DATA [--folders RENDERED/orbit/images ...] [--cache FOLDER] [--json FILE]
    python -m scripts.bench_pairs growth [--images 100 1000 10000] [--json FILE]

`pool` throws the images of all sets and folders together. True are the pairs within a set that are verified with at
least 30 inliers. For each way to rank the partners of an image it tells, at 20 candidates an image,

- `of 20`: the share of true partners among the candidates, of an image that has more than 20 counted as 20;
- `pairs`: the share of true pairs of which one image is a candidate of the other. Images with more than 20 partners
  keep this below one for any ranking; `ceiling` is what the ranking by verified inliers itself reaches;

and which share of the true pairs is promising, with how many others. With `--cache`, features and true pairs are
computed once for each set.

`growth` counts votes for made-up walks of more and more images: seconds of one thread for each image, without the
reading, the share of neighbours on the walk that are promising, and memory.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import itertools
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from scripts.bench_sfm import SETS, environment, image_names
from sfm.core.cameras.priors import infer_camera
from sfm.core.errors import Rejected
from sfm.core.execution import ordered_map
from sfm.core.scene import Features
from sfm.features import extract_features
from sfm.io.images import read_image
from sfm.matching import SearchableFeatures, match_features
from sfm.pipeline.memory import peak_memory_bytes
from sfm.pipeline.warm_up import run_parts
from sfm.retrieval import PairScores, RetrievalConfig, probe_scores, probes_of, promising_pairs, similar_images
from sfm.retrieval.aggregation import aggregated_partners
from sfm.retrieval.scores import summed_scores
from sfm.retrieval.voting import features_of_each
from sfm.verification import verify_pair

MIN_INLIERS, CANDIDATES = 30, 20
Pair = tuple[int, int]


def main() -> int:
    options = parse_options()
    if "OPENBLAS_NUM_THREADS" not in os.environ:  # as the command sets it, which must be before NumPy is loaded
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, [sys.executable, "-m", "scripts.bench_pairs", *sys.argv[1:]])
    rows = list({"pool": pool, "growth": growth}[options.part](options))
    if options.json:
        report = {"part": options.part, "environment": environment(options.threads), "results": rows}
        options.json.write_text(json.dumps(report, indent=1))
    return 0


def parse_options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path, help="write every figure to this file")
    parts = parser.add_subparsers(dest="part", required=True)
    part = parts.add_parser("pool")
    part.add_argument("data", type=Path, help="folder of the image sets")
    part.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS))
    part.add_argument("--folders", nargs="*", type=Path, default=[], help="more images, a set each")
    part.add_argument("--cache", type=Path, help="folder for features and true pairs")
    part = parts.add_parser("growth")
    part.add_argument("--images", nargs="+", type=int, default=[100, 300, 1000, 3000, 10_000])
    return parser.parse_args()


# --- pool ----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Pool:
    """Features of all images, the sets that they are from, and the inliers of the true pairs."""

    features: list[Features]
    sets: np.ndarray
    names: list[str]
    true: dict[Pair, int]

    def within(self, pair: Pair) -> str:
        return self.names[self.sets[pair[0]]]


def pool(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each ranking."""
    gathered = gather(options)
    images, true = len(gathered.features), gathered.true
    if not true:
        raise SystemExit("no two images of one set show the same place")
    run_parts(["pair"])
    probe_scores([probes_of(f) for f in gathered.features[:2]])
    count = images * (images - 1) // 2
    print(f"{images} images of {len(gathered.names)} sets, {count} pairs, {len(true)} of them true")
    inliers = summed_scores(images, np.array(list(true)), np.array(list(true.values())), MIN_INLIERS)
    print(
        f"{'ceiling':8} of 20 {100 * of_best(inliers, true)[0]:5.1f} %   pairs {100 * of_best(inliers, true)[1]:5.1f} %"
    )
    for name, rank in rankings(gathered).items():
        start = time.thread_time()
        scores = rank()
        seconds = time.thread_time() - start
        promising = set(promising_pairs(scores))
        found = len(promising & true.keys()) / len(true)
        bounded, plain = of_best(scores, true)
        lost = sorted((true[pair] for pair in true.keys() - promising), reverse=True)
        print(
            f"{name:8} of 20 {100 * bounded:5.1f} %   pairs {100 * plain:5.1f} %   promising {100 * found:5.1f} % among"
            f" {len(promising):6}   {1e3 * seconds / images:6.1f} ms an image   lost have at most {lost[:3]} inliers",
            flush=True,
        )
        by_set = {name: [0, 0] for name in gathered.names}
        for pair in true:
            by_set[gathered.within(pair)][0] += pair in promising
            by_set[gathered.within(pair)][1] += 1
        yield {
            "ranking": name, "images": images, "pairs": count, "true": len(true), "of_20": bounded,
            "pairs_at_20": plain, "promising": len(promising), "found": found, "seconds": seconds,
            "lost_inliers": lost, "by_set": by_set,
        }  # fmt: skip


def rankings(gathered: Pool) -> dict[str, Callable[[], PairScores]]:
    """Votes, a look at all pairs, and vectors with a look at their candidates."""
    read, images = gathered.features.__getitem__, len(gathered.features)

    def look(pairs: list[Pair] | None) -> PairScores:
        return probe_scores([probes_of(f) for f in gathered.features], pairs=pairs)

    def vectors(similarity: Any) -> Callable[[], PairScores]:
        config = RetrievalConfig(similarity=similarity)
        return lambda: look(aggregated_partners(read, images, config))

    named = {name: vectors(name) for name in ("tfidf", "vlad", "fisher")}
    return {"votes": lambda: similar_images(read, images), "look": lambda: look(None), **named}


def of_best(scores: PairScores, true: dict[Pair, int]) -> tuple[float, float]:
    """Shares of true partners, and of true pairs, at 20 candidates an image."""
    whole = np.zeros((scores.images, scores.images))
    whole[scores.pairs[:, 0], scores.pairs[:, 1]] = scores.scores
    whole += whole.T
    partners = np.zeros(whole.shape, bool)
    partners[tuple(np.array(list(true)).T)] = True
    partners |= partners.T
    rank = np.argsort(np.argsort(-whole, axis=1, kind="stable"), axis=1, kind="stable")
    best = (rank < CANDIDATES) & (whole > 0)
    bounded = np.sum(best & partners) / np.sum(np.minimum(partners.sum(axis=1), CANDIDATES))
    return float(bounded), float(np.sum((best | best.T) & partners) / np.sum(partners))


def gather(options: argparse.Namespace) -> Pool:
    folders = [options.data / SETS[name].images for name in options.sets] + options.folders
    folders = [folder for folder in folders if folder.is_dir()]
    features, sets, true = [], [], {}
    for k, folder in enumerate(folders):
        found, links = of_folder(folder, options)
        true |= {(len(features) + i, len(features) + j): inliers for (i, j), inliers in links.items()}
        features += found
        sets += [k] * len(found)
    return Pool(features, np.array(sets), [folder.as_posix() for folder in folders], true)


def of_folder(folder: Path, options: argparse.Namespace) -> tuple[list[Features], dict[Pair, int]]:
    """Features and true pairs of a set, from the cache where they are there."""
    name = hashlib.blake2b(str(folder.resolve()).encode(), digest_size=8).hexdigest()
    path = options.cache / f"{name}.npz" if options.cache else None
    if path and path.is_file():
        with np.load(path) as data:
            columns = [np.split(data[key], data["ends"][:-1]) for key in ("points", "scales", "angles", "descriptors")]
            links = {(i, j): inliers for i, j, inliers in data["links"].tolist()}
        return [Features(*columns) for columns in zip(*columns, strict=True)], links
    cv2.setNumThreads(1)
    paths = [folder / name for name in image_names(folder)]
    features = list(ordered_map(features_of, paths, threads=options.threads))
    links = true_links(features, paths, options.threads)
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        save(path, features, links)
    return features, links


def save(path: Path, features: list[Features], links: dict[Pair, int]) -> None:
    np.savez(
        path,
        points=np.concatenate([f.points2D for f in features]),
        scales=np.concatenate([f.scales for f in features]),
        angles=np.concatenate([f.orientations for f in features]),
        descriptors=np.concatenate([f.descriptors for f in features]),
        ends=np.cumsum([len(f) for f in features]),
        links=np.array([(*pair, inliers) for pair, inliers in links.items()], np.int64).reshape(-1, 3),
    )


def features_of(path: Path) -> Features:
    found = extract_features(read_image(path, gray=True))
    if isinstance(found, Rejected):
        raise SystemExit(f"{path} has no features")
    return found


def true_links(features: list[Features], paths: list[Path], threads: int) -> dict[Pair, int]:
    """Pairs that are verified with at least `MIN_INLIERS` inliers, and how many these are."""
    searchable = [SearchableFeatures(f) for f in features]
    cameras = [infer_camera("SIMPLE_RADIAL", *Image.open(path).size) for path in paths]

    def inliers(pair: Pair) -> int:
        i, j = pair
        matches = match_features(searchable[i], searchable[j])
        rng = np.random.default_rng(pair)
        found = verify_pair(features[i].points2D, features[j].points2D, matches, cameras[i], cameras[j], rng=rng)
        return 0 if isinstance(found, Rejected) else len(found)

    pairs = list(itertools.combinations(range(len(features)), 2))
    counted = zip(pairs, ordered_map(inliers, pairs, threads=threads), strict=True)
    return {pair: count for pair, count in counted if count >= MIN_INLIERS}


# --- growth --------------------------------------------------------------------------------------------------------

STEP_SHARE = 0.25
"""Of a view that is new in the next image."""
POOL = 200_000


class Walk:
    """Views of a row of things; descriptors are drawn like SIFT's, few large numbers among many small ones."""

    def __init__(self, seen: int) -> None:
        rng = np.random.default_rng(0)
        raw = rng.gamma(0.6, size=(POOL, 128)).astype(np.float32)
        self._things = np.minimum(512 * np.sqrt(raw / raw.sum(axis=1, keepdims=True)), 255).astype(np.int16)
        self._noise = rng.integers(-14, 15, (POOL, 128), dtype=np.int16)
        self._seen, self._seconds = seen, 0.0

    @property
    def reading_s(self) -> float:
        """Time spent to make up features."""
        return self._seconds

    def features(self, image: int) -> Features:
        start = time.thread_time()
        thing = np.arange(self._seen) + image * int(STEP_SHARE * self._seen)
        rng = np.random.default_rng(image)
        clean = self._things[thing % POOL]
        for block in np.unique(thing // POOL):  # beyond the pool the same things with their numbers moved round
            rows = thing // POOL == block
            clean[rows] = np.roll(clean[rows], int(block), axis=1)
        rows = np.clip(clean + self._noise[(thing + rng.integers(POOL)) % POOL], 0, 255).astype(np.uint8)
        zeros = np.zeros(self._seen, np.float32)
        made = Features(np.zeros((self._seen, 2)), zeros, zeros, rows)
        self._seconds += time.thread_time() - start
        return made


def growth(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """One row for each number of images."""
    config = RetrievalConfig()
    run_parts(["pair"])
    for images in options.images:
        seen = features_of_each(images, config)
        walk = Walk(seen)
        start = time.thread_time()
        scores = similar_images(walk.features, images, config)
        seconds = time.thread_time() - start - walk.reading_s
        promising = {tuple(pair) for pair in scores.pairs[scores.scores >= scores.threshold].tolist()}
        near = {(i, i + step) for step in (1, 2) for i in range(images - step)}
        row = {
            "images": images, "features": seen, "ms_an_image": 1e3 * seconds / images,
            "found": len(near & promising) / len(near), "promising_an_image": len(promising) / images,
            "peak_memory_gb": (peak_memory_bytes() or 0) / 1e9,
        }  # fmt: skip
        print(
            f"{images:6} images of {seen:4} features: {row['ms_an_image']:6.1f} ms an image,"
            f" {100 * row['found']:5.1f} % of the neighbours, {row['promising_an_image']:.1f} promising pairs an image,"
            f" {row['peak_memory_gb']:.1f} GB so far",
            flush=True,
        )
        yield row


if __name__ == "__main__":
    sys.exit(main())
