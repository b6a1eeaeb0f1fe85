"""What images and priors themselves contribute to the reduced system, whatever becomes of the points."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from sfm.bundle.layout import Layout
from sfm.core.arrays import FloatArray
from sfm.core.optim.block_pattern import BLOCK, BlockPattern


@dataclasses.dataclass(slots=True)
class ImageSums:
    """What images contribute to a linearisation; k columns of parameters that they share, m shared rows.

    Attributes:
        h: (I, 6) gradient of the frame; f: (I, k) that of the columns.
        F: (I, 6, k) products of the frame's tangent with the columns.
        G: (I, k, k) products of the columns, lower triangle.
    """

    h: np.ndarray
    F: np.ndarray
    G: np.ndarray
    f: np.ndarray

    @staticmethod
    def allocate(images: int, columns: int) -> ImageSums:
        """For that many images and columns."""
        return ImageSums(
            np.zeros((images, BLOCK)), np.zeros((images, BLOCK, columns)),
            np.zeros((images, columns, columns)), np.zeros((images, columns)),
        )  # fmt: skip

    def clear(self) -> None:
        """Sets everything to zero."""
        for part in (self.h, self.F, self.G, self.f):
            part.fill(0)


class RowTerms(NamedTuple):
    """Which blocks of S priors contribute to: (m,) rows and columns, of the lower triangle."""

    rows: np.ndarray
    columns: np.ndarray


class OwnBlocks:
    """Their part of S and its gradient, but for the blocks of poses themselves, which the elimination adds.

    Each number of a linearisation has an entry
    among those of the blocks; the numbers of one entry are added in the order of images, then of terms.
    """

    def __init__(self, layout: Layout, terms: RowTerms, pattern: BlockPattern) -> None:
        slots, columns, self._count = layout.image_slot, layout.columns.shape[1], layout.rows
        self._used = np.arange(columns) < layout.column_count[:, None]
        self._moving = slots >= 0
        # The row of each column of an image, and where it stands there.
        row = np.take_along_axis(layout.image_shared, layout.column_place // BLOCK, axis=1).astype(np.int64)
        inner, six = layout.column_place % BLOCK, np.arange(BLOCK)

        i, k = np.nonzero(self._used & self._moving[:, None])
        j, a, b = np.nonzero(self._used[:, :, None] & self._used[:, None, :] & np.tri(columns, dtype=bool))
        rows = np.concatenate([row[i, k], row[j, a], terms.rows])
        columns_of = np.concatenate([slots[i], row[j, b], terms.columns])
        targets, number = np.unique(rows * self._count + columns_of, return_inverse=True)
        self._rows, self._columns = np.divmod(targets, max(self._count, 1))
        numbers = pattern.find(self._rows, self._columns)
        self._formed = np.flatnonzero(numbers >= 0)
        self._numbers = numbers[self._formed]

        begins = BLOCK * BLOCK * number
        of_columns, of_terms = begins[len(i) : len(i) + len(j)], begins[len(i) + len(j) :]
        # On the diagonal of S, of which G has only the lower triangle.
        above = (row[j, a] == row[j, b]) & (a != b)
        lower = (j * columns + a) * columns + b
        self._from_F = (((BLOCK * i)[:, None] + six) * columns + k[:, None]).ravel()
        self._from_G = np.concatenate([lower, lower[above]])
        self._entries = np.concatenate([
            ((begins[: len(i)] + BLOCK * inner[i, k])[:, None] + six).ravel(),
            of_columns + BLOCK * inner[j, a] + inner[j, b],
            (of_columns + BLOCK * inner[j, b] + inner[j, a])[above],
            (of_terms[:, None] + np.arange(BLOCK * BLOCK)).ravel(),
        ])  # fmt: skip
        self._gradient_entries = np.concatenate([
            (BLOCK * slots[self._moving, None] + six).ravel(), (BLOCK * row + inner)[self._used]
        ])  # fmt: skip
        self._blocks, self.diagonal = np.zeros((len(targets), BLOCK, BLOCK)), np.zeros((self._count, BLOCK))
        """(rows, 6) what they have on the diagonal of S."""

    def set(self, F: FloatArray, G: FloatArray, blocks: FloatArray) -> None:
        """Takes over the sums of a linearisation, and the blocks (m, 6, 6) of the terms."""
        values = np.concatenate([F.take(self._from_F), G.take(self._from_G), blocks.ravel()])
        self._blocks = _summed(self._entries, values, self._blocks.size).reshape(-1, BLOCK, BLOCK)
        own = np.flatnonzero(self._rows == self._columns)
        self.diagonal[self._rows[own]] = self._blocks[own].diagonal(axis1=1, axis2=2)

    def add(self, blocks: FloatArray) -> None:
        """Adds them to those blocks of the reduced system that are formed."""
        blocks[self._numbers, :, :BLOCK] += self._blocks[self._formed]

    def gradient(self, h: FloatArray, f: FloatArray) -> FloatArray:
        """(rows, 6) from those of the images' frames (I, 6) and columns (I, k)."""
        values = np.concatenate([h[self._moving].ravel(), f[self._used]])
        return _summed(self._gradient_entries, values, self._count * BLOCK).reshape(-1, BLOCK)

    def product(self, x: FloatArray) -> FloatArray:
        """What they contribute to S x, for x (rows, 6)."""
        out, beside = np.zeros_like(x), self._rows != self._columns
        np.add.at(out, self._rows, np.einsum("kab,kb->ka", self._blocks, x[self._columns]))
        above = np.einsum("kab,ka->kb", self._blocks[beside], x[self._rows[beside]])
        np.add.at(out, self._columns[beside], above)
        return out


def _summed(entries: np.ndarray, values: FloatArray, count: int) -> FloatArray:
    """(count,) sums of the values of each entry, in their order."""
    return np.bincount(entries, values, count).astype(np.float64, copy=False)  # of nothing it makes integers
