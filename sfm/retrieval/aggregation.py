"""Candidates by one vector for each image: bags of words, VLAD or Fisher vectors.

They find less than the votes of single features, which keep apart what a vector adds up: among 20 partners 93, 89 and
89 % of the true ones, votes 98 %. They are here to compare with. Candidates are ranked by their matches of probes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sfm.core.scene import Features
from sfm.retrieval.bag_of_words import bag_partners, weighed_bags
from sfm.retrieval.config import RetrievalConfig
from sfm.retrieval.fisher import fisher_vector, train_mixture
from sfm.retrieval.pairs import Pair, exhaustive_pairs
from sfm.retrieval.preemption import largest
from sfm.retrieval.vlad import vector_partners, vlad
from sfm.retrieval.vocabulary import k_means, quantize, train_vocabulary

_FEATURES = 2000
"""Of largest scale of each image; more do not help a vector."""
_WORDS = 16_384
_CENTERS, _COMPONENTS = 64, 32
_SAMPLE = 100_000


def aggregated_partners(
    read: Callable[[int], Features], images: int, config: RetrievalConfig = RetrievalConfig(), *, seed: int = 0
) -> list[Pair]:
    """Each image with the `candidates` others of most similar vectors; all pairs where so many are not there.

    Args:
        read: gives the SIFT-like features of an image 0 … images − 1.
    Raises:
        ValueError: `config.similarity` is none of tfidf, vlad and fisher.
    """
    if images <= config.candidates + 1:
        return exhaustive_pairs(range(images))
    rng = np.random.default_rng(seed)

    def descriptors(image: int) -> np.ndarray:
        return largest(read(image), _FEATURES).descriptors

    sample = np.concatenate([_spread(descriptors(image), -(-_SAMPLE // images)) for image in range(images)])
    match config.similarity:
        case "tfidf":
            vocabulary = train_vocabulary(sample, _WORDS, rng=rng)
            words = [quantize(vocabulary, descriptors(image))[0] for image in range(images)]
            return bag_partners(weighed_bags(words, len(vocabulary)), config.candidates)
        case "vlad":
            centers = k_means(sample.astype(np.float32), _CENTERS, rng)
            vectors = [vlad(descriptors(image), centers) for image in range(images)]
        case "fisher":
            mixture = train_mixture(sample, min(_COMPONENTS, len(sample) // 2), rng=rng)
            vectors = [fisher_vector(mixture, descriptors(image)) for image in range(images)]
        case _:
            raise ValueError(f"no vector is called {config.similarity!r}")
    return vector_partners(np.stack(vectors), config.candidates)


def _spread(rows: np.ndarray, count: int) -> np.ndarray:
    """At most `count` rows, evenly spaced."""
    count = min(count, len(rows))
    return rows[np.arange(count) * len(rows) // max(count, 1)]
