from __future__ import annotations

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.geometry.epipolar import (
    decompose_essential,
    epipolar_lines,
    epipoles,
    essential_from_fundamental,
    essential_from_pose,
    fundamental_from_essential,
    pose_from_essential,
    ray_jacobians,
    squared_sampson_errors,
    squared_tangent_sampson_errors,
)
from sfm.core.geometry.homogeneous import from_homogeneous, normalise_lines, to_homogeneous
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

K1 = np.array([[900.0, 0, 640], [0, 880, 480], [0, 0, 1]])
K2 = np.array([[700.0, 0, 320], [0, 705, 240], [0, 0, 1]])


def _scene(seed: int = 0, count: int = 50):
    rng = np.random.default_rng(seed)
    pose = Rigid3(Rotation3.exp(rng.normal(size=3) * 0.3), np.array([1.0, 0.3, -0.2]))
    points = rng.uniform(-1, 1, (count, 3)) + [0, 0, 5]
    return pose, points, pose @ points


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _pixels(k, points):
    return from_homogeneous(points @ k.T)


def test_homogeneous_coordinates_round_trip_and_infinity_is_nan():
    points = np.random.default_rng(0).normal(size=(5, 2))
    np.testing.assert_array_equal(from_homogeneous(to_homogeneous(points)), points)
    assert np.isnan(from_homogeneous(np.array([[1.0, 2.0, 0.0]]))).all()


def test_rays_of_a_point_satisfy_the_epipolar_constraint():
    pose, x1, x2 = _scene()
    assert np.abs(np.einsum("ni,ij,nj->n", _unit(x2), essential_from_pose(pose), _unit(x1))).max() < 1e-14


def test_pixels_of_a_point_satisfy_the_fundamental_constraint_and_lie_on_epipolar_lines():
    pose, x1, x2 = _scene()
    f = fundamental_from_essential(essential_from_pose(pose), K1, K2)
    p1, p2 = _pixels(K1, x1), _pixels(K2, x2)
    assert squared_sampson_errors(f, p1, p2).max() < 1e-20
    lines = epipolar_lines(f, p1)
    np.testing.assert_allclose(np.linalg.norm(lines[:, :2], axis=1), 1)
    assert np.abs(np.einsum("ni,ni->n", lines, to_homogeneous(p2))).max() < 1e-9


def test_epipoles_are_the_images_of_the_other_centres():
    pose, _, _ = _scene()
    f = fundamental_from_essential(essential_from_pose(pose), K1, K2)
    e1, e2 = epipoles(f)
    np.testing.assert_allclose(np.cross(e1, _unit(K1 @ pose.inverse().translation)), 0, atol=1e-9)
    np.testing.assert_allclose(np.cross(e2, _unit(K2 @ pose.translation)), 0, atol=1e-9)


def test_essential_and_fundamental_are_inverse_to_each_other():
    pose, _, _ = _scene()
    e = essential_from_pose(pose)
    back = essential_from_fundamental(fundamental_from_essential(e, K1, K2), K1, K2)
    back *= np.sign((back * e).sum()) * np.linalg.norm(e) / np.linalg.norm(back)
    np.testing.assert_allclose(back, e, atol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_the_four_decompositions_have_the_same_essential_matrix_and_contain_the_pose(seed):
    rng = np.random.default_rng(seed)
    pose = Rigid3(Rotation3.exp(rng.normal(size=3) * 2), rng.normal(size=3))
    e = essential_from_pose(pose)
    four = decompose_essential(-3.7 * e)
    unit = e / np.linalg.norm(e) * np.sqrt(2)
    for candidate in essential_from_pose(four):
        assert min(np.abs(candidate - unit).max(), np.abs(candidate + unit).max()) < 1e-12
    np.testing.assert_allclose(np.linalg.norm(four.translation, axis=1), 1)
    angles = (four.rotation @ pose.rotation.inverse()).angle
    along = four.translation @ _unit(pose.translation)
    assert ((angles < 1e-7) & (along > 1 - 1e-12)).sum() == 1


def test_a_noisy_essential_matrix_decomposes_to_rotations():
    pose, _, _ = _scene()
    noisy = essential_from_pose(pose) + np.random.default_rng(1).normal(size=(3, 3)) * 0.02
    matrices = decompose_essential(noisy).rotation.matrix
    np.testing.assert_allclose(matrices @ matrices.transpose(0, 2, 1), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12)
    angles = np.degrees((decompose_essential(noisy).rotation @ pose.rotation.inverse()).angle)
    assert angles.min() < 5


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.outer([1.0, 2, 3], [3.0, 2, 1]), np.full((3, 3), np.nan)])
def test_a_matrix_of_rank_below_two_has_no_decomposition(matrix):
    with pytest.raises(ValueError, match="rank"):
        decompose_essential(matrix)


def test_cheirality_picks_the_true_pose_and_marks_points_behind_a_camera():
    pose, x1, x2 = _scene()
    rays1, rays2 = _unit(x1), _unit(x2)
    rays2[:5] *= -1
    found, front = pose_from_essential(essential_from_pose(pose), rays1, rays2)
    assert float((found.rotation @ pose.rotation.inverse()).angle) < 1e-7
    np.testing.assert_allclose(found.translation, _unit(pose.translation), atol=1e-12)
    assert not front[:5].any()
    assert front[5:].all()


def test_sampson_error_is_the_squared_distance_to_the_nearest_exact_pair_to_first_order():
    pose, x1, x2 = _scene()
    f = fundamental_from_essential(essential_from_pose(pose), K1, K2)
    p1, p2 = _pixels(K1, x1), _pixels(K2, x2)
    # The gradient of the constraint is the direction in which a pair leaves the manifold fastest.
    gradient = np.concatenate([(to_homogeneous(p2) @ f)[:, :2], (to_homogeneous(p1) @ f.T)[:, :2]], axis=1)
    step = 1e-3 * _unit(gradient)
    errors = squared_sampson_errors(f, p1 + step[:, :2], p2 + step[:, 2:])
    np.testing.assert_allclose(errors, 1e-6, rtol=1e-4)


def test_tangent_sampson_error_equals_sampson_error_for_pinhole_cameras_to_first_order():
    pose, x1, x2 = _scene()
    rng = np.random.default_rng(2)
    cameras = [Camera("PINHOLE", 1280, 960, np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])) for k in (K1, K2)]
    e = essential_from_pose(pose)
    noisy = [_pixels(k, x) + rng.normal(size=(50, 2)) * 0.01 for k, x in ((K1, x1), (K2, x2))]
    rays = [camera.unproject(p)[0] for camera, p in zip(cameras, noisy, strict=True)]
    jacobians = [ray_jacobians(camera.project_with_jacobians(r)[1]) for camera, r in zip(cameras, rays, strict=True)]
    tangent = squared_tangent_sampson_errors(e, *rays, *jacobians)
    plain = squared_sampson_errors(fundamental_from_essential(e, K1, K2), *noisy)
    np.testing.assert_allclose(np.sqrt(tangent), np.sqrt(plain), rtol=1e-3, atol=1e-6)


def test_ray_jacobians_are_the_derivatives_of_unprojection():
    camera = Camera("OPENCV_FISHEYE", 1280, 960, np.array([400.0, 410, 640, 480, 0.02, -0.01, 0.003, 0]))
    pixels = np.random.default_rng(0).uniform(100, 900, (20, 2))
    rays, valid = camera.unproject(pixels)
    assert valid.all()
    jacobians = ray_jacobians(camera.project_with_jacobians(rays)[1])
    for k in range(2):
        step = np.eye(2)[k] * 1e-4
        numeric = (camera.unproject(pixels + step)[0] - camera.unproject(pixels - step)[0]) / 2e-4
        np.testing.assert_allclose(jacobians[:, :, k], numeric, atol=1e-9)


def test_normalised_lines_measure_distances():
    line = normalise_lines(np.array([3.0, 4.0, -10.0]))
    assert line @ [0, 0, 1] == pytest.approx(-2.0)
