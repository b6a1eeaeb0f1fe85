"""Counting what one image shares with many."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def count_matches(dots, squared1, squared2, offsets, max_ratio_squared, counts):
    """Mutual nearest neighbours of one image and each of several, whose distances pass the ratio test on both sides.

    `dots` (n, M) are products of the image's rows with those of the others, which have the columns
    `offsets[k]:offsets[k + 1]`; distances take their place. `counts` (K,) is filled. All terms are integers below 2²⁴,
    exact in float32. Few columns pass the test for theirs, so only the rows that these have nearest are looked through.
    """
    rows = len(squared1)
    widest = 0
    for k in range(len(counts)):
        widest = max(widest, offsets[k + 1] - offsets[k])
    best_of, second_of, index_of = (
        np.empty(widest, np.float32),
        np.empty(widest, np.float32),
        np.empty(widest, np.int32),
    )
    for k in range(len(counts)):
        first, columns = offsets[k], offsets[k + 1] - offsets[k]
        best, second, index = best_of[:columns], second_of[:columns], index_of[:columns]
        best[:] = np.inf
        second[:] = np.inf
        squared = squared2[first : first + columns]
        for r in range(rows):
            row = dots[r, first : first + columns]
            for c in range(columns):  # no branches and no dependence between columns: vector instructions
                distance = squared1[r] + squared[c] - np.float32(2) * row[c]
                row[c] = distance
                index[c] = np.int32(r) if distance < best[c] else index[c]
                second[c] = min(second[c], max(distance, best[c]))
                best[c] = min(best[c], distance)
        count = 0
        for c in range(columns):
            if best[c] < max_ratio_squared * second[c]:
                row = dots[index[c], first : first + columns]
                near = 0
                for other in range(columns):
                    near += max_ratio_squared * row[other] <= best[c]
                count += near == 1  # itself alone
        counts[k] = count


@njit(cache=True, nogil=True)
def count_votes(image, words, signatures, turns, starts, images, posted, posted_turns, max_hamming, longest, votes):
    """Features of one image for which each image of an inverted file holds one that is alike.

    Alike are features of one word whose signatures differ in at most `max_hamming` bits. They vote for the turn between
    their orientations, in 16ths of a circle; `votes` (I,) is filled with those for the best two adjacent turns. A
    feature votes for an image once; none votes for its own `image`; lists longer than `longest` are passed over.
    """
    by_turn = np.zeros((len(votes), 16), np.int32)
    last = np.full(len(votes), -1, np.int32)
    for k in range(len(words)):
        first, end = starts[words[k]], starts[words[k] + 1]
        if end - first > longest:
            continue
        for p in range(first, end):
            x = signatures[k] ^ posted[p]  # its bits are counted in the way that compilers know as popcount
            x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
            x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
            x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
            bits = np.multiply(x, np.uint64(0x0101010101010101)) >> np.uint64(56)  # as a ufunc it overflows silently
            if np.int64(bits) <= max_hamming and last[images[p]] != k:
                last[images[p]] = k
                by_turn[images[p], (np.int64(turns[k]) - np.int64(posted_turns[p])) & 15] += 1
    for i in range(len(votes)):
        most = 0
        for turn in range(16):
            most = max(most, by_turn[i, turn] + by_turn[i, (turn + 1) & 15])
        votes[i] = most
    votes[image] = 0
