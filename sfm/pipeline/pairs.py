"""From features to verified pairs of images.

Of few images all pairs are compared. Of many, a cheap comparison of all images finds the promising pairs (see
`sfm.retrieval`); after their verification, missing links are tried as long as they bring anything.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from sfm.core.errors import ConfigError
from sfm.core.events import Note
from sfm.core.scene import DescriptorKind
from sfm.features import descriptor_kind
from sfm.io.bookkeeping import Decision
from sfm.io.exif import read_image_info
from sfm.io.images import natural_key
from sfm.io.pair_list import read_pair_list
from sfm.pipeline.pair_scores import STAGE, has_visual_words, scores_of
from sfm.pipeline.stages import Pair, Run, forget_other_pairs, match_all, verify_all
from sfm.retrieval import PairScores, RetrievalConfig, exhaustive_pairs, missing_links, promising_pairs
from sfm.retrieval.choice import choose_method
from sfm.retrieval.pairs import earth_centered_m, nearby_pairs, sequential_pairs, spatial_pairs
from sfm.retrieval.sequence import sequence_pairs

_SECONDS_PER_PAIR, _SECONDS_PER_FEATURE = 0.015, 7e-6
"""Time to match and verify a pair on one core: 43 ms at 4,000 features an image. For the estimate only."""
_WITHOUT_SCORES = ("exhaustive", "sequential", "list")
"""Methods that need no comparison of descriptors, if loops are not closed."""


def check_pair_settings(run: Run) -> None:
    """Finds what the chosen method lacks before the work begins.

    Raises:
        InputError: the file cannot be used.
        ConfigError: the method is `list` and there is no file, `spatial` and no photo has a position, or `vocabulary`
            and the descriptors have no visual words.
    """
    config, kind = run.config.retrieval, run.config.features.kind
    if kind == "klt" and config.method not in ("auto", *_WITHOUT_SCORES):
        raise ConfigError(
            f"the corners of klt have no descriptors to find pairs by {config.method}",
            remedy=f"choose auto, {' or '.join(_WITHOUT_SCORES)}",
        )
    if config.method == "vocabulary" and descriptor_kind(run.config.features) != DescriptorKind.SIFT:
        raise ConfigError(f"the descriptors of {kind} have no visual words", remedy="take --pairs look")
    if config.method == "list":
        _listed(run)
    elif config.method == "spatial" and not np.isfinite(_positions_m(run, list(run.images))).any():
        raise ConfigError("none of the photos says where it was taken", remedy="let sfm choose the method: auto")


@dataclasses.dataclass(frozen=True, slots=True)
class PairChoice:
    """The pairs with which a run begins, sorted, and why these, for a person.

    `scores` tell by their rows, the images in the order of their names, which pairs to try later; None where the
    choice is final.
    """

    pairs: Sequence[Pair]
    why: str
    scores: PairScores | None = None


def first_pairs(run: Run, feature_keys: Mapping[int, str]) -> PairChoice:
    """The pairs that are matched before anything is verified."""
    config, ids = run.config.retrieval, _usable(run)
    few = config.method == "auto" and len(ids) <= config.exhaustive_up_to
    if config.method == "list":
        usable = set(ids)
        return PairChoice([pair for pair in _listed(run) if usable.issuperset(pair)], "as listed")
    if len(ids) < 3 or config.method == "exhaustive" or few:
        return PairChoice(exhaustive_pairs(ids), "all with all")
    if run.config.features.kind == "klt":
        pairs = sequential_pairs(len(ids), config.overlap)
        return PairChoice(_named(ids, pairs), "sequential: corners are followed from frame to frame")
    scores = scores_of(run, feature_keys, ids)
    pairs, why = _chosen(run, ids, scores)
    return PairChoice(_named(ids, pairs), why, scores)


def match_and_verify(run: Run, feature_keys: Mapping[int, str]) -> tuple[dict[Pair, str], dict[Pair, str]]:
    """Matches and geometry of the pairs that are worth it; returns the key of each pair in both stages."""
    choice = first_pairs(run, feature_keys)
    _announce(run, choice)
    if choice.scores is None:
        match_keys = match_all(run, feature_keys, choice.pairs)
        pair_keys = verify_all(run, match_keys)
        run.database.clear_ledger(STAGE)
    else:
        match_keys, pair_keys = _in_rounds(run, feature_keys, choice.pairs, choice.scores)
    forget_other_pairs(run, match_keys)
    return match_keys, pair_keys


def _in_rounds(
    run: Run, feature_keys: Mapping[int, str], first: Sequence[Pair], scores: PairScores
) -> tuple[dict[Pair, str], dict[Pair, str]]:
    """Until the verified pairs hang together well, or what is missing brings nothing more."""
    ids, pairs = _usable(run), set(first)
    row = {image_id: k for k, image_id in enumerate(ids)}
    linked: set[Pair] | None = None
    while True:
        match_keys = match_all(run, feature_keys, sorted(pairs))
        pair_keys = verify_all(run, match_keys)
        before, linked = linked, pairs.intersection(run.database.linked_pairs())
        if linked == before:
            break
        tried, joined = ([(row[i], row[j]) for i, j in some] for some in (pairs, linked))
        links = _named(ids, missing_links(scores, tried, joined, run.config.retrieval))
        if not links:
            break
        pairs.update(links)
    _note_partners(run, ids, pairs)
    return match_keys, pair_keys


def _usable(run: Run) -> list[int]:
    """The images that have features, in the order of their names."""
    counts = run.database.feature_counts()
    usable = [image_id for image_id in run.images if counts.get(image_id)]
    return sorted(usable, key=lambda image_id: natural_key(run.images[image_id].name))


def _named(ids: Sequence[int], pairs: Sequence[Pair]) -> list[Pair]:
    """Pairs of rows of `ids` as pairs of ids, sorted."""
    return sorted((min(ids[i], ids[j]), max(ids[i], ids[j])) for i, j in pairs)


def _chosen(run: Run, ids: Sequence[int], scores: PairScores) -> tuple[list[Pair], str]:
    """The pairs of rows of `ids` that are matched first, and how they were chosen."""
    config, method, why = run.config.retrieval, run.config.retrieval.method, "as asked for"
    positions_m = _positions_m(run, ids) if method in ("auto", "spatial") else np.zeros((0, 3))
    if method == "auto" and not has_visual_words(run, ids):
        method, why = "look", "the descriptors have no visual words"
    elif method == "auto":
        images = [run.images[image_id] for image_id in ids]
        sizes = [(image.camera.width, image.camera.height) for image in images]
        method, why = choose_method(scores, [image.name for image in images], sizes, positions_m, config)
    match method:
        case "sequential":
            pairs = sequence_pairs(scores, config)
        case "spatial":
            pairs = _near_or_similar(scores, positions_m, config)
        case _:
            pairs = promising_pairs(scores, config)
    return pairs, f"{method}: {why}"


def _near_or_similar(scores: PairScores, positions_m: np.ndarray, config: RetrievalConfig) -> list[Pair]:
    """Neighbours by position; for images that have none, and for neighbours by name, what they show decides."""
    lost = set(np.flatnonzero(np.isnan(positions_m).any(axis=1)).tolist())
    similar = [pair for pair in promising_pairs(scores, config) if lost.intersection(pair)]
    near = spatial_pairs(positions_m, config.spatial_partners, config.max_distance_m)
    return sorted({*near, *similar, *nearby_pairs(scores.images, config.neighbors)})


def _positions_m(run: Run, ids: Sequence[int]) -> np.ndarray:
    """Where the photos were taken by their EXIF, in the Earth's frame; NaN where they do not say."""
    place = np.full((len(ids), 3), np.nan)
    for k, image_id in enumerate(ids):
        info = read_image_info(run.images[image_id].path)
        if info.gps is not None:
            # Heights by GPS are the least certain, and those of one camera hardly differ: level is enough for near.
            place[k] = *info.gps, 0.0
    return earth_centered_m(*place.T)


def _listed(run: Run) -> list[Pair]:
    """The pairs of the user's file, by image ids."""
    path = run.config.retrieval.pair_list
    if not path:
        raise ConfigError("the method list needs a file", remedy="name it with --pair-list FILE")
    ids = {image.name: image_id for image_id, image in run.images.items()}
    pairs = [(ids[name1], ids[name2]) for name1, name2 in read_pair_list(path, ids)]
    return sorted((min(pair), max(pair)) for pair in pairs)


def _announce(run: Run, choice: PairChoice) -> None:
    counts, ids, pairs = run.database.feature_counts(), _usable(run), len(choice.pairs)
    mean = np.mean([counts[image_id] for image_id in ids]) if ids else 0.0
    seconds = pairs * (_SECONDS_PER_PAIR + mean * _SECONDS_PER_FEATURE) / run.threads
    told = f"{pairs} of {len(ids) * (len(ids) - 1) // 2} pairs are compared ({choice.why})"
    run.observer(Note(message=f"{told}, about {_duration(float(seconds))} if all are new"))


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{max(1, round(seconds))} s"
    return f"{round(seconds / 60)} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _note_partners(run: Run, ids: Sequence[int], pairs: set[Pair]) -> None:
    partners = dict.fromkeys(ids, 0)
    for pair in pairs:
        for image_id in pair:
            partners[image_id] += 1
    with run.database.transaction():
        run.database.clear_ledger(STAGE)
        run.database.record(
            *(
                Decision(STAGE, run.images[k].name, "partners", float(count), None, "kept", f"of {len(ids) - 1} images")
                for k, count in partners.items()
            )
        )
