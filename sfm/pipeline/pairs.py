"""From features to verified pairs of images.

Of few images all pairs are compared. Of many, a cheap look finds the promising pairs (see `sfm.retrieval`); after their
verification, missing links are tried as long as they bring anything.
"""

from __future__ import annotations

import base64
import dataclasses
import json
from collections.abc import Mapping, Sequence

import numpy as np

from sfm.core.events import StageFinished, StageStarted
from sfm.io.database import Decision
from sfm.io.images import natural_key
from sfm.pipeline.keys import code_digest, key_of
from sfm.pipeline.stages import Pair, Run, forget_other_pairs, match_all, verify_all
from sfm.retrieval import exhaustive_pairs, missing_links, pair_scores, probes_of, promising_pairs

STAGE = "pairs"
_NOTE = "pair_scores"


@dataclasses.dataclass(frozen=True, slots=True)
class PairChoice:
    """The pairs to be matched before anything is verified, sorted, and why these, for a person."""

    pairs: Sequence[Pair]
    why: str


def first_pairs(run: Run, feature_keys: Mapping[int, str]) -> PairChoice:
    """The pairs with which `match_and_verify` begins."""
    config = run.config.retrieval
    ids = _usable(run)
    if len(ids) <= config.exhaustive_up_to:
        return PairChoice(exhaustive_pairs(ids), f"all are compared of up to {config.exhaustive_up_to} images")
    ids = sorted(ids, key=lambda image_id: natural_key(run.images[image_id].name))
    scores = _scores(run, feature_keys, ids)
    pairs = sorted((min(ids[i], ids[j]), max(ids[i], ids[j])) for i, j in promising_pairs(scores, config))
    why = (
        f"those that share at least {config.min_score} of their {config.probes} largest features, "
        f"the {config.partners} best partners of each image and its {config.neighbors} neighbours on each side"
    )
    return PairChoice(pairs, why)


def match_and_verify(run: Run, feature_keys: Mapping[int, str]) -> tuple[dict[Pair, str], dict[Pair, str]]:
    """Matches and geometry of the pairs that are worth it; returns the key of each pair in both stages."""
    usable = _usable(run)
    if len(usable) <= run.config.retrieval.exhaustive_up_to:
        match_keys = match_all(run, feature_keys, exhaustive_pairs(usable))
        pair_keys = verify_all(run, match_keys)
        run.database.clear_ledger(STAGE)
    else:
        match_keys, pair_keys = _in_rounds(run, feature_keys, usable)
    forget_other_pairs(run, match_keys)
    return match_keys, pair_keys


def _usable(run: Run) -> list[int]:
    """The images that have features."""
    counts = run.database.feature_counts()
    return [image_id for image_id in run.images if counts.get(image_id)]


def _in_rounds(
    run: Run, feature_keys: Mapping[int, str], image_ids: Sequence[int]
) -> tuple[dict[Pair, str], dict[Pair, str]]:
    config = run.config.retrieval
    ids = sorted(image_ids, key=lambda image_id: natural_key(run.images[image_id].name))
    row = {image_id: k for k, image_id in enumerate(ids)}

    def named(pairs: Sequence[Pair]) -> set[Pair]:
        return {(min(ids[i], ids[j]), max(ids[i], ids[j])) for i, j in pairs}

    scores = _scores(run, feature_keys, ids)
    pairs = named(promising_pairs(scores, config))
    linked: set[Pair] | None = None
    while True:
        match_keys = match_all(run, feature_keys, sorted(pairs))
        pair_keys = verify_all(run, match_keys)
        before, linked = linked, pairs.intersection(run.database.linked_pairs())
        if linked == before:
            break
        tried, joined = ([(row[i], row[j]) for i, j in some] for some in (pairs, linked))
        links = named(missing_links(scores, tried, joined, config))
        if not links:
            break
        pairs |= links
    _note_partners(run, ids, pairs)
    return match_keys, pair_keys


def _scores(run: Run, feature_keys: Mapping[int, str], ids: Sequence[int]) -> np.ndarray:
    """Matches of probes of every two images, kept in the database until an image or a setting changes."""
    config = run.config.retrieval
    basis = code_digest("sfm.retrieval", "sfm.core"), config.probes, config.probe_ratio
    key = key_of(*basis, [feature_keys[image_id] for image_id in ids])
    upper = np.triu_indices(len(ids), 1)
    stored = json.loads(run.database.meta().get(_NOTE, "{}"))
    scores = np.zeros((len(ids), len(ids)), np.int32)
    if stored.get("key") == key:
        run.observer(StageStarted(stage=STAGE, cached=len(ids)))
        scores[upper] = np.frombuffer(base64.b64decode(stored["scores"]), "<u2")
        scores += scores.T
    else:
        run.observer(StageStarted(stage=STAGE, total=len(ids)))
        probes = [probes_of(run.database.read_features(image_id), config) for image_id in ids]
        scores = pair_scores(probes, config, threads=run.threads)
        packed = base64.b64encode(scores[upper].astype("<u2").tobytes()).decode()
        run.database.set_meta(_NOTE, json.dumps({"key": key, "scores": packed}))
    promising = len(promising_pairs(scores, config))
    run.observer(StageFinished(stage=STAGE, summary=f"{promising} of {len(upper[0])} pairs look promising"))
    return scores


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
