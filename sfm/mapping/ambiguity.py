"""Folded models: two places that look alike, laid on top of each other.

A fold leaves two traces, and only both together are taken for one.

Contradictions. The true neighbours of the two places are torn apart: verified pairs with many matches, few of which
agree with the poses of the model. Models of places that are all different have none.

Missing observations. Two images that the fold puts side by side should see the same points. What differs between the
places (a tree, a poster, the house next door) is seen by one of them only. Chance and lighting thin observations out
everywhere; a difference empties whole cells of a grid over the image while others are full.

The points of emptied cells tell the places apart. With s_i = ±1 the place of image i, the sum Σ w_ij s_i s_j is made
large, where w_ij is the share of those points that i and j both see, −1 for the two images of a missing observation
and a little below 0 for those of a contradiction. Matches between the places are then dropped, except those that
contradicted the fold: they are the true links between the places.

References:
    Heinly, Dunn & Frahm, Correcting for duplicate scene structure in sparse 3D reconstruction, ECCV 2014.
    Zach, Irschara & Bischof, What can missing correspondences tell us about 3D structure and motion?, CVPR 2008.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.arrays import FloatArray
from sfm.core.scene import Reconstruction, TwoViewGeometry, ViewGraph
from sfm.mapping.agreement import matches_on_epipolar_lines

Pair = tuple[int, int]

_MIN_MATCHES = 100
_CONSISTENT_PX = 8.0
_MAX_CONSISTENT = 0.3
_MIN_CONTRADICTION = 0.01
"""Contradicting matches, as a share of all, from which a model is doubted at all."""

_CONTRADICTION_WEIGHT = 0.1
"""Of a contradiction against a missing observation: where an image between the places ended up on the wrong one, its
true neighbours contradict it, too."""

_MIN_TRACK = 3
_MIN_EXPECTED = 100
_MIN_SHARE_IN_VIEW = 0.3
_MAX_VIEW_ANGLE = np.deg2rad(10.0)
_MEAN_VIEW_ANGLE = np.deg2rad(25.0)
_MAX_SCALE_RATIO = 1.3
_MAX_STEP = float(np.sqrt(1 + _MAX_SCALE_RATIO**2 - 2 * _MAX_SCALE_RATIO * np.cos(_MAX_VIEW_ANGLE)))
"""Distance of two images, in ranges of a point, up to which angle and ratio of ranges can be that small."""
_BORDER = 0.03
_GRID = 8
_MIN_IN_CELL = 8
_EMPTY_RATE, _FULL_RATE = 0.1, 0.5
_MIN_EMPTY, _MIN_FULL = 0.05, 0.5
"""Shares of the expected points in empty and in full cells from which observations count as missing. On real photos
of one place the shares in empty cells stay at 0.00 for almost all neighbours, on a fold they are 0.1 to 0.25."""


def unfolded(view_graph: ViewGraph, model: Reconstruction, *, suspected: bool = False) -> ViewGraph | None:
    """The view graph without the matches between two places that the model folds together; None where it does not.

    Args:
        suspected: alike places are known to be there, so that missing observations alone are enough.
    """
    contradicting = contradictions(view_graph, model)
    if not contradicting and not suspected:
        return None
    differences = missing_observations(model)
    if not differences:
        return None
    place = dict(zip(model.image_ids.tolist(), _places(model, differences, contradicting), strict=True))
    kept = {
        pair: geometry
        for pair, geometry in view_graph.pairs.items()
        if pair in contradicting or place.get(pair[0], 0.0) * place.get(pair[1], 0.0) >= 0
    }
    return ViewGraph(kept) if len(kept) < len(view_graph) else None


def contradictions(view_graph: ViewGraph, model: Reconstruction) -> set[Pair]:
    """Verified pairs with many matches that disagree with the poses of the model; empty where they are few."""
    row = {image_id: k for k, image_id in enumerate(model.image_ids.tolist())}
    total, against, pairs = 0, 0, set()
    for (i, j), geometry in view_graph.pairs.items():
        if i in row and j in row and len(geometry) >= _MIN_MATCHES:
            total += len(geometry)
            if _consistent_share(model, row[i], row[j], geometry) < _MAX_CONSISTENT:
                against += len(geometry)
                pairs.add((i, j))
    return pairs if against > _MIN_CONTRADICTION * total else set()


def _consistent_share(model: Reconstruction, a: int, b: int, geometry: TwoViewGeometry) -> float:
    """Share of a pair's matches within `_CONSISTENT_PX` of the epipolar lines of the model's poses."""
    camera1, camera2 = (model.cameras[int(model.image_camera_ids[image])] for image in (a, b))
    points2D_1, points2D_2 = (
        model.keypoints[model.keypoint_offsets[image] + geometry.matches[:, k]] for k, image in enumerate((a, b))
    )
    b_from_a = model.cams_from_world[b] @ model.cams_from_world[a].inverse()
    return float(np.mean(matches_on_epipolar_lines(b_from_a, camera1, camera2, points2D_1, points2D_2, _CONSISTENT_PX)))


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """Points (rows of the model) that image `seen_by` sees and its neighbour `missed_by` (rows) misses."""

    seen_by: int
    missed_by: int
    points: np.ndarray


def missing_observations(model: Reconstruction) -> list[Difference]:
    """Differences between images that stand side by side in the model."""
    sees = _observers(model)
    centers = model.cams_from_world.center
    found = []
    for a in range(len(centers)):
        points = np.flatnonzero(sees[a] & (model.tracks.lengths >= _MIN_TRACK))
        if len(points) < _MIN_EXPECTED:
            continue
        ranges = np.linalg.norm(model.points3D[points] - centers[a], axis=1)
        reach = _MAX_STEP * np.quantile(ranges, 1 - _MIN_SHARE_IN_VIEW, method="higher")
        near = np.linalg.norm(centers - centers[a], axis=1) <= reach
        near[a] = False
        found += [_difference(model, sees, centers, points, a, b) for b in np.flatnonzero(near).tolist()]
    return [difference for difference in found if difference is not None]


def _observers(model: Reconstruction) -> np.ndarray:
    """Which image sees which point, (I, P)."""
    sees = np.zeros((len(model.image_ids), len(model.tracks)), bool)
    sees[model.image_rows, model.tracks.track_ids] = True
    return sees


def _difference(
    model: Reconstruction, sees: np.ndarray, centers: FloatArray, points: np.ndarray, a: int, b: int
) -> Difference | None:
    camera = model.cameras[int(model.image_camera_ids[b])]
    from_a, from_b = model.points3D[points] - centers[a], model.points3D[points] - centers[b]
    range_a, range_b = np.linalg.norm(from_a, axis=1), np.linalg.norm(from_b, axis=1)
    angle = np.arctan2(np.linalg.norm(np.cross(from_a, from_b), axis=1), np.einsum("ni,ni->n", from_a, from_b))
    similar = (angle < _MAX_VIEW_ANGLE) & (
        np.maximum(range_a, range_b) < _MAX_SCALE_RATIO * np.minimum(range_a, range_b)
    )
    if similar.sum() < max(_MIN_EXPECTED, _MIN_SHARE_IN_VIEW * len(points)):
        return None
    xy, valid = camera.project(model.cams_from_world[b] @ model.points3D[points])
    relative = xy / [camera.width, camera.height]
    inside = valid & np.all((relative > _BORDER) & (relative < 1 - _BORDER), axis=1)
    expected = np.flatnonzero(similar & inside)
    if len(expected) < max(_MIN_EXPECTED, _MIN_SHARE_IN_VIEW * len(points)):
        return None
    cell = (relative[expected] * _GRID).astype(np.int64) @ np.array([1, _GRID])
    count = np.bincount(cell, minlength=_GRID**2)
    rate = np.bincount(cell, weights=sees[b, points[expected]], minlength=_GRID**2) / np.maximum(count, 1)
    large = count >= _MIN_IN_CELL
    empty, full = large & (rate < _EMPTY_RATE), large & (rate > _FULL_RATE)
    judged = count[large].sum()
    if count[empty].sum() < _MIN_EMPTY * judged or count[full].sum() < _MIN_FULL * judged:
        return None
    missed = points[expected[empty[cell]]]
    return Difference(a, b, missed[~sees[b, missed]])


def _places(model: Reconstruction, differences: list[Difference], contradicting: set[Pair]) -> np.ndarray:
    """+1 or −1 for each image row.

    An image that no difference shows belongs where it shares more points that are proper to one place: at least two
    of its images see them, and of those of the other place, two or more that should see them, none does.
    """
    sees = _observers(model)
    row = {image_id: k for k, image_id in enumerate(model.image_ids.tolist())}
    weight = np.zeros((len(sees), len(sees)))
    for difference in differences:
        share = sees[:, difference.points].mean(axis=1)
        share[difference.seen_by] = 0.0
        weight[difference.seen_by] += share
        weight[:, difference.seen_by] += share
        weight[difference.seen_by, difference.missed_by] -= 1.0
        weight[difference.missed_by, difference.seen_by] -= 1.0
    for i, j in contradicting:
        weight[row[i], row[j]] -= _CONTRADICTION_WEIGHT
        weight[row[j], row[i]] -= _CONTRADICTION_WEIGHT
    place = _balanced(weight)
    should_see = _should_see(model, sees)
    proper = [
        (sees[place == one].sum(axis=0) >= 2) & ~sees[place == -one].any(axis=0)
        & (should_see[place == -one].sum(axis=0) >= 2)
        for one in (1.0, -1.0)
    ]  # fmt: skip
    leaning = (sees & proper[0]).sum(axis=1) - (sees & proper[1]).sum(axis=1)
    return np.where(place == 0, np.where(leaning >= 0, 1.0, -1.0), place)


def _should_see(model: Reconstruction, sees: np.ndarray) -> np.ndarray:
    """Which image has which point in its frame, from a direction near the mean of those that it is seen from (I, P)."""
    centers = model.cams_from_world.center
    mean = np.zeros_like(model.points3D)
    for i in range(len(sees)):
        mean[sees[i]] += _directions(centers[i], model.points3D[sees[i]])
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    near = np.empty_like(sees)
    for i in range(len(sees)):
        along = np.einsum("pk,pk->p", _directions(centers[i], model.points3D), mean)
        near[i] = along > np.cos(_MEAN_VIEW_ANGLE)
        camera = model.cameras[int(model.image_camera_ids[i])]
        xy, valid = camera.project(model.cams_from_world[i] @ model.points3D)
        near[i] &= valid & np.all((xy > 0) & (xy < [camera.width, camera.height]), axis=1)
    return near


def _directions(center: FloatArray, points3D: FloatArray) -> FloatArray:
    """Unit vectors (P, 3) from points towards a camera."""
    away = center - points3D
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def _balanced(weight: FloatArray) -> np.ndarray:
    """Signs s that make sᵀ W s large: those of the leading eigenvector, flipped one by one while that helps.

    Rows of zeros get 0.
    """
    place = np.sign(np.linalg.eigh(weight)[1][:, -1])
    known = np.abs(weight).sum(axis=1) > 0
    place = np.where(known, place, 0.0)
    for _ in range(len(place)):
        gain = place * (weight @ place)
        worst = np.argmin(gain)
        if not gain[worst] < 0:
            break
        place[worst] *= -1
    return place
