from __future__ import annotations

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import ConfigError
from sfm.core.geometry.epipolar import (
    essential_from_pose,
    fundamental_from_essential,
    ray_jacobians,
    squared_sampson_errors,
    squared_tangent_sampson_errors,
)
from sfm.core.geometry.homogeneous import transform_points
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import DescriptorKind, Features, PairKind, TwoViewGeometry
from sfm.matching import MatchingConfig, match_features, match_guided

PINHOLE = Camera("PINHOLE", 640, 480, np.array([500.0, 510.0, 320.0, 240.0]))
FISHEYE = Camera("OPENCV_FISHEYE", 640, 480, np.array([250.0, 250.0, 320.0, 240.0, 0.02, -0.01, 0.0, 0.0]))
POSE = Rigid3.exp(np.array([0.05, -0.2, 0.1, 0.8, 0.1, 0.2]))
NOTHING = np.zeros((0, 2), np.int32)


def pair(seed: int, camera: Camera, count: int = 60, look_alikes: int = 3, kind=DescriptorKind.SIFT):
    """Points seen by two cameras; every descriptor occurs `look_alikes` times with small differences."""
    rng = np.random.default_rng(seed)
    points = np.stack([rng.uniform(-2, 2, count), rng.uniform(-1.5, 1.5, count), rng.uniform(4, 8, count)], axis=1)
    width = 128 if kind == DescriptorKind.SIFT else 32
    base = rng.integers(10, 80, (count // look_alikes, width)).repeat(look_alikes, axis=0)
    sides = []
    for pose in (Rigid3.identity(), POSE):
        pixels, _ = camera.project(pose @ points)
        noise = rng.integers(0, 4, base.shape) if kind == DescriptorKind.SIFT else 1 << rng.integers(0, 8, base.shape)
        rows = base + noise if kind == DescriptorKind.SIFT else base ^ (noise * (rng.random(base.shape) < 0.05))
        zeros = np.zeros(count, np.float32)
        pixels = pixels + rng.normal(0, 0.2, pixels.shape)
        sides.append(Features(pixels, zeros, zeros, rows.astype(np.uint8), kind))
    return sides


def by_definition(table: np.ndarray, allowed: np.ndarray, ratio: float) -> list[tuple[int, int]]:
    """The slow, obvious twin: among what is allowed, sorting."""
    table = np.where(allowed, table, np.inf)

    def chosen(row: np.ndarray) -> int:
        order = np.argsort(row, kind="stable")
        return int(order[0]) if row[order[0]] < ratio * row[order[1]] else -1

    forward, backward = [chosen(row) for row in table], [chosen(column) for column in table.T]
    return [(i, j) for i, j in enumerate(forward) if j >= 0 and backward[j] == i]


def euclidean(first: Features, second: Features) -> np.ndarray:
    a, b = (f.descriptors.astype(np.int64) for f in (first, second))
    return ((a[:, None] - b[None]) ** 2).sum(axis=2)


def everything_with_everything(count: int) -> tuple[np.ndarray, np.ndarray]:
    i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    return i.ravel(), j.ravel()


def test_matches_of_an_essential_matrix_are_those_of_the_definition_for_a_fisheye():
    first, second = pair(1, FISHEYE)
    E = essential_from_pose(POSE)
    geometry = TwoViewGeometry(PairKind.CALIBRATED, NOTHING, POSE, E=E)
    i, j = everything_with_everything(60)
    (r1, J1), (r2, J2) = (
        (rays := FISHEYE.unproject(f.points2D)[0], ray_jacobians(FISHEYE.project_with_jacobians(rays)[1]))
        for f in (first, second)
    )
    allowed = squared_tangent_sampson_errors(E, r1[i], r2[j], J1[i], J2[j]).reshape(60, 60) <= 4
    found = match_guided(first, second, geometry, FISHEYE, FISHEYE, MatchingConfig(guided_error_px=2.0)).indices
    assert [tuple(row) for row in found.tolist()] == by_definition(euclidean(first, second), allowed, 0.64)


@pytest.mark.parametrize("kind", [DescriptorKind.SIFT, DescriptorKind.BINARY])
def test_look_alikes_are_told_apart_by_where_they_lie(kind):
    first, second = pair(2, PINHOLE, kind=kind)
    K = PINHOLE.calibration_matrix
    F = fundamental_from_essential(essential_from_pose(POSE), K, K)
    geometry = TwoViewGeometry(PairKind.UNCALIBRATED, NOTHING, F=F)
    plain = match_features(first, second).indices
    guided = match_guided(first, second, geometry, PINHOLE, PINHOLE, MatchingConfig(guided_error_px=2.0)).indices
    assert len(plain) < 15
    assert len(guided) > 40
    assert (guided[:, 0] == guided[:, 1]).mean() > 0.9
    errors = squared_sampson_errors(F, first.points2D[guided[:, 0]], second.points2D[guided[:, 1]])
    assert errors.max() <= 4


def test_matches_of_a_homography_are_those_of_the_definition():
    rng = np.random.default_rng(3)
    H = np.array([[1.05, 0.1, -20.0], [-0.08, 0.98, 15.0], [1e-4, -5e-5, 1.0]])
    first, _ = pair(3, PINHOLE)
    moved = transform_points(H, first.points2D) + rng.normal(0, 0.5, (60, 2))
    second = Features(
        moved, first.scales, first.orientations, (first.descriptors + rng.integers(0, 3, (60, 128))).astype(np.uint8)
    )
    gaps = np.linalg.norm(transform_points(H, first.points2D)[:, None] - moved[None], axis=2)
    geometry = TwoViewGeometry(PairKind.PLANAR, NOTHING, H=H)
    found = match_guided(first, second, geometry, PINHOLE, PINHOLE, MatchingConfig(guided_error_px=3.0)).indices
    assert len(found) > 50
    assert [tuple(row) for row in found.tolist()] == by_definition(euclidean(first, second), gaps <= 3, 0.64)


def test_pixels_that_no_ray_belongs_to_have_no_match():
    first, second = pair(4, FISHEYE)
    outside = first.points2D.copy()
    outside[:30] = [-5000.0, -5000.0]
    first = Features(outside, first.scales, first.orientations, first.descriptors)
    geometry = TwoViewGeometry(PairKind.CALIBRATED, NOTHING, POSE, E=essential_from_pose(POSE))
    found = match_guided(first, second, geometry, FISHEYE, FISHEYE).indices
    assert len(found) > 0
    assert found[:, 0].min() >= 30


def test_no_features_and_no_geometry():
    first, second = pair(5, PINHOLE)
    empty = np.zeros(0, np.float32)
    none = Features(np.zeros((0, 2)), empty, empty, np.zeros((0, 128), np.uint8))
    geometry = TwoViewGeometry(PairKind.CALIBRATED, NOTHING, POSE, E=essential_from_pose(POSE))
    assert len(match_guided(none, second, geometry, PINHOLE, PINHOLE)) == 0
    with pytest.raises(ValueError, match="DEGENERATE"):
        match_guided(first, second, TwoViewGeometry(PairKind.DEGENERATE, NOTHING), PINHOLE, PINHOLE)
    with pytest.raises(ConfigError, match="guided_error_px"):
        MatchingConfig(guided_error_px=0.0)
