"""The pair of images that a model starts from.

A good pair has many matches, a wide angle between their rays and no pure forward motion: it must fix the first
points well, because everything that follows is measured against them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np

from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.triangulation import triangulate_midpoint, triangulation_angles
from sfm.core.scene import PairKind, ViewGraph
from sfm.mapping.state import State


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class InitialPair:
    """A candidate: image rows, relative pose, matches in front of both cameras, their median angle in radians."""

    image1: int
    image2: int
    cam2_from_cam1: Rigid3
    inliers: int
    angle: float
    forward: float


_GOOD_ANGLE = np.deg2rad(16.0)
_GUESSED_PLANE_TRUST = 0.01
_RELAXED = ((1, 1), (2, 1), (4, 1), (2, 2), (4, 2), (8, 1), (4, 4), (8, 4), (16, 4))
"""By what the least angle and the least number of matches of a first pair are divided, one after the other."""


def rank_initial_pairs(state: State, view_graph: ViewGraph) -> list[InitialPair]:
    """Candidates among unregistered images, the most promising first.

    The rank is the number of matches, scaled down where the angle is below 16° or a focal length is only a guess. A
    plane under guessed focal lengths comes last: its pose is only as good as the guess.
    """
    row = {image_id: k for k, image_id in enumerate(state.scene.image_ids.tolist())}
    ranked: list[tuple[float, int, int, InitialPair]] = []
    for (i, j), geometry in view_graph.pairs.items():
        image1, image2 = row[i], row[j]
        if geometry.cam2_from_cam1 is None or geometry.kind in (PairKind.PANORAMIC, PairKind.WATERMARK):
            continue
        if state.registered[image1] or state.registered[image2]:
            continue
        pair = _measure(state, image1, image2, geometry.matches, geometry.cam2_from_cam1)
        known = [state.scene.cameras[state.scene.image_camera[k]].has_prior_focal_length for k in (image1, image2)]
        trust = 0.5 ** (2 - sum(known)) if geometry.kind != PairKind.PLANAR or all(known) else _GUESSED_PLANE_TRUST
        score = pair.inliers * min(1.0, pair.angle / _GOOD_ANGLE) * trust
        ranked.append((-score, i, j, pair))
    return [pair for *_, pair in sorted(ranked, key=lambda entry: entry[:3])]


def _measure(state: State, image1: int, image2: int, matches: np.ndarray, cam2_from_cam1: Rigid3) -> InitialPair:
    scene = state.scene
    rays = [
        state.camera(int(scene.image_camera[image])).unproject(
            scene.keypoints[int(scene.image_ids[image])][matches[:, column]]
        )
        for column, image in enumerate((image1, image2))
    ]
    known = rays[0][1] & rays[1][1]
    points, in_front = triangulate_midpoint(cam2_from_cam1, rays[0][0][known], rays[1][0][known])
    center = np.array(cam2_from_cam1.center)
    angles = triangulation_angles(np.zeros(3), center, points[in_front])
    baseline = np.linalg.norm(center)
    return InitialPair(
        image1,
        image2,
        cam2_from_cam1,
        inliers=int(in_front.sum()),
        angle=float(np.median(angles)) if in_front.any() else 0.0,
        forward=float(abs(center[2]) / baseline) if baseline > 0 else 1.0,
    )


def acceptable_pairs(
    candidates: list[InitialPair], min_inliers: int, min_angle: float, max_forward: float
) -> Iterator[InitialPair]:
    """Candidates that meet the thresholds, then those that meet parts of them, see `_RELAXED`; each only once.

    On a drive along a street all true pairs are narrow, and many matches make up for it, while the few wide ones may be
    chance. Forward motion, a poor start, is there the only one.
    """
    given = set()
    for of_angle, of_inliers in _RELAXED:
        for index, pair in enumerate(candidates):
            meets = pair.inliers * of_inliers >= min_inliers and pair.angle * of_angle >= min_angle
            meets = meets and (pair.forward <= max_forward or of_angle > 1)
            if meets and index not in given:
                given.add(index)
                yield pair
