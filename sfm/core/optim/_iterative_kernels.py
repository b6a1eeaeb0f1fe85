"""Kernels of the iterative solution: preconditioners and products; see `preconditioners` and `block_product`."""

from __future__ import annotations

import math

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True, error_model="numpy")
def invert_rows(blocks, numbers, damping, held, inverses):
    """Inverse (N, 6, 6) of each block `numbers` plus its damping, zero where held; False: not positive definite."""
    R = np.empty((6, 6))
    for i in range(len(numbers)):
        block, inverse = blocks[numbers[i]], inverses[i]
        for j in range(6):
            # Row by row the factor block = C Cᵀ, and R = C⁻¹, lower triangular both.
            for k in range(j + 1):
                value = block[j, k]
                if held[6 * i + j] or held[6 * i + k]:
                    value = 0.0
                if j == k:
                    value = value + damping[6 * i + j] if not held[6 * i + j] else 1.0
                for m in range(k):
                    value -= inverse[j, m] * inverse[k, m]
                if j > k:
                    inverse[j, k] = value / inverse[k, k]
                elif 0.0 < value < np.inf:
                    inverse[j, j] = math.sqrt(value)
                else:
                    return False
            R[j, j] = 1.0 / inverse[j, j]
            for k in range(j):
                total = 0.0
                for m in range(k, j):
                    total += inverse[j, m] * R[m, k]
                R[j, k] = -total * R[j, j]
        for j in range(6):
            for k in range(j + 1):
                total = 0.0
                for m in range(j, 6):
                    total += R[m, j] * R[m, k]
                if held[6 * i + j] or held[6 * i + k]:
                    total = 0.0
                inverse[j, k] = inverse[k, j] = total
    return True


@nb.njit(cache=True, nogil=True)
def join_pairs(first, second, order, rows, largest):
    """Joins the sets of the pairs in `order` unless they would have more than `largest` rows; the set of each row."""
    parent, size = np.arange(rows), np.ones(rows, np.int64)
    for n in order:
        a, b = first[n], second[n]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a != b and size[a] + size[b] <= largest:
            parent[max(a, b)] = min(a, b)
            size[min(a, b)] = size[a] + size[b]
    for i in range(rows):  # a parent has a smaller number, so it is final by now
        parent[i] = parent[parent[i]]
    return parent


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def add_product(first, last, blocks, offsets, columns, x, y):
    """y += S x for the block rows `first:last` of the lower triangle and what mirrors them; x, y (N, 6)."""
    for i in range(first, last):
        for n in range(offsets[i], offsets[i + 1]):
            j, block = columns[n], blocks[n]
            for a in range(6):
                total, factor = 0.0, x[i, a]
                for b in range(a if i == j else 6):
                    total += block[a, b] * x[j, b]
                    y[j, b] += block[a, b] * factor
                if i == j:
                    total += block[a, a] * factor
                y[i, a] += total
