"""Which data make a sample.

Random numbers are those of a 32-bit xorshift generator, kept in 64-bit integers so that compiled and interpreted code
agree and nothing overflows. Samples are drawn without replacement.

Progressive samples, of data in the order of decreasing quality, come from a set that grows from the best data to all
of them (PROSAC): of T draws from all N data, T_n = T Π_{i<m} (n − i) / (N − i) are expected to lie among the best n,
and so many are drawn from there. The draw that takes the n-th datum in always contains it.

References:
    Marsaglia, Xorshift RNGs, Journal of Statistical Software 2003.
    Chum & Matas, Matching with PROSAC, CVPR 2005.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_MASK = 0xFFFFFFFF


@njit(cache=True, nogil=True, error_model="numpy")
def random_index(generator, count):
    """A number below `count` < 2³¹; moves the state `generator` (1,), which must lie in 1 … 2³² − 1."""
    x = generator[0]
    x ^= (x << 13) & _MASK
    x ^= x >> 17
    x ^= (x << 5) & _MASK
    generator[0] = x
    return (x * count) >> 32


@njit(cache=True, nogil=True, error_model="numpy")
def draw(generator, count, size, sample):
    """Fills sample[:size] with distinct numbers below `count` ≥ size."""
    for k in range(size):
        repeated, index = True, 0
        while repeated:
            index, repeated = random_index(generator, count), False
            for j in range(k):
                if sample[j] == index:
                    repeated = True
        sample[k] = index


@njit(cache=True, nogil=True, error_model="numpy")
def draw_samples(generator, count, samples):
    """Fills the rows of `samples` with distinct numbers below `count`."""
    for k in range(samples.shape[0]):
        draw(generator, count, samples.shape[1], samples[k])


@njit(cache=True, nogil=True, error_model="numpy")
def draw_progressively(generator, drawn, reach, count, horizon, growth, samples):
    """As `draw_samples`, for the draws from number `drawn` + 1 on of `horizon`, from at most the best `reach` data.

    `growth` (3,) holds n, T_n and its integer counterpart T'_n; it starts as zeros.
    """
    m = samples.shape[1]
    if growth[0] == 0.0:
        growth[0], growth[1], growth[2] = m, horizon, 1.0
        for i in range(m):
            growth[1] *= (m - i) / (count - i)
    for k in range(samples.shape[0]):
        if drawn + k + 1 > growth[2] and growth[0] < reach:
            larger = growth[1] * (growth[0] + 1.0) / (growth[0] + 1.0 - m)
            growth[2] += np.ceil(larger - growth[1])
            growth[0], growth[1] = growth[0] + 1.0, larger
        n = min(int(growth[0]), reach)
        if drawn + k + 1 > growth[2] or n == m or n < growth[0]:
            draw(generator, n, m, samples[k])
        else:
            draw(generator, n - 1, m - 1, samples[k])
            samples[k, m - 1] = n - 1
