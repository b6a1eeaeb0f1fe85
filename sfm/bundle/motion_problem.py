"""Poses and the matches of pairs, as rays: what the refinement without points is given."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from sfm.core.arrays import BoolArray, FloatArray, Points2D, Value, readonly
from sfm.core.cameras import Camera
from sfm.core.geometry.epipolar import ray_jacobians
from sfm.core.geometry.rigid import Rigid3
from sfm.core.graphs.union_find import connected_components
from sfm.core.optim.block_pattern import BLOCK
from sfm.core.scene import PairKind, ViewGraph

_WITHOUT_BASELINE = (PairKind.DEGENERATE, PairKind.PANORAMIC, PairKind.WATERMARK)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MotionProblem(Value):
    """Poses, and matches of pairs as rays in flat columns: those of pair m are rows `offsets[m]:offsets[m + 1]`.

    Attributes:
        cams_from_world: batch (I,), in scene units.
        first, second: (M,) rows of the images of each pair.
        offsets: (M + 1,) starts at 0 and never falls.
        rays1, rays2: (n, 3) unit rays in the frames of the two cameras.
        tangents1, tangents2: (n, 2, 3) derivatives of the rays by the two coordinates of their pixel.
        free_poses: (I,) which poses may change.

    Raises:
        ValueError: shapes disagree, a row does not exist, a pair is of one image, or something is not finite.
    """

    cams_from_world: Rigid3
    first: Int32[np.ndarray, " M"]
    second: Int32[np.ndarray, " M"]
    offsets: Int64[np.ndarray, " M1"]
    rays1: Float64[np.ndarray, "n 3"]
    rays2: Float64[np.ndarray, "n 3"]
    tangents1: Float64[np.ndarray, "n 2 3"]
    tangents2: Float64[np.ndarray, "n 2 3"]
    free_poses: Bool[np.ndarray, " I"]

    def __post_init__(self) -> None:
        pairs, matches = len(self.first), len(self.rays1)
        for name, shape, dtype in (
            ("first", (pairs,), np.int32),
            ("second", (pairs,), np.int32),
            ("offsets", (pairs + 1,), np.int64),
            ("rays1", (matches, 3), np.float64),
            ("rays2", (matches, 3), np.float64),
            ("tangents1", (matches, 2, 3), np.float64),
            ("tangents2", (matches, 2, 3), np.float64),
            ("free_poses", self.cams_from_world.shape, np.bool_),
        ):
            object.__setattr__(self, name, readonly(getattr(self, name), shape, dtype))
        for name in ("rays1", "rays2", "tangents1", "tangents2"):
            if not np.all(np.isfinite(getattr(self, name))):
                raise ValueError(f"{name} must be finite")
        if not np.all(np.isfinite(self.cams_from_world.translation)):
            raise ValueError("poses must be finite")
        if self.offsets[0] != 0 or self.offsets[-1] != matches or np.any(np.diff(self.offsets) < 0):
            raise ValueError(f"offsets must rise from 0 to {matches}")
        images = len(self.free_poses)
        for name, rows in (("first", self.first), ("second", self.second)):
            if pairs and not (rows.min() >= 0 and rows.max() < images):
                raise ValueError(f"{name} must lie in 0..{images - 1}, got {rows.min()}..{rows.max()}")
        if np.any(self.first == self.second):
            raise ValueError("a pair must be of two images")


def motion_problem(
    cams_from_world: Mapping[int, Rigid3], cameras: Mapping[int, Camera], keypoints: Mapping[int, Points2D],
    view_graph: ViewGraph,
) -> MotionProblem:  # fmt: skip
    """The matches of all pairs of images that have a pose, but for pairs without a baseline, every pose free.

    Matches at keypoints that are not finite, or that no ray reaches, are left out.

    Args:
        cams_from_world, cameras, keypoints: by image id. Poses become rows in the order of the ids.
    """
    ids = sorted(cams_from_world)
    row_of = {image_id: row for row, image_id in enumerate(ids)}
    bearings = {image_id: _bearings(cameras[image_id], keypoints[image_id]) for image_id in ids}
    pairs, columns, counts = [np.zeros((0, 2), np.int32)], [_no_columns()], [0]
    for (i, j), geometry in view_graph.pairs.items():
        if geometry.kind in _WITHOUT_BASELINE or i not in row_of or j not in row_of:
            continue
        (rays1, tangents1), (rays2, tangents2) = bearings[i], bearings[j]
        one, two = geometry.matches.T
        usable = np.isfinite(tangents1[one]).all((1, 2)) & np.isfinite(tangents2[two]).all((1, 2))
        one, two = one[usable], two[usable]
        if len(one):
            pairs.append(np.array([[row_of[i], row_of[j]]], np.int32))
            columns.append((rays1[one], rays2[two], tangents1[one], tangents2[two]))
            counts.append(len(one))
    rows = np.concatenate(pairs)
    rays1, rays2, tangents1, tangents2 = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    return MotionProblem(
        cams_from_world=Rigid3.stack([cams_from_world[image_id] for image_id in ids]),
        first=rows[:, 0],
        second=rows[:, 1],
        offsets=np.cumsum(counts, dtype=np.int64),
        rays1=rays1,
        rays2=rays2,
        tangents1=tangents1,
        tangents2=tangents2,
        free_poses=np.ones(len(ids), bool),
    )


def with_baselines(problem: MotionProblem) -> tuple[MotionProblem, int]:
    """Without the pairs whose centres coincide or that have no match, and the number of matches that cost."""
    centers, counts = problem.cams_from_world.center, np.diff(problem.offsets)
    apart = np.any(centers[problem.first] != centers[problem.second], axis=1) & (counts > 0)
    if np.all(apart):
        return problem, 0
    kept = np.repeat(apart, counts)
    columns = {name: getattr(problem, name)[kept] for name in ("rays1", "rays2", "tangents1", "tangents2")}
    return dataclasses.replace(
        problem,
        first=problem.first[apart],
        second=problem.second[apart],
        offsets=np.cumsum([0, *counts[apart]], dtype=np.int64),
        **columns,
    ), int(np.sum(~kept))


def held_by_parts(problem: MotionProblem) -> BoolArray:
    """(I, 6) entries of tangents that are held, as in `sfm.bundle.gauge` but for every connected part of the pairs.

    Pairs of each part see no motion of the whole part: the pose with the most matches is held, or a constant one, and
    of its far neighbours one coordinate along the baseline. Two constant poses are enough.
    """
    held = np.zeros((len(problem.free_poses), BLOCK), bool)
    edges, counts = np.stack([problem.first, problem.second], 1), np.diff(problem.offsets)
    seen = np.bincount(edges.ravel(), weights=np.repeat(counts, 2), minlength=len(held))
    centers = problem.cams_from_world.center
    for part in connected_components(len(held), edges):
        constant = part[~problem.free_poses[part]]
        if not seen[part].any() or len(constant) >= 2:
            continue
        anchor = int(constant[0]) if len(constant) else int(part[np.argmax(seen[part])])
        held[anchor] = True
        shared = np.bincount(
            np.r_[problem.second[problem.first == anchor], problem.first[problem.second == anchor]],
            weights=np.r_[counts[problem.first == anchor], counts[problem.second == anchor]],
            minlength=len(held),
        )
        baselines = centers - centers[anchor]
        near = (2 * shared >= shared.max()) & (shared > 0)
        second = int(np.argmax(np.where(near, np.linalg.norm(baselines, axis=1), -1.0)))
        held[second, 3 + int(np.argmax(np.abs(baselines[second])))] = True
    return held


def _bearings(camera: Camera, points2D: Points2D) -> tuple[FloatArray, FloatArray]:
    """Rays (N, 3) and their derivatives (N, 2, 3); these are NaN where there is no ray."""
    rays, reached = camera.unproject(points2D)
    by_point = camera.project_with_jacobians(np.where(reached[:, None], rays, [0.0, 0.0, 1.0]))[1]
    tangents = ray_jacobians(by_point).swapaxes(1, 2)
    return rays, np.where(reached[:, None, None], tangents, np.nan)


def _no_columns() -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros((0, 2, 3))
