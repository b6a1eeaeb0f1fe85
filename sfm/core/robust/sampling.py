"""Minimal samples of a problem's data, one after the other."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import Vector
from sfm.core.robust._sampling_kernels import draw_progressively, draw_samples

BATCH = 50
"""Samples drawn at once, at first. Later as many as have been used, so that kernels are called a few times only."""

_AMONG = 20


class Sampler:
    """Samples of indices in a random order that is the same for a seed, however many of them are asked for at a time.

    With qualities, they come from the best data first (see `_sampling_kernels`).
    """

    def __init__(
        self, count: int, size: int, horizon: int, rng: np.random.Generator, quality: Vector | None = None
    ) -> None:
        """For samples of `size` among `count` data; progressive samples are spread over `horizon` draws."""
        self.order = None if quality is None else np.argsort(-quality, kind="stable")
        self.count, self.horizon, self.reach, self.used = count, float(horizon), count, 0
        self._generator, self._growth = rng.integers(1, 2**32, 1), np.zeros(3)
        self._ahead = np.empty((0, size), np.int64)

    def ahead(self, most: int) -> np.ndarray:
        """The next samples, rows of indices, at least one of them and at most `most`."""
        if not len(self._ahead):
            self._ahead = np.empty((max(BATCH, self.used), self._ahead.shape[1]), np.int64)
            if self.order is None:
                draw_samples(self._generator, self.count, self._ahead)
            else:
                reach = (self._generator, self.used, self.reach, self.count, self.horizon, self._growth)
                draw_progressively(*reach, self._ahead)
                self._ahead = self.order[self._ahead]
        return self._ahead[:most]

    def restrict(self, reach: int) -> None:
        """From now on, progressive samples are of the best `reach` data."""
        if reach != self.reach:
            self.reach, self._ahead = reach, self._ahead[:0]

    def use(self, number: int) -> None:
        """Takes as many of the samples ahead away."""
        self._ahead, self.used = self._ahead[number:], self.used + number

    def among(self, chosen: np.ndarray) -> np.ndarray:
        """A few uniform samples of the indices `chosen`, of which there must be more than a sample has."""
        samples = np.empty((_AMONG, self._ahead.shape[1]), np.int64)
        draw_samples(self._generator, len(chosen), samples)
        return chosen[samples]
