"""The stages over all images and pairs, each item once: computed on several threads, kept as it comes.

One thread writes. Items are computed out of order, but written in theirs, a transaction about every second; a run that
is killed loses that second. What carries the key of its inputs is not computed again (see `keys`).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from sfm.core.errors import ConfigError, Rejected
from sfm.core.events import FeaturesExtracted, Observer, PairMatched, PairVerified, StageFinished, StageStarted
from sfm.core.execution import ordered_map
from sfm.core.scene import Features, Matches, PairKind, TwoViewGeometry
from sfm.features import NETWORKS, working_memory_bytes
from sfm.io.database import Database
from sfm.io.images import natural_key
from sfm.matching import (
    LightGlue,
    MatchingConfig,
    SearchableFeatures,
    distinct_features,
    match_features,
    match_guided,
)
from sfm.pipeline.config import PipelineConfig
from sfm.pipeline.image_features import STAGE as FEATURES
from sfm.pipeline.image_features import FoundFeatures, SceneImage, find_features, follow_features, model_digest
from sfm.pipeline.keys import code_digest, key_of
from sfm.pipeline.memory import free_memory_bytes
from sfm.verification import verify_pair

_COMMIT_EVERY_S = 1.0
_CACHED_IMAGES = 128
"""Images whose features are held in memory for matching, up to 8 MB each."""
_TILE = _CACHED_IMAGES // 2
"""Pairs are visited tile by tile, so that both sides of a tile fit into the cache."""

_GUIDING = (PairKind.CALIBRATED, PairKind.UNCALIBRATED)
"""Kinds of pairs that are matched again along their epipolar lines, if that is wanted."""

_MEMORY_GUESS_BYTES = 8 * 1024**3

Pair = tuple[int, int]
_Matched = tuple[Pair, np.ndarray, np.ndarray, Matches, tuple[np.ndarray | None, np.ndarray | None], list[Features]]
"""Keypoints of both images, matches, which keypoints are distinct, and descriptors if they are needed."""
Result = TypeVar("Result")
Item = TypeVar("Item", int, Pair)


@dataclasses.dataclass(frozen=True, slots=True)
class Run:
    """What every stage needs."""

    database: Database
    config: PipelineConfig
    threads: int
    observer: Observer
    images: Mapping[int, SceneImage]

    def pair_names(self, pair: Pair) -> tuple[str, str]:
        """The names of the two images."""
        return self.images[pair[0]].name, self.images[pair[1]].name


def extract_all(run: Run) -> dict[int, str]:
    """Features of all images; returns the key of each."""
    stage, keys = FEATURES, _feature_keys(run)
    counts = run.database.feature_counts()
    stale = _stale(run, stage, keys, present=counts)

    def compute(image_id: int) -> tuple[int, FoundFeatures]:
        return image_id, find_features(run.images[image_id], run.config)

    def results() -> Iterator[tuple[int, FoundFeatures]]:
        if run.config.features.kind != "klt":
            yield from ordered_map(compute, stale, threads=_threads_that_fit(run, stale))
        elif stale:  # corners are followed from the first frame on, though not all of them are new
            ids, wanted = _in_order_of_names(run), set(stale)
            found = zip(ids, follow_features([run.images[k] for k in ids], run.config), strict=True)
            yield from ((k, features) for k, features in found if k in wanted)

    def write(result: tuple[int, FoundFeatures]) -> None:
        image_id, found = result
        name = run.images[image_id].name
        run.database.write_features(image_id, found.features)
        run.database.clear_ledger(stage, [name])
        run.database.record(*found.decisions)
        run.database.set_stage_keys(stage, {_label(image_id): keys[image_id]})
        run.observer(FeaturesExtracted(name=name, count=len(found.features)))

    run.observer(StageStarted(stage=stage, total=len(stale), cached=len(keys) - len(stale)))
    _keep_as_they_come(run.database, results(), write)
    counts = run.database.feature_counts()
    mean = np.mean([counts[image_id] for image_id in keys]) if keys else 0
    run.observer(StageFinished(stage=stage, summary=f"{len(keys)} images, {mean:.0f} keypoints each"))
    return keys


def _feature_keys(run: Run) -> dict[int, str]:
    """What the features of each image are computed from; for corners that are followed, also all frames before it."""
    config, code = run.config.features, code_digest("sfm.prepare", "sfm.features", "sfm.io", "sfm.core")
    follows = config.kind == "klt"
    settings = (config.max_image_size, run.config.tracking) if follows else (config, model_digest(config))
    basis = key = key_of(code, cv2.__version__, config.kind, *settings, run.config.prepare)
    keys = {}
    for image_id in _in_order_of_names(run) if follows else run.images:
        image = run.images[image_id]
        key = key_of(key if follows else basis, image.digest, *([image.mask.digest] if image.mask else []))
        keys[image_id] = key
    return keys


def _in_order_of_names(run: Run) -> list[int]:
    return sorted(run.images, key=lambda image_id: natural_key(run.images[image_id].name))


def check_networks(config: PipelineConfig) -> None:
    """Finds out before the work begins whether the files of networks are there, and are for these features.

    Raises:
        ConfigError: they are not.
    """
    model_digest(config.features)
    if config.matching.lightglue and config.features.kind not in NETWORKS:
        cause = f"matching.lightglue needs features of a network, not {config.features.kind}"
        raise ConfigError(cause, remedy="choose features.kind aliked or disk, or no matching.lightglue")
    if config.matching.lightglue and not Path(config.matching.lightglue).is_file():
        raise ConfigError("there is no such file", path=config.matching.lightglue)


def match_all(run: Run, feature_keys: Mapping[int, str], pairs: Iterable[Pair]) -> dict[Pair, str]:
    """Putative matches of pairs i < j of images that have features; returns the key of each pair.

    Raises:
        ConfigError: the file of LightGlue cannot be used, or the features are not those of a network.
    """
    stage, config = "matching", run.config.matching
    check_networks(run.config)
    network = LightGlue(config.lightglue) if config.lightglue else None
    # Guided matching is a part of verification, and has its settings in the keys there.
    plain = dataclasses.replace(config, guided=False, guided_error_px=MatchingConfig().guided_error_px)
    basis = key_of(code_digest("sfm.matching", "sfm.core"), plain, *([network.digest] if network else []))
    keys = {(i, j): key_of(basis, feature_keys[i], feature_keys[j]) for i, j in pairs}
    stale = _stale(run, stage, keys, present=run.database.matched_pairs())
    features = lru_cache(_CACHED_IMAGES)(lambda image_id: SearchableFeatures(run.database.read_features(image_id)))

    def inputs() -> Iterator[tuple[Pair, SearchableFeatures, SearchableFeatures]]:
        for i, j in _tiled(stale):
            yield (i, j), features(i), features(j)

    def compute(item: tuple[Pair, SearchableFeatures, SearchableFeatures]) -> tuple[Pair, Matches]:
        pair, features1, features2 = item
        if network is None:
            return pair, match_features(features1, features2, config)
        size1, size2 = ((run.images[k].camera.width, run.images[k].camera.height) for k in pair)
        return pair, network.match(features1.features, features2.features, size1, size2, config.min_score)

    def write(result: tuple[Pair, Matches]) -> None:
        pair, matches = result
        name1, name2 = run.pair_names(pair)
        run.database.write_matches(*pair, matches)
        run.database.set_stage_keys(stage, {_label(pair): keys[pair]})
        run.observer(PairMatched(name1=name1, name2=name2, count=len(matches)))

    run.observer(StageStarted(stage=stage, total=len(stale), cached=len(keys) - len(stale)))
    _keep_as_they_come(run.database, ordered_map(compute, inputs(), threads=run.threads), write)
    counts = run.database.match_counts()
    median = np.median([counts[pair] for pair in keys]) if keys else 0
    run.observer(StageFinished(stage=stage, summary=f"{len(keys)} pairs, {median:.0f} matches in the median"))
    return keys


def verify_all(run: Run, match_keys: Mapping[Pair, str]) -> dict[Pair, str]:
    """Two-view geometry of all matched pairs; returns the key of each pair."""
    stage, config, seed = "verification", run.config.verification, run.config.seed
    guided = run.config.matching.guided
    guidance = (code_digest("sfm.matching"), run.config.matching) if guided else ()
    basis = key_of(code_digest("sfm.verification", "sfm.core"), config, seed, *guidance)
    camera_keys = {image.camera_id: key_of(image.camera) for image in run.images.values()}
    keys = {
        (i, j): key_of(basis, i, j, key, *(camera_keys[run.images[k].camera_id] for k in (i, j)))
        for (i, j), key in match_keys.items()
    }
    stale = _stale(run, stage, keys, present=run.database.verified_pairs())
    points2D = lru_cache(_CACHED_IMAGES)(run.database.read_keypoints)
    features = lru_cache(_CACHED_IMAGES)(run.database.read_features)

    distinct = _distinct_features(run, stale) if config.detect_repetition else {}

    def inputs() -> Iterator[_Matched]:
        for i, j in _tiled(stale):
            matches, described = run.database.read_matches(i, j), [features(i), features(j)] if guided else []
            yield (i, j), points2D(i), points2D(j), matches, (distinct.get(i), distinct.get(j)), described

    def compute(item: _Matched) -> tuple[Pair, int, TwoViewGeometry | Rejected]:
        pair, points2D_1, points2D_2, matches, (distinct1, distinct2), described = item
        camera1, camera2 = run.images[pair[0]].camera, run.images[pair[1]].camera

        def verified(matches: Matches) -> TwoViewGeometry | Rejected:
            points, known, rng = (points2D_1, points2D_2), (camera1, camera2), np.random.default_rng([seed, *pair])
            return verify_pair(*points, matches, *known, config, distinct1=distinct1, distinct2=distinct2, rng=rng)

        geometry = verified(matches)
        if guided and isinstance(geometry, TwoViewGeometry) and geometry.kind in _GUIDING:
            more = match_guided(described[0], described[1], geometry, camera1, camera2, run.config.matching)
            again = verified(more)
            # What agrees with a geometry is no evidence for it: only more of the same is taken.
            if isinstance(again, TwoViewGeometry) and again.kind == geometry.kind and len(again) > len(geometry):
                geometry = again
        return pair, len(matches), geometry

    def write(result: tuple[Pair, int, TwoViewGeometry | Rejected]) -> None:
        pair, matches, geometry = result
        name1, name2 = run.pair_names(pair)
        run.database.write_geometry(*pair, geometry)
        run.database.set_stage_keys(stage, {_label(pair): keys[pair]})
        if isinstance(geometry, Rejected):
            inliers, kind, reason = 0, "", geometry.reason
        else:
            inliers, kind, reason = len(geometry), geometry.kind.name.lower(), ""
        run.observer(PairVerified(name1=name1, name2=name2, matches=matches, inliers=inliers, kind=kind, reason=reason))

    run.observer(StageStarted(stage=stage, total=len(stale), cached=len(keys) - len(stale)))
    _keep_as_they_come(run.database, ordered_map(compute, inputs(), threads=run.threads), write)
    rejected = len(keys.keys() & run.database.rejected_pairs().keys())
    run.observer(StageFinished(stage=stage, summary=f"{len(keys) - rejected} of {len(keys)} pairs"))
    return keys


def _distinct_features(run: Run, pairs: Iterable[Pair]) -> dict[int, np.ndarray]:
    """Which features of the images that repeat themselves are distinct; of pairs that have enough matches."""
    counts, enough = run.database.match_counts(), run.config.verification.ransac.min_inliers
    ids = sorted({image_id for pair in pairs if counts.get(pair, 0) >= enough for image_id in pair})

    def compute(item: tuple[int, Features]) -> tuple[int, np.ndarray | None]:
        camera = run.images[item[0]].camera
        return item[0], distinct_features(item[1], camera.width, camera.height)

    read = ((image_id, run.database.read_features(image_id)) for image_id in ids)
    found = ordered_map(compute, read, threads=run.threads)
    return {image_id: mask for image_id, mask in found if mask is not None}


def _threads_that_fit(run: Run, image_ids: Iterable[int]) -> int:
    """As many images at once as threads are there and half of the free memory holds."""
    config = run.config.features
    needs = [working_memory_bytes(run.images[k].camera.width, run.images[k].camera.height, config) for k in image_ids]
    free = free_memory_bytes() or _MEMORY_GUESS_BYTES
    return int(np.clip(free // (2 * max(needs, default=1)), 1, run.threads))


def _keep_as_they_come(database: Database, results: Iterator[Result], write: Callable[[Result], None]) -> None:
    """Writes each result, in transactions of about a second."""
    more = True
    while more:
        more = False
        with database.transaction():
            until = time.monotonic() + _COMMIT_EVERY_S
            for result in results:
                write(result)
                if time.monotonic() >= until:
                    more = True
                    break


def _label(item: int | Pair) -> str:
    """How an item of a stage is called in the database."""
    return str(item) if isinstance(item, int) else f"{item[0]}-{item[1]}"


def _stale(run: Run, stage: str, keys: Mapping[Item, str], present: Iterable[Item]) -> list[Item]:
    """The items that must be computed: their key is another, or their result is gone."""
    stored, present = run.database.stage_keys(stage), set(present)
    return [item for item, key in keys.items() if stored.get(_label(item)) != key or item not in present]


def _tiled(pairs: Iterable[Pair]) -> list[Pair]:
    return sorted(pairs, key=lambda pair: (pair[0] // _TILE, pair[1] // _TILE, pair))


def forget_other_pairs(run: Run, pairs: Collection[Pair]) -> None:
    """Drops matches and geometries of pairs that are no longer wanted, and keys of pairs that went with their image."""
    database, wanted = run.database, {_label(pair) for pair in pairs}
    with database.transaction():
        for stage, present, clear in (
            ("matching", database.matched_pairs(), database.clear_matches),
            ("verification", database.verified_pairs(), database.clear_geometries),
        ):
            database.clear_stage(stage, [label for label in database.stage_keys(stage) if label not in wanted])
            for pair in present:
                if pair not in pairs:
                    clear(pair)
