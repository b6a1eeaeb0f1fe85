"""Rows of the reduced system that several images share: cameras, sensors on their rig, biases of priors.

Free parameters of a camera stand six to a row, the last row padded; a sensor that moves on its rig has a row, and a
bias half of one. They come behind the rows of poses (see `layout`).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.bundle.prior_terms import bias_count
from sfm.bundle.problem import BundleProblem
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.optim.block_pattern import BLOCK

SENSOR_COLUMN = MAX_PARAMS
"""Where the six columns of a sensor's tangent begin, behind those of the parameters."""
BIAS_COLUMN = SENSOR_COLUMN + BLOCK
"""Where the three of a bias begin."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class SharedRows:
    """Rows behind those of poses, T of them.

    Attributes:
        camera, sensor, bias: (T,) whose row it is, −1 in the two others.
        columns: (T, 6) index of the parameter in each place, −1 for padding; sensors have `SENSOR_COLUMN` and on,
            biases `BIAS_COLUMN` and on.
    """

    camera: np.ndarray
    sensor: np.ndarray
    bias: np.ndarray
    columns: np.ndarray

    def __len__(self) -> int:
        return len(self.camera)


def shared_rows(problem: BundleProblem, seen: np.ndarray) -> SharedRows:
    """Rows for the cameras and sensors that have something free and that an observation sees, and for biases.

    Args:
        seen: (I,) images with observations.
    """
    used = np.bincount(problem.image_cameras[seen], minlength=len(problem.model_ids)) > 0
    owners, columns = [], []
    for c in np.flatnonzero(used & problem.free_params.any(axis=1)):
        free = np.flatnonzero(problem.free_params[c])
        for k in range(0, len(free), BLOCK):
            owners.append((c, -1, -1))
            columns.append(np.pad(free[k : k + BLOCK], (0, max(k + BLOCK - len(free), 0)), constant_values=-1))
    if problem.rigs is not None:
        mounted = problem.rigs.image_sensors[seen]
        used = np.bincount(mounted[mounted >= 0], minlength=len(problem.rigs.free_sensors)) > 0
        for q in np.flatnonzero(used & problem.rigs.free_sensors):
            owners.append((-1, q, -1))
            columns.append(SENSOR_COLUMN + np.arange(BLOCK))
    for b in range(bias_count(problem.pose_priors)):
        owners.append((-1, -1, b))
        columns.append(np.array([BIAS_COLUMN, BIAS_COLUMN + 1, BIAS_COLUMN + 2, -1, -1, -1]))
    camera, sensor, bias = np.array(owners, np.int32).reshape(-1, 3).T
    return SharedRows(camera, sensor, bias, np.array(columns, np.int32).reshape(-1, BLOCK))


def rows_of_images(problem: BundleProblem, shared: SharedRows, poses: int) -> np.ndarray:
    """(I, m) the numbers of the shared rows of each image behind so many rows of poses, ascending, −1 for none."""
    owned: list[list[int]] = [[] for _ in problem.model_ids]
    mounted: list[list[int]] = [[] for _ in (problem.rigs.free_sensors if problem.rigs else [])]
    for k, (c, q) in enumerate(zip(shared.camera, shared.sensor, strict=True)):
        if c >= 0 or q >= 0:
            (owned[c] if c >= 0 else mounted[q]).append(poses + k)
    sensors = problem.rigs.image_sensors if problem.rigs else np.full(len(problem.image_cameras), -1)
    rows = [owned[c] + (mounted[q] if q >= 0 else []) for c, q in zip(problem.image_cameras, sensors, strict=True)]
    out = np.full((len(rows), max(map(len, rows), default=0)), -1, np.int32)
    for i, mine in enumerate(rows):
        out[i, : len(mine)] = mine
    return out


def columns_of_images(shared: SharedRows, image_shared: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Free columns of each image and their places among those of its shared rows (I, k), and their count (I,).

    Args:
        image_shared: (I, m) as of `rows_of_images`, counted from the first shared row; negative for none.
    """
    padded = np.concatenate([shared.columns, np.full((1, BLOCK), -1, np.int32)])
    size = image_shared.shape[1] * BLOCK
    everything = padded[np.where(image_shared >= 0, image_shared, -1)].reshape(len(image_shared), size)
    place = np.argsort(everything < 0, axis=1, kind="stable").astype(np.int32)
    count = np.sum(everything >= 0, axis=1).astype(np.int32)
    place = np.ascontiguousarray(place[:, : int(count.max(initial=0))])
    return np.take_along_axis(everything, place, axis=1), place, count


def shared_couplings(
    point: np.ndarray, rows: np.ndarray, free_points: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The couplings of each observation (n, m), −1 for none, and point and row of each coupling.

    Args:
        point, rows: (n,), (n, m) the point of each observation, and the shared rows of its image.
        count: of all rows.
    """
    coupling = np.full(rows.shape, -1, np.int32)
    takes_part = (rows >= 0) & free_points[point][:, None]
    keys = (point.astype(np.int64)[:, None] * max(count, 1) + rows)[takes_part]
    if len(keys) and np.all(keys[:-1] <= keys[1:]):
        first = np.ones(len(keys), bool)
        first[1:] = keys[1:] != keys[:-1]
        unique, inverse = keys[first], np.cumsum(first) - 1
    else:
        unique, inverse = np.unique(keys, return_inverse=True)
    coupling[takes_part] = inverse
    return coupling, unique // max(count, 1), (unique % max(count, 1)).astype(np.int32)
