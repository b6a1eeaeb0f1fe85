"""The order in which kernels see a problem.

What is left after the elimination of points comes in rows of six (`sfm.core.optim.block_pattern`): first the poses of
frames that may move, then *shared rows*, which several images have: cameras, sensors on a rig, biases (see
`shared_rows`). A frame is what moves as one: the images of one moment of a rig, or a single image.

Observations are kept in two orders. By images they are evaluated, many at once. By points, and within a point by the
row (`slot`) of their frame, they are eliminated; those of frames that do not move come first there, with slot −1.
A *coupling* is a point together with a row that its observations depend on; only points that may move couple to shared
rows.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np

from sfm.bundle import _layout_kernels as kernels
from sfm.bundle.problem import BundleProblem
from sfm.bundle.shared_rows import SharedRows, columns_of_images, rows_of_images, shared_couplings, shared_rows
from sfm.core.execution import chunk_bounds
from sfm.core.optim.block_pattern import BLOCK, BlockPattern

_OBSERVATIONS_PER_CHUNK, _MAX_CHUNKS = 16384, 16
"""At most, and chunks are a power of two: three would keep one of two threads waiting."""
_OWN_WORK, _NARROW_WORK = 4.0, 0.6
"""What a coupling takes beside its products with others, and what a product of three rows takes instead of six."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The sorted problem; see the module.

    Attributes:
        original: (n,) the observation of the problem that stands in each place of the order by points.
        image_offsets: (I + 1,) observations of each image; image_point, observed, precision their columns in this
            order, place (n,) where each stands in the order by points.
        offsets: (P + 1,) observations of each point; image, obs_slot their columns in this order.
        image_frame: (I,) and frame_slot (F,): the frame of each image and its row, −1 where it does not move;
            slot_frame (S,) the inverse; image_slot (I,) the row of each image's frame.
        shared: the rows behind those of poses; shared row k is row S + k.
        image_shared: (I, m) the shared rows of each image as numbers of rows, ascending, −1 for none.
        column_count, columns, column_place: (I,) how many free columns an image shares, (I, k) which, and where they
            stand among the 6 m places of its shared rows.
        starts, slot: couplings with poses by point (P + 1,), (E,).
        shared_starts, shared_slot: those with shared rows, (P + 1,), (G,); obs_shared (n, m) that of an observation.
        point_chunks, image_chunks: ranges of points and of images with about the same number of observations.
    """

    original: np.ndarray
    image_offsets: np.ndarray
    image_point: np.ndarray
    observed: np.ndarray
    precision: np.ndarray
    place: np.ndarray
    offsets: np.ndarray
    image: np.ndarray
    obs_slot: np.ndarray
    image_frame: np.ndarray
    frame_slot: np.ndarray
    slot_frame: np.ndarray
    image_slot: np.ndarray
    shared: SharedRows
    image_shared: np.ndarray
    column_count: np.ndarray
    columns: np.ndarray
    column_place: np.ndarray
    starts: np.ndarray
    slot: np.ndarray
    shared_starts: np.ndarray
    shared_slot: np.ndarray
    obs_shared: np.ndarray
    point_chunks: list[tuple[int, int]]
    image_chunks: list[tuple[int, int]]

    @property
    def point(self) -> np.ndarray:
        """(n,) the point of each observation in the order by points."""
        return np.repeat(np.arange(len(self.offsets) - 1), np.diff(self.offsets))

    @property
    def rows(self) -> int:
        """Number of rows of six."""
        return len(self.slot_frame) + len(self.shared)

    @property
    def padding(self) -> np.ndarray:
        """(rows, 6) places that are no unknowns."""
        return np.concatenate([np.zeros((len(self.slot_frame), BLOCK), bool), self.shared.columns < 0])

    @property
    def is_narrow(self) -> bool:
        """Whether no shared row has more than three unknowns."""
        return not np.any(self.shared.columns[:, 3:] >= 0)

    @property
    def parameters(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(K,) camera and column of each free camera parameter, its row of six and its place there."""
        shared = self.shared
        row, place = np.nonzero((shared.columns >= 0) & (shared.camera >= 0)[:, None])
        return shared.camera[row], shared.columns[row, place], len(self.slot_frame) + row, place

    @property
    def image_sensor_row(self) -> np.ndarray:
        """(I,) the row of each image's sensor, −1 where it has none that moves."""
        mounts = len(self.slot_frame) + np.flatnonzero(self.shared.sensor >= 0)
        rows = np.where(np.isin(self.image_shared, mounts), self.image_shared, -1)
        return rows.max(axis=1, initial=-1).astype(np.int64)

    def pattern(self, rows: np.ndarray, columns: np.ndarray) -> BlockPattern:
        """The blocks of S that points and images fill, and those in `rows` and `columns`, of the lower triangle."""
        marked = np.zeros((self.rows, self.rows // 64 + 1), np.uint64)
        kernels.mark_pairs(self.starts, self.slot, self.shared_starts, self.shared_slot, marked)
        for k in range(self.image_shared.shape[1]):
            for other in (self.image_slot, *self.image_shared[:, :k].T):
                both = (self.image_shared[:, k] >= 0) & (other >= 0)
                kernels.mark(self.image_shared[both, k], other[both], marked)
        kernels.mark(rows.astype(np.int32), columns.astype(np.int32), marked)
        return BlockPattern(*kernels.marked_blocks(marked))

    def row_ranges(self, parts: int) -> list[tuple[int, int]]:
        """Ranges of rows that take about the same work to eliminate, in products of blocks."""
        if parts == 1:
            return [(0, self.rows)] if self.rows else []
        point = np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))
        work = np.bincount(self.slot, np.arange(len(self.slot)) - self.starts[point] + _OWN_WORK, self.rows)
        point = np.repeat(np.arange(len(self.starts) - 1), np.diff(self.shared_starts))
        before = np.arange(len(self.shared_slot)) - self.shared_starts[point] + np.diff(self.starts)[point]
        product = _NARROW_WORK if self.is_narrow else 1.0
        # Integers where nothing is counted.
        work = work + np.bincount(self.shared_slot, product * before + _OWN_WORK, self.rows)
        running = np.cumsum(work)
        cuts = np.searchsorted(running, np.arange(1, parts) * (running[-1] / parts) if len(running) else [])
        edges = [0, *(int(cut) + 1 for cut in cuts), self.rows]
        return [(a, min(b, self.rows)) for a, b in itertools.pairwise(edges) if a < min(b, self.rows)]


def lay_out(problem: BundleProblem, active: np.ndarray) -> Layout:
    """Sorts the observations of `problem` that are `active` (n,) and numbers its free rows."""
    images, points = len(problem.image_cameras), len(problem.points3D)
    image_frame, free_frames = _frames(problem)
    by_point, _ = kernels.sort_rows(np.flatnonzero(active).astype(np.int32), problem.obs_points, points)
    by_image, image_offsets = kernels.sort_rows(by_point, problem.obs_images, images)
    seen = np.diff(image_offsets) > 0
    frame_seen = np.bincount(image_frame[seen], minlength=len(free_frames)) > 0
    frame_slot, slot_frame = _number(free_frames & frame_seen)
    image_slot = frame_slot[image_frame]
    by_slot = by_image
    if np.any(image_slot[1:] < image_slot[:-1]):
        keys = image_slot.take(problem.obs_images) + 1
        keys.flags.writeable = False  # as the columns of the problem are: so the kernel is compiled once
        by_slot, _ = kernels.sort_rows(by_image, keys, len(slot_frame) + 1)
    by_point, offsets = kernels.sort_rows(by_slot, problem.obs_points, points)
    image = problem.obs_images.take(by_point)
    point, slots = np.repeat(np.arange(points), np.diff(offsets)), image_slot.take(image)
    position = np.empty(len(active), np.int32)
    position[by_point] = np.arange(len(by_point), dtype=np.int32)

    shared = shared_rows(problem, seen)
    image_shared = rows_of_images(problem, shared, len(slot_frame))
    columns, column_place, column_count = columns_of_images(shared, image_shared - len(slot_frame))
    obs_shared, shared_point, shared_slot = shared_couplings(
        point, image_shared.take(image, axis=0), problem.free_points, len(slot_frame) + len(shared)
    )
    couples = (slots >= 0) & _changes(point, slots)
    chunks = min(1 << max(math.ceil(len(point) / _OBSERVATIONS_PER_CHUNK) - 1, 0).bit_length(), _MAX_CHUNKS)
    return Layout(
        original=by_point,
        image_offsets=image_offsets,
        image_point=problem.obs_points.take(by_image),
        observed=problem.obs_points2D.take(by_image, axis=0),
        precision=np.ones(len(by_image)) if problem.obs_sigmas is None else 1 / problem.obs_sigmas[by_image],
        place=position.take(by_image),
        offsets=offsets,
        image=image,
        obs_slot=slots,
        image_frame=image_frame,
        frame_slot=frame_slot,
        slot_frame=slot_frame,
        image_slot=image_slot,
        shared=shared,
        image_shared=image_shared,
        column_count=column_count,
        columns=columns,
        column_place=column_place,
        starts=_offsets(point[couples], points),
        slot=slots[couples],
        shared_starts=_offsets(shared_point, points),
        shared_slot=shared_slot,
        obs_shared=obs_shared,
        point_chunks=_even_ranges(offsets, chunks),
        image_chunks=_even_ranges(image_offsets, chunks),
    )


def _frames(problem: BundleProblem) -> tuple[np.ndarray, np.ndarray]:
    """The frame of each image (I,), and which frames (F,) may move: those all of whose images may."""
    if problem.rigs is None:
        return np.arange(len(problem.image_cameras), dtype=np.int32), problem.free_poses
    frames = problem.rigs.image_frames
    count = len(problem.rigs.rigs_from_world)
    return frames, np.bincount(frames[~problem.free_poses], minlength=count) == 0


def _number(used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Consecutive numbers for the rows that are used (−1 for the others), and the rows by number."""
    rows = np.flatnonzero(used).astype(np.int32)
    numbers = np.full(len(used), -1, np.int32)
    numbers[rows] = np.arange(len(rows))
    return numbers, rows


def _changes(point: np.ndarray, slots: np.ndarray) -> np.ndarray:
    """Where a new coupling begins."""
    first = np.ones(len(point), bool)
    first[1:] = (point[1:] != point[:-1]) | (slots[1:] != slots[:-1])
    return first


def _offsets(point: np.ndarray, points: int) -> np.ndarray:
    """(points + 1,) where each point begins among sorted ones."""
    return np.concatenate([[0], np.cumsum(np.bincount(point, minlength=points))])


def _even_ranges(offsets: np.ndarray, chunks: int) -> list[tuple[int, int]]:
    """Ranges of points or images, cut where the observations are shared out evenly."""
    count = len(offsets) - 1
    cuts = [int(np.searchsorted(offsets, last)) for _, last in chunk_bounds(int(offsets[-1]), chunks)]
    edges = [0, *cuts[:-1], count]
    return [(a, b) for a, b in itertools.pairwise(edges) if a < b] or [(0, count)]
