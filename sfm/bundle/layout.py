"""The order in which kernels see a problem.

Observations are sorted by point and, within a point, by the row (`slot`) of their pose in the normal equations;
those of poses that do not move come first, with slot −1. A *coupling* is a point together with a camera that has free
parameters and sees it. Free parameters of each camera are counted from the left into K columns, K the largest such
number; cameras with fewer have padding, which the solver holds at zero.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from sfm.bundle.problem import BundleProblem
from sfm.core.execution import chunk_bounds

_OBSERVATIONS_PER_CHUNK = 8192
_MAX_CHUNKS = 16
_JOBS = 8
_PRODUCTS_PER_COPY = 8
"""Products for each block of the reduced matrix from which a further copy of it pays: adding one costs about as much
as a product."""
_MAX_COPIES_BYTES = 1 << 26


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The sorted problem; see the module.

    Attributes:
        offsets: (P + 1,) observations of each point; image, observed their columns.
        pose_slot: (I,) row of the pose, −1 where it does not move; slot_image (S,) the inverse.
        camera_slot, image_slot: (C,) and (I,) row of the camera; slot_camera (T,) the inverse.
        columns: (C, K) index of the parameter in each column, −1 for padding.
        starts: (P,) first observation of the point that has a slot, the end of its run where the point is fixed.
        obs_slot, obs_coupling: (n,) rows of `pose_slot` and of couplings.
        coupling_offsets, coupling_point, coupling_slot: couplings by point.
        point_chunks: ranges of points with about the same number of observations.
        copies: of the reduced system.
        jobs, coupling_jobs: (copy, observations) and (copy, couplings) to eliminate, about the same work in each.
    """

    offsets: np.ndarray
    image: np.ndarray
    point: np.ndarray
    observed: np.ndarray
    precision: np.ndarray
    pose_slot: np.ndarray
    slot_image: np.ndarray
    image_slot: np.ndarray
    slot_camera: np.ndarray
    columns: np.ndarray
    starts: np.ndarray
    obs_slot: np.ndarray
    obs_coupling: np.ndarray
    coupling_offsets: np.ndarray
    coupling_point: np.ndarray
    coupling_slot: np.ndarray
    point_chunks: list[tuple[int, int]]
    copies: int
    jobs: list[tuple[int, np.ndarray]]
    coupling_jobs: list[tuple[int, np.ndarray]]


def lay_out(problem: BundleProblem, active: np.ndarray) -> Layout:
    """Sorts the observations of `problem` that are `active` (n,) and numbers its free blocks."""
    images, points = len(problem.image_cameras), len(problem.points3D)
    image, point = problem.obs_images[active], problem.obs_points[active].astype(np.int64)
    seen = np.bincount(image, minlength=images) > 0
    pose_slot, slot_image = _number(problem.free_poses & seen)
    slots = pose_slot[image]
    order = _sorting(point * (len(slot_image) + 1) + slots + 1)
    image, point, slots = image[order], point[order], slots[order]
    offsets = np.searchsorted(point, np.arange(points + 1))

    camera_seen = np.bincount(problem.image_cameras[seen], minlength=len(problem.model_ids)) > 0
    camera_slot, slot_camera = _number(problem.free_params.any(axis=1) & camera_seen)
    image_slot = camera_slot[problem.image_cameras]
    coupling, coupling_point, coupling_slot = _couplings(
        point, image_slot[image], problem.free_points, len(slot_camera)
    )
    coupling_offsets = np.searchsorted(coupling_point, np.arange(points + 1))

    starts = offsets[:-1] + np.bincount(point, weights=slots < 0, minlength=points).astype(np.int64)
    starts = np.where(problem.free_points, starts, offsets[1:])
    eliminated = np.flatnonzero((slots >= 0) & problem.free_points[point])
    work = eliminated - starts[point[eliminated]] + 1
    coupled = np.arange(len(coupling_point))
    coupling_work = coupled - coupling_offsets[coupling_point] + 1
    chunks = int(np.clip(len(point) // _OBSERVATIONS_PER_CHUNK, 1, _MAX_CHUNKS))
    columns = _columns(np.where(camera_seen[:, None], problem.free_params, False))
    copies, stripes = _sharing(int(work.sum()), len(slot_image), columns.shape[1] * len(slot_camera), chunks)
    return Layout(
        offsets=offsets,
        image=image,
        point=point.astype(np.int32),
        observed=problem.obs_points2D[active][order],
        precision=_precision(problem, active)[order],
        pose_slot=pose_slot,
        slot_image=slot_image,
        image_slot=image_slot,
        slot_camera=slot_camera,
        columns=columns,
        starts=starts,
        obs_slot=slots,
        obs_coupling=coupling,
        coupling_offsets=coupling_offsets,
        coupling_point=coupling_point,
        coupling_slot=coupling_slot,
        point_chunks=_point_chunks(offsets, chunks),
        copies=copies,
        jobs=_jobs(eliminated, slots[eliminated], work, copies, stripes),
        coupling_jobs=_jobs(coupled, coupling_slot, coupling_work, copies, stripes),
    )


def _precision(problem: BundleProblem, active: np.ndarray) -> np.ndarray:
    """1 / σ of the active observations."""
    return np.ones(int(active.sum())) if problem.obs_sigmas is None else 1 / problem.obs_sigmas[active]


def _number(used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Consecutive numbers for the rows that are used (−1 for the others), and the rows by number."""
    rows = np.flatnonzero(used).astype(np.int32)
    numbers = np.full(len(used), -1, np.int32)
    numbers[rows] = np.arange(len(rows))
    return numbers, rows


def _sorting(keys: np.ndarray) -> np.ndarray | slice:
    """A stable order of the keys; nothing to do where they are sorted already."""
    return slice(None) if np.all(keys[:-1] <= keys[1:]) else np.argsort(keys, kind="stable")


def _couplings(
    point: np.ndarray, slot: np.ndarray, free_points: np.ndarray, cameras: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The coupling of each observation (−1 for none), and point and camera slot of each coupling."""
    coupling = np.full(len(point), -1, np.int32)
    takes_part = (slot >= 0) & free_points[point]
    keys = point[takes_part] * max(cameras, 1) + slot[takes_part]
    unique, inverse = np.unique(keys, return_inverse=True)
    coupling[takes_part] = inverse
    return coupling, (unique // max(cameras, 1)).astype(np.int32), (unique % max(cameras, 1)).astype(np.int32)


def _columns(free: np.ndarray) -> np.ndarray:
    """(C, K) indices of the free parameters, padded with −1."""
    counts = free.sum(axis=1)
    columns = np.full((len(free), int(counts.max(initial=0))), -1, np.int32)
    rows, indices = np.nonzero(free)
    columns[rows, np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)] = indices
    return columns


def _point_chunks(offsets: np.ndarray, chunks: int) -> list[tuple[int, int]]:
    """Ranges of points, cut where the observations are shared out evenly."""
    points = len(offsets) - 1
    cuts = [int(np.searchsorted(offsets, last)) for _, last in chunk_bounds(int(offsets[-1]), chunks)]
    edges = [0, *cuts[:-1], points]
    return [(a, b) for a, b in itertools.pairwise(edges) if a < b] or [(0, points)]


def _sharing(products: int, poses: int, shared: int, chunks: int) -> tuple[int, int]:
    """Copies of the reduced system, and ranges of rows in each."""
    jobs = min(chunks, _JOBS)
    numbers = 18 * poses * (poses + 1) + 6 * poses * shared + shared**2
    worthwhile = 36 * products // (_PRODUCTS_PER_COPY * max(numbers, 1))
    affordable = _MAX_COPIES_BYTES // (8 * max(numbers, 1))
    copies = min(worthwhile, affordable, jobs)
    return (copies, 1) if copies > jobs // 2 else (1, jobs)


def _jobs(
    items: np.ndarray, rows: np.ndarray, work: np.ndarray, copies: int, stripes: int
) -> list[tuple[int, np.ndarray]]:
    """Cuts `items`, sorted by point, by points into `copies` parts or by rows into `stripes`."""
    if not len(items):
        return []
    if stripes == 1:
        part = _shares(np.cumsum(work), copies)
        return [(k, mine) for k in range(copies) if len(mine := items[part == k])]
    part = _shares(np.cumsum(np.bincount(rows, weights=work)), stripes)[rows]
    return [(0, mine) for k in range(stripes) if len(mine := items[part == k])]


def _shares(running: np.ndarray, parts: int) -> np.ndarray:
    """Which of `parts` equal shares of the last running sum each entry falls into."""
    return np.minimum((running - running[0] / 2) * parts // max(running[-1], 1), parts - 1).astype(np.int8)
