"""Which fronts of a sparse factor are done at the same time, and where their triangles wait for their parents.

See `sparse_cholesky` for fronts, triangles and the two stacks on which these lie.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfm.core.optim.ordering import Fronts

_JOBS = 8
"""Subtrees of about this part of the work; more would leave more fronts above them, which are done one by one."""


class Schedule(NamedTuple):
    """Subtrees that may be factored at the same time, the fronts above them, and where triangles lie in U.

    Attributes:
        jobs: the fronts of one subtree or several, children before their parents.
        top: the fronts above all of these.
        rest_at: (F,) where the triangle of each front begins.
        size: numbers in U.
    """

    jobs: list[np.ndarray]
    top: np.ndarray
    rest_at: np.ndarray
    size: int


def schedule_of(fronts: Fronts) -> Schedule:
    """Cuts the tree where the subtrees become small; what they leave over waits for the fronts above."""
    parent, seconds = fronts.parent, fronts.seconds
    work, first = seconds.copy(), np.arange(len(parent))
    for f, up in enumerate(parent.tolist()):
        if up >= 0:
            work[up] += work[f]
            first[up] = min(first[up], first[f])
    share = seconds.sum() / _JOBS
    is_top = work > share
    roots = np.flatnonzero(~is_top & ((parent < 0) | is_top[parent]))
    jobs: list[list[int]] = []
    room = 0.0
    for root in roots.tolist():
        if not jobs or work[root] > room:
            jobs.append([])
            room = share
        jobs[-1].extend(range(first[root], root + 1))
        room -= work[root]
    stacks, waiting = _Stacks(fronts, roots), int(fronts.rest_sizes[roots].sum())
    size = waiting
    for job in jobs:
        size = stacks.place(job, size)
    # The stacks of the jobs are empty when the fronts above begin with theirs.
    top = np.flatnonzero(is_top)
    size = max(size, stacks.place(top.tolist(), waiting))
    return Schedule([np.array(job, np.int64) for job in jobs], top, stacks.rest_at, size)


class _Stacks:
    """Where triangles lie in U: first those of the `roots` of subtrees, which wait; then two stacks for each job."""

    def __init__(self, fronts: Fronts, roots: np.ndarray) -> None:
        parent, sizes = fronts.parent, fronts.rest_sizes
        self.rest_at = np.zeros(len(parent), np.int64)
        self.rest_at[roots] = np.cumsum(sizes[roots]) - sizes[roots]
        self._depth = np.zeros(len(parent), np.int64)
        for f in np.flatnonzero(parent >= 0)[::-1]:
            self._depth[f] = self._depth[parent[f]] + 1
        self._own = sizes.copy()
        self._own[roots] = 0
        self._of_children = np.zeros(len(parent), np.int64)
        np.add.at(self._of_children, parent[parent >= 0], self._own[parent >= 0])

    def place(self, job: list[int], begin: int) -> int:
        """Places the triangles of a job's fronts from `begin` on, and returns where they end."""
        heights, peaks, offsets = [0, 0], [0, 0], []
        for f in job:
            side = int(self._depth[f] % 2)
            offsets.append(heights[side])
            heights[side] += int(self._own[f])
            peaks[side] = max(peaks[side], heights[side])
            heights[1 - side] -= int(self._of_children[f])
        for f, offset in zip(job, offsets, strict=True):
            if self._own[f]:
                self.rest_at[f] = begin + offset + (peaks[0] if self._depth[f] % 2 else 0)
        return begin + sum(peaks)
