"""Images that show the same place, by votes of their features through an inverted file.

For each visual word the inverted file lists the features of all images that are this word. A feature of the query
meets those on the list of its word alone, and votes for the images of those whose signatures nearly agree with its own.
Two views of a place are turned against each other by about the same angle everywhere, so only the votes for the
commonest turn count.

Images of n features that have nothing in common meet in n² / words pairs of features, of which a few in a thousand
agree by chance. There are n² / 256 words, so that this is a vote or two whatever n; and more where all images together
have so many features that the lists would grow beyond 256 on average. Then chance has less of a say, and fewer votes
make a pair promising.

The cost of an image is a product with 512 centres for each of its features and the lists of its words. Both are
bounded, since the features of all images together are (`max_postings`): an image more costs no more than those before.

Reference:
    Jégou, Douze & Schmid, Hamming embedding and weak geometric consistency, ECCV 2008.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Int32, Int64, UInt8, UInt64

from sfm.core.arrays import Value
from sfm.core.execution import ordered_map
from sfm.core.scene import Features
from sfm.retrieval import _kernels
from sfm.retrieval.config import RetrievalConfig
from sfm.retrieval.preemption import largest
from sfm.retrieval.scores import PairScores, summed_scores
from sfm.retrieval.vocabulary import Vocabulary, quantize, train_vocabulary

_TRAINED_WITH = 300_000
_MOST_WORDS = 65_536
_PER_WORD = 256
"""Pairs of features of two images that are one word by chance; and features of all images that are one word."""
_LEAST_SHARE = 0.4
"""Of `min_votes`, where chance has no say."""
_LONGEST = 8192
"""Features that one word may have. A word of more is on every image, such as the corner of a black border."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class VisualWords(Value):
    """The indexed features of an image: word, signature, and orientation in 16ths of a circle."""

    words: Int32[np.ndarray, " N"]
    signatures: UInt64[np.ndarray, " N"]
    turns: UInt8[np.ndarray, " N"]

    def __len__(self) -> int:
        return len(self.words)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class InvertedFile(Value):
    """The features of all images by word: word w has the entries `starts[w]:starts[w + 1]`, image after image."""

    starts: Int64[np.ndarray, " S"]
    images: Int32[np.ndarray, " P"]
    signatures: UInt64[np.ndarray, " P"]
    turns: UInt8[np.ndarray, " P"]


def similar_images(
    read: Callable[[int], Features],
    images: int,
    config: RetrievalConfig = RetrievalConfig(),
    *,
    seed: int = 0,
    threads: int = 1,
    on_image: Callable[[int], None] = lambda image: None,
) -> PairScores:
    """Votes of every image for every other, both directions added up; the best `candidates` of each image.

    Args:
        read: gives the features of an image 0 … images − 1; called twice for each, in this thread.
        on_image: is told the number of each image when its words are known, which is nearly all of the work.
    Raises:
        ValueError: the descriptors are not SIFT-like (see `train_vocabulary`).
    """
    limit = features_of_each(images, config)
    rng = np.random.default_rng(seed)
    vocabulary = _trained(read, images, limit, rng)
    if vocabulary is None:
        return summed_scores(images, np.zeros((0, 2), np.int64), np.zeros(0, np.int64), config.min_votes)
    shortened = (largest(read(image), limit) for image in range(images))
    words: list[VisualWords] = []
    for some in ordered_map(lambda features: words_of(vocabulary, features), shortened, threads=threads):
        on_image(len(words))
        words.append(some)
    inverted = inverted_file(words, len(vocabulary))

    def of_image(image: int) -> tuple[int, np.ndarray]:
        return image, votes(inverted, words[image], image, images, config)

    pairs, scores = [np.zeros((0, 2), np.int64)], [np.zeros(0, np.int64)]
    for image, counted in ordered_map(of_image, range(images), threads=threads):
        best = np.argsort(-counted, kind="stable")[: config.candidates]
        best = best[counted[best] > 0]
        pairs.append(np.stack([np.full(len(best), image), best], axis=1))
        scores.append(counted[best].astype(np.int64))
    threshold = _threshold(float(np.mean([len(some) for some in words])), len(vocabulary), config)
    return summed_scores(images, np.concatenate(pairs), np.concatenate(scores), threshold)


def features_of_each(images: int, config: RetrievalConfig = RetrievalConfig()) -> int:
    """Features of each image that are indexed."""
    return int(np.clip(config.max_postings // max(images, 1), 1, config.indexed_features))


def words_of(vocabulary: Vocabulary, features: Features) -> VisualWords:
    """The features of an image as the inverted file holds them."""
    words, signatures = quantize(vocabulary, features.descriptors)
    turns = np.floor(features.orientations * (16 / (2 * np.pi))).astype(np.int64) % 16
    return VisualWords(words, signatures, turns.astype(np.uint8))


def inverted_file(words: Sequence[VisualWords], count: int) -> InvertedFile:
    """The file of all images; `count` is the size of the vocabulary."""
    every = np.concatenate([np.zeros(0, np.int32), *(some.words for some in words)])
    order = np.argsort(every, kind="stable")
    owners = np.repeat(np.arange(len(words), dtype=np.int32), [len(some) for some in words])
    starts = np.concatenate([[0], np.cumsum(np.bincount(every, minlength=count))])
    signatures = np.concatenate([np.zeros(0, np.uint64), *(some.signatures for some in words)])
    turns = np.concatenate([np.zeros(0, np.uint8), *(some.turns for some in words)])
    return InvertedFile(starts, owners[order], signatures[order], turns[order])


def votes(
    inverted: InvertedFile, words: VisualWords, image: int, images: int, config: RetrievalConfig = RetrievalConfig()
) -> Int32[np.ndarray, " I"]:
    """Features of `image` that vote for each image, none for itself (−1 for an image that is not in the file)."""
    counted = np.zeros(images, np.int32)
    query = (words.words, words.signatures, words.turns)
    entries = (inverted.starts, inverted.images, inverted.signatures, inverted.turns)
    _kernels.count_votes(image, *query, *entries, config.max_hamming, _LONGEST, counted)
    return counted


def _threshold(features: float, words: int, config: RetrievalConfig) -> int:
    """Votes that make a pair promising, for images of so many features in the mean."""
    by_chance = min(1.0, features**2 / (_PER_WORD * words))
    return round(config.min_votes * (_LEAST_SHARE + (1 - _LEAST_SHARE) * by_chance))


def _trained(read: Callable[[int], Features], images: int, limit: int, rng: np.random.Generator) -> Vocabulary | None:
    """A vocabulary from evenly spaced features of all images; none where there are no features."""
    share, counts, sample = -(-_TRAINED_WITH // max(images, 1)), [], []
    for image in range(images):
        rows = largest(read(image), limit).descriptors
        counts.append(len(rows))
        taken = min(len(rows), share)
        sample.append(rows[np.arange(taken) * len(rows) // max(taken, 1)])
    if not sum(counts):
        return None
    words = min(int(max(np.mean(counts) ** 2, sum(counts))) // _PER_WORD, _MOST_WORDS)
    return train_vocabulary(np.concatenate([rows for rows in sample if len(rows)]), words, rng=rng)
