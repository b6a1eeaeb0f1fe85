from __future__ import annotations

import numpy as np
import pytest

from sfm.core.errors import Rejected
from sfm.core.geometry.homogeneous import transform_points
from sfm.core.geometry.homography import decompose_homography, fit_homography, homography_from_pose, transfer_errors
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

K1 = np.array([[900.0, 0, 640], [0, 880, 480], [0, 0, 1]])
K2 = np.array([[700.0, 0, 320], [0, 705, 240], [0, 0, 1]])


def _plane_and_motion(seed):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3) + [0, 0, 3]
    normal /= np.linalg.norm(normal)
    pose = Rigid3(Rotation3.exp(rng.normal(size=3) * 0.2), rng.normal(size=3) * 0.5)
    return pose, normal, 4.0


def test_points_on_a_plane_are_mapped_by_its_homography():
    pose, normal, distance = _plane_and_motion(0)
    rays = np.random.default_rng(1).uniform(-0.3, 0.3, (20, 3)) + [0, 0, 1]
    points = rays * (distance / (rays @ normal))[:, None]
    h = homography_from_pose(pose, normal, distance)
    moved = pose @ points
    mapped = transform_points(h, points[:, :2] / points[:, 2:])
    np.testing.assert_allclose(mapped, moved[:, :2] / moved[:, 2:], atol=1e-12)


@pytest.mark.parametrize("count", [4, 30])
def test_fit_recovers_an_exact_homography(count):
    rng = np.random.default_rng(count)
    h = np.array([[1.1, 0.05, 30], [-0.02, 0.95, -20], [1e-5, -2e-5, 1]])
    points = rng.uniform(0, 1000, (count, 2))
    fitted = fit_homography(points, transform_points(h, points))
    assert transfer_errors(fitted, points, transform_points(h, points)).max() < 1e-8


def test_collinear_coincident_and_too_few_points_are_rejected():
    line = np.linspace(0, 100, 8)[:, None] * [1.0, 2.0]
    for points in (line, np.ones((6, 2)), np.zeros((3, 2))):
        assert isinstance(fit_homography(points, points), Rejected)


@pytest.mark.parametrize("seed", range(20))
def test_decomposition_contains_the_motion_and_every_solution_explains_the_homography(seed):
    pose, normal, distance = _plane_and_motion(seed)
    calibrated = homography_from_pose(pose, normal, distance)
    motions, normals = decompose_homography(-2.5 * K2 @ calibrated @ np.linalg.inv(K1), K1, K2)
    assert len(motions) == 4
    scale = np.linalg.svd(calibrated)[1][1]
    for k in range(4):
        rebuilt = motions[k].rotation.matrix + np.outer(motions[k].translation, normals[k])
        np.testing.assert_allclose(rebuilt, calibrated / scale, atol=1e-9)
    angles = (motions.rotation @ pose.rotation.inverse()).angle
    errors = np.linalg.norm(motions.translation - pose.translation / distance, axis=1)
    assert ((angles < 1e-6) & (errors < 1e-6) & (normals @ normal > 1 - 1e-9)).sum() == 1


def test_a_rotation_decomposes_into_itself_without_translation():
    rotation = Rotation3.exp(np.array([0.1, -0.2, 0.3]))
    motions, _ = decompose_homography(K2 @ rotation.matrix @ np.linalg.inv(K1), K1, K2)
    assert len(motions) == 1
    assert float((motions[0].rotation @ rotation.inverse()).angle) < 1e-9
    assert np.linalg.norm(motions[0].translation) == 0


@pytest.mark.parametrize("matrix", [np.ones((3, 3)), np.full((3, 3), np.nan)])
def test_a_singular_homography_has_no_decomposition(matrix):
    with pytest.raises(ValueError, match="homography"):
        decompose_homography(matrix, np.eye(3), np.eye(3))
