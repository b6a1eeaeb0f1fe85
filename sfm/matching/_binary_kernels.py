"""Distances between rows of bits: all of them, and those between rows that share a hash.

    ones(x)     number of ones in an unsigned integer of 64 bits

The processor has an instruction for it, of which LLVM makes vectors where it can; the plain form below is what runs
when compilation is off.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numba.core import types
from numba.extending import intrinsic, overload


def ones(x):
    """The number of ones in `x`, 64 bits."""
    return np.int64(np.bitwise_count(x))


@intrinsic
def _ctpop(typing_context, x):
    def codegen(context, builder, signature, arguments):
        return builder.ctpop(arguments[0])

    return types.int64(types.uint64), codegen


@overload(ones)
def _ones(x):
    return lambda x: _ctpop(x)  # pyright: ignore[reportCallIssue]


@njit(cache=True, nogil=True)
def scan_bits(words1, words2, best1, second1, index1, best2, second2, index2):
    """The two nearest in both directions, by the number of different bits; strict comparisons: the lower index wins.

    `words1` (N, W) row by row, `words2` (W, M) column by column: neighbours in the inner loops are neighbours in
    memory.
    """
    count = words2.shape[1]
    distances = np.empty(count, np.int32)
    for i in range(words1.shape[0]):
        distances[:] = 0
        for k in range(words1.shape[1]):
            word = words1[i, k]
            for j in range(count):
                distances[j] += np.int32(ones(word ^ words2[k, j]))
        for j in range(count):  # no branches and no dependence between columns: vector instructions
            distance = distances[j]
            index2[j] = np.int32(i) if distance < best2[j] else index2[j]
            second2[j] = min(second2[j], max(distance, best2[j]))
            best2[j] = min(best2[j], distance)
        best, second, index = best1[i], second1[i], index1[i]
        for j in range(count):
            distance = distances[j]
            if distance < second:
                if distance < best:
                    second, best, index = best, distance, np.int32(j)
                else:
                    second = distance
        best1[i], second1[i], index1[i] = best, second, index


@njit(cache=True, nogil=True)
def hash_bits(words, positions, keys):
    """keys[t, i]: the bits of row i at `positions[t]`, the first the highest."""
    for t in range(positions.shape[0]):
        for i in range(words.shape[0]):
            key = np.int32(0)
            for position in positions[t]:
                bit = (words[i, position >> 6] >> np.uint64(position & 63)) & np.uint64(1)
                key = np.int32((key << 1) | np.int32(bit))
            keys[t, i] = key


@njit(cache=True, nogil=True)
def scan_buckets(words1, words2, keys1, starts, order, bits, best1, second1, index1, best2, second2, index2):
    """As `scan_bits` with both tables row by row, for rows whose hashes differ by one bit at most in some table.

    Table t has the rows of image 2 with key k at `order[t, starts[t, k]:starts[t, k + 1]]`.
    """
    met = np.full(words2.shape[0], -1, np.int32)
    for i in range(words1.shape[0]):
        best, second, index = best1[i], second1[i], index1[i]
        for t in range(keys1.shape[0]):
            for probe in range(bits + 1):
                key = keys1[t, i] if probe == bits else keys1[t, i] ^ (1 << probe)
                for place in range(starts[t, key], starts[t, key + 1]):
                    j = order[t, place]
                    if met[j] == i:
                        continue
                    met[j] = np.int32(i)
                    distance = np.int32(0)
                    for k in range(words1.shape[1]):
                        distance += np.int32(ones(words1[i, k] ^ words2[j, k]))
                    if distance < second or (distance == best and j < index):
                        if distance < best or (distance == best and j < index):
                            second, best, index = best, distance, j
                        else:
                            second = distance
                    if distance < second2[j]:
                        if distance < best2[j]:
                            second2[j], best2[j], index2[j] = best2[j], distance, np.int32(i)
                        else:
                            second2[j] = distance
        best1[i], second1[i], index1[i] = best, second, index
