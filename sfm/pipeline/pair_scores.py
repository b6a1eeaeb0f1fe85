"""What pairs of images have in common, kept in the database.

Matches of probes depend on their two images alone: a new photo is compared with the others, and these not again among
themselves. Votes depend on the vocabulary, which all images make together; they are counted anew for all, some 20 ms an
image.
"""

from __future__ import annotations

import base64
import itertools
import json
import zlib
from collections.abc import Mapping, Sequence

import numpy as np

from sfm.core.events import ImageCompared, StageFinished, StageStarted
from sfm.core.scene import DescriptorKind
from sfm.pipeline.keys import code_digest, key_of
from sfm.pipeline.stages import Run
from sfm.retrieval import PairScores, probe_scores, probes_of, promising_pairs, similar_images
from sfm.retrieval.aggregation import aggregated_partners

STAGE = "pairs"
_NOTE = "pair_scores"


def scores_of(run: Run, feature_keys: Mapping[int, str], ids: Sequence[int]) -> PairScores:
    """Votes or matches of probes of pairs of rows of `ids`; from the database where nothing has changed."""
    basis = key_of(code_digest("sfm.retrieval", "sfm.core"), run.config.retrieval, run.config.seed)
    keys = [feature_keys[image_id] for image_id in ids]
    stored = _stored(run, basis)
    if stored and stored[0] == keys:
        run.observer(StageStarted(stage=STAGE, cached=len(ids)))
        scores = stored[1]
    else:
        run.observer(StageStarted(stage=STAGE, total=len(ids)))
        scores = _computed(run, ids, keys, stored)
        _store(run, basis, keys, scores)
    promising = len(promising_pairs(scores, run.config.retrieval))
    of = len(ids) * (len(ids) - 1) // 2
    run.observer(StageFinished(stage=STAGE, summary=f"{promising} of {of} pairs look promising"))
    return scores


def has_visual_words(run: Run, ids: Sequence[int]) -> bool:
    """Whether the descriptors are such that a vocabulary can be made of them."""
    return run.database.read_features(ids[0]).kind == DescriptorKind.SIFT


def _computed(
    run: Run, ids: Sequence[int], keys: Sequence[str], stored: tuple[list[str], PairScores] | None
) -> PairScores:
    config, seed, threads = run.config.retrieval, run.config.seed, run.threads

    def tell(image: int) -> None:
        run.observer(ImageCompared(name=run.images[ids[image]].name))

    words = has_visual_words(run, ids)
    if config.method != "look" and words and config.similarity == "votes":
        return similar_images(
            lambda k: run.database.read_features(ids[k]), len(ids), config, seed=seed, threads=threads, on_image=tell
        )
    known = _known(stored, keys)
    probes = [probes_of(run.database.read_features(image_id), config) for image_id in ids]
    if config.method == "look" or not words:
        candidates = set(itertools.combinations(range(len(ids)), 2))
    else:
        candidates = set(aggregated_partners(lambda k: run.database.read_features(ids[k]), len(ids), config, seed=seed))
    missing = sorted(candidates.difference(known))
    found = probe_scores(probes, config, pairs=missing, threads=threads, on_image=tell)
    everything = {pair: score for pair, score in known.items() if pair in candidates}
    everything |= {(i, j): score for (i, j), score in zip(found.pairs.tolist(), found.scores.tolist(), strict=True)}
    order = sorted(everything)
    return PairScores(
        len(ids),
        np.array(order, np.int32).reshape(-1, 2),
        np.array([everything[pair] for pair in order], np.int32),
        config.min_score,
    )


def _known(stored: tuple[list[str], PairScores] | None, keys: Sequence[str]) -> dict[tuple[int, int], int]:
    """The stored scores of pairs of which both images are still there, by their present rows."""
    if stored is None:
        return {}
    row = {key: k for k, key in enumerate(keys)}
    now = [row.get(key, -1) for key in stored[0]]
    pairs, scores = stored[1].pairs.tolist(), stored[1].scores.tolist()
    moved = ((now[i], now[j], score) for (i, j), score in zip(pairs, scores, strict=True))
    return {(min(i, j), max(i, j)): score for i, j, score in moved if min(i, j) >= 0 and i != j}


def _stored(run: Run, basis: str) -> tuple[list[str], PairScores] | None:
    """The keys of the images and the scores of an earlier run with these settings."""
    note = json.loads(run.database.meta().get(_NOTE, "{}"))
    if note.get("basis") != basis:
        return None
    rows = np.frombuffer(zlib.decompress(base64.b64decode(note["rows"])), "<i4").reshape(-1, 3)
    return note["keys"], PairScores(len(note["keys"]), rows[:, :2], rows[:, 2], note["threshold"])


def _store(run: Run, basis: str, keys: Sequence[str], scores: PairScores) -> None:
    rows = np.column_stack([scores.pairs, scores.scores]).astype("<i4")
    packed = base64.b64encode(zlib.compress(rows.tobytes(), 1)).decode()
    note = {"basis": basis, "keys": list(keys), "threshold": scores.threshold, "rows": packed}
    run.database.set_meta(_NOTE, json.dumps(note))
