"""A vocabulary of visual words, learned from the descriptors of the images themselves.

k-means cuts the space of descriptors into some 256 branches, and each branch into as many words: a word is found by
comparing with 512 centres instead of 65,536. Within its word a descriptor is told from others by a signature of 64
bits: each says on which side of the median of its branch one of 64 projections lies. Signatures of one point of the
scene in two images differ in few bits, those of different points in half of them.

The projections are the lowest frequencies of the descriptor along the 4 × 4 cells (cosines) and around the 8
orientations (Fourier), which hold nine tenths of the variance of SIFT. Like the centres they are rounded to integers:
then all products are integers below 2²⁴, exact in float32, and no result depends on the order in which a processor
sums.

References:
    Nistér & Stewénius, Scalable recognition with a vocabulary tree, CVPR 2006.
    Jégou, Douze & Schmid, Hamming embedding and weak geometric consistency, ECCV 2008, § 3.
"""

from __future__ import annotations

import dataclasses
import math
from functools import cache

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt8, UInt64

from sfm.core.arrays import Value

_DIMENSIONS = 128
_BITS = 64
_MOST_BRANCHES = 256
_ROUNDS = 3
"""Of k-means; six find no more pairs."""
_SAMPLE = 300_000
"""Descriptors that are learned from: five for each of the most words; 150 MB."""
_TOP_SAMPLE_PER_BRANCH = 160
_DESCRIPTORS_PER_WORD = 4
"""At least; fewer, and views of one point part into different words."""
_BLOCK_ROWS = 4096


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Vocabulary(Value):
    """Branches and their words.

    Attributes:
        branches: centres of the branches, whole numbers.
        words, starts: branch b has the words `words[starts[b]:starts[b + 1]]`, whole numbers too.
        medians: of the 64 projections in each branch.
    """

    branches: Float32[np.ndarray, "B D"]
    words: Float32[np.ndarray, "W D"]
    starts: Int64[np.ndarray, " S"]
    medians: Float32[np.ndarray, "B 64"]

    def __len__(self) -> int:
        return len(self.words)


def train_vocabulary(descriptors: UInt8[np.ndarray, "N D"], words: int, *, rng: np.random.Generator) -> Vocabulary:
    """About `words` visual words of SIFT-like descriptors, at most a quarter as many as there are descriptors.

    Raises:
        ValueError: the descriptors are none or have not 128 numbers: those of binary detectors have no means.
    """
    _check(descriptors)
    if len(descriptors) == 0:
        raise ValueError("a vocabulary needs descriptors to learn from")
    rows = _some(descriptors, _SAMPLE, rng).astype(np.float32)
    width = int(np.clip(math.isqrt(max(1, min(words, len(rows) // _DESCRIPTORS_PER_WORD))), 1, _MOST_BRANCHES))
    branches = k_means(_some(rows, _TOP_SAMPLE_PER_BRANCH * width, rng), width, rng)
    labels = nearest(rows, branches)
    projected = rows @ _projections()
    leaves, medians = [], np.zeros((width, _BITS), np.float32)
    for branch, members in enumerate(_grouped(labels, width)):
        inside = rows[members]
        leaves.append(
            k_means(inside, min(width, max(1, len(inside) // _DESCRIPTORS_PER_WORD)), rng)
            if len(inside)
            else branches[[branch]]
        )
        medians[branch] = np.floor(np.median(projected[members], axis=0)) if len(members) else 0
    starts = np.cumsum([0] + [len(leaf) for leaf in leaves])
    return Vocabulary(branches, np.concatenate(leaves), starts, medians)


def quantize(
    vocabulary: Vocabulary, descriptors: UInt8[np.ndarray, "N D"]
) -> tuple[Int32[np.ndarray, " N"], UInt64[np.ndarray, " N"]]:
    """The word and the signature of each descriptor.

    Raises:
        ValueError: the descriptors have not 128 numbers.
    """
    _check(descriptors)
    rows = descriptors.astype(np.float32)
    labels = nearest(rows, vocabulary.branches)
    words = np.empty(len(rows), np.int32)
    for branch, members in enumerate(_grouped(labels, len(vocabulary.branches))):
        if len(members):
            first, end = vocabulary.starts[branch : branch + 2]
            words[members] = first + nearest(rows[members], vocabulary.words[first:end])
    bits = rows @ _projections() > vocabulary.medians[labels]
    return words, np.packbits(bits, axis=1).view("<u8")[:, 0].astype(np.uint64)


def nearest(rows: Float32[np.ndarray, "N D"], centers: Float32[np.ndarray, "K D"]) -> Int32[np.ndarray, " N"]:
    """The centre nearest to each row; the first of equals. |x − c|² is smallest where x · c − ½ |c|² is largest."""
    half_squared = np.einsum("ij,ij->i", centers, centers) / 2
    labels = np.empty(len(rows), np.int32)
    for start in range(0, len(rows), _BLOCK_ROWS):
        block = slice(start, start + _BLOCK_ROWS)
        labels[block] = np.argmax(rows[block] @ centers.T - half_squared, axis=1)
    return labels


def k_means(rows: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """`count` whole-numbered centres by Lloyd's rounds from random rows; a centre that loses all of its rows stays."""
    centers = _some(rows, count, rng).copy()
    for _ in range(_ROUNDS):
        labels = nearest(rows, centers)
        order = np.argsort(labels, kind="stable")
        sizes = np.bincount(labels, minlength=len(centers))
        used = np.flatnonzero(sizes)
        starts = (np.cumsum(sizes) - sizes)[used]
        centers[used] = np.rint(np.add.reduceat(rows[order], starts, axis=0, dtype=np.float64) / sizes[used, None])
    return centers


def _grouped(labels: np.ndarray, count: int) -> list[np.ndarray]:
    """The positions of each label 0 … count − 1, ascending."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.cumsum(np.bincount(labels, minlength=count))[:-1])


def _some(rows: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """At most `count` of the rows, chosen by chance, in their order."""
    return rows if len(rows) <= count else rows[np.sort(rng.choice(len(rows), count, replace=False))]


@cache
def _projections() -> np.ndarray:
    """(128, 64) the lowest frequencies without the constant, 64 times as long as unit vectors, in integers."""
    cell = np.arange(4)
    cosines = np.array([np.cos(np.pi * k * (2 * cell + 1) / 8) * math.sqrt((1 if k else 0.5) / 2) for k in range(4)])
    angle = 2 * np.pi * np.arange(8) / 8
    waves = [(0, np.full(8, 8**-0.5)), (4, np.cos(4 * angle) * 8**-0.5)]
    waves += [(k, wave(k * angle) / 2) for k in (1, 2, 3) for wave in (np.cos, np.sin)]
    terms = [
        (y + x + k, k, np.einsum("i,j,k->ijk", cosines[y], cosines[x], wave).ravel())
        for y in range(4)
        for x in range(4)
        for k, wave in waves
    ]
    terms.sort(key=lambda term: term[:2])
    return np.rint(64 * np.stack([vector for *_, vector in terms[1 : 1 + _BITS]], axis=1)).astype(np.float32)


def _check(descriptors: np.ndarray) -> None:
    if descriptors.shape[1] != _DIMENSIONS or descriptors.dtype != np.uint8:
        got = f"{descriptors.shape[1]} of {descriptors.dtype}"
        raise ValueError(f"visual words need descriptors of {_DIMENSIONS} numbers of uint8 such as SIFT's, got {got}")
