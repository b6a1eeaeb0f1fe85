import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm.core.errors import Rejected
from sfm.core.geometry import _triangulation_kernels as kernels
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.triangulation import in_front, triangulate_many, triangulate_midpoint, triangulation_angles

SEEDS = st.integers(0, 2**32 - 1)


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def scene(rng, views, noise=0.0):
    """Cameras anywhere around a point, and its rays; a ray may point in any direction of its camera."""
    cams_from_world = Rigid3.exp(rng.normal(size=(views, 6)) * [1, 1, 1, 2, 2, 2])
    point = rng.normal(size=3) * 3
    rays = unit(cams_from_world @ np.tile(point, (views, 1)))
    return cams_from_world, unit(rays + noise * rng.normal(size=rays.shape)), point


def world_rays(cams_from_world, rays):
    return cams_from_world.center, cams_from_world.rotation.inverse() @ rays


def least_squares_point(cams_from_world, rays, weights=None):
    """The slow twin: the stacked equations (I − d dᵀ) X = (I − d dᵀ) c, by lstsq."""
    centers, directions = world_rays(cams_from_world, rays)
    projections = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    rows = projections if weights is None else projections * weights[:, None, None]
    right = np.einsum("kij,kj->ki", rows, centers)
    return np.linalg.lstsq(rows.reshape(-1, 3), right.ravel(), rcond=None)[0]


def angular_cost(cams_from_world, rays, point):
    seen = unit(cams_from_world @ np.tile(point, (len(rays), 1)))
    return np.square(np.linalg.norm(np.cross(seen, rays), axis=1)).sum()


@given(SEEDS)
def test_noise_free_rays_of_two_views_meet_in_the_point(seed):
    cams_from_world, rays, point = scene(np.random.default_rng(seed), 2)
    in_cam1 = cams_from_world[0] @ point
    points, mask = triangulate_midpoint(cams_from_world[1] @ cams_from_world[0].inverse(), rays[:1], rays[1:])
    angle = triangulation_angles(*cams_from_world.center, point)
    np.testing.assert_allclose(points[0], in_cam1, rtol=0, atol=1e-13 * (1 + np.linalg.norm(in_cam1)) / angle**2)
    assert mask.all()


@given(SEEDS)
def test_the_midpoint_has_the_least_squared_distance_to_both_rays(seed):
    cams_from_world, rays, _ = scene(np.random.default_rng(seed), 2, noise=0.1)
    points, _ = triangulate_midpoint(cams_from_world[1] @ cams_from_world[0].inverse(), rays[:1], rays[1:])
    expected = cams_from_world[0] @ least_squares_point(cams_from_world, rays)
    np.testing.assert_allclose(points[0], expected, rtol=1e-8, atol=1e-8)


def test_two_rays_give_the_same_world_point_by_either_kernel(rng):
    for _ in range(50):
        cams_from_world, rays, _ = scene(rng, 2, noise=0.1)
        R, t = cams_from_world.rotation.matrix, cams_from_world.translation
        by_pair, by_many = np.empty(3), np.empty(3)
        assert kernels.triangulate_two_rays(R[0], t[0], rays[0], R[1], t[1], rays[1], by_pair)
        assert kernels.triangulate_rays(R, t, rays, by_many)
        np.testing.assert_allclose(by_pair, by_many, rtol=1e-8, atol=1e-8)


@given(SEEDS, st.integers(2, 9))
def test_many_rays_give_the_least_squares_point(seed, views):
    cams_from_world, rays, _ = scene(np.random.default_rng(seed), views, noise=0.05)
    point = triangulate_many(cams_from_world, rays, refine=False)
    np.testing.assert_allclose(point, least_squares_point(cams_from_world, rays), rtol=1e-7, atol=1e-7)


@given(SEEDS, st.integers(2, 9), st.booleans())
def test_noise_free_rays_of_many_views_meet_in_the_point(seed, views, refine):
    cams_from_world, rays, point = scene(np.random.default_rng(seed), views)
    np.testing.assert_allclose(triangulate_many(cams_from_world, rays, refine=refine), point, rtol=0, atol=1e-6)


def test_refinement_is_the_point_reweighted_by_inverse_range(rng):
    cams_from_world, rays, _ = scene(rng, 5, noise=0.01)
    expected = least_squares_point(cams_from_world, rays)
    for _ in range(kernels._REWEIGHTING_PASSES):
        expected = least_squares_point(
            cams_from_world, rays, 1 / np.linalg.norm(cams_from_world.center - expected, axis=1)
        )
    np.testing.assert_allclose(triangulate_many(cams_from_world, rays), expected, rtol=1e-9)


def test_refinement_lowers_the_angular_error_where_ranges_differ(rng):
    """One camera a hundred times farther away would otherwise dominate."""
    plain_costs, refined_costs, least_costs = [], [], []
    for _ in range(40):
        point = rng.normal(size=3)
        centers = point + unit(rng.normal(size=(5, 3))) * np.array([1, 1, 1, 1, 100.0])[:, None]
        rotations = Rigid3.exp(np.pad(rng.normal(size=(5, 3)), ((0, 0), (0, 3)))).rotation
        cams_from_world = Rigid3(rotations, -(rotations @ centers))
        rays = unit(unit(cams_from_world @ np.tile(point, (5, 1))) + 1e-3 * rng.normal(size=(5, 3)))
        plain = triangulate_many(cams_from_world, rays, refine=False)
        refined = triangulate_many(cams_from_world, rays)
        nearby = refined + 1e-4 * rng.normal(size=(200, 3))
        plain_costs.append(angular_cost(cams_from_world, rays, plain))
        refined_costs.append(angular_cost(cams_from_world, rays, refined))
        least_costs.append(min(angular_cost(cams_from_world, rays, p) for p in nearby))
    assert np.median(refined_costs) < 0.2 * np.median(plain_costs)
    assert np.median(np.array(refined_costs) / least_costs) < 1.001


def test_a_scene_far_from_the_origin_loses_no_digits(rng):
    cams_from_world, rays, point = scene(rng, 4)
    far = np.array([4e5, 5e6, 100.0])
    moved = Rigid3(cams_from_world.rotation, cams_from_world.translation - cams_from_world.rotation @ far)
    np.testing.assert_allclose(triangulate_many(moved, rays), point + far, rtol=0, atol=1e-7)


@given(SEEDS)
def test_the_point_moves_with_the_world(seed):
    rng = np.random.default_rng(seed)
    cams_from_world, rays, _ = scene(rng, 4, noise=0.02)
    new_from_world = Rigid3.exp(rng.normal(size=6))
    moved = triangulate_many(cams_from_world @ new_from_world.inverse(), rays)
    np.testing.assert_allclose(moved, new_from_world @ triangulate_many(cams_from_world, rays), rtol=1e-6, atol=1e-6)


def test_parallel_rays_have_no_point():
    cam2_from_cam1 = Rigid3.exp(np.array([0.3, -0.2, 0.1, 1, 2, 3]))
    ray = unit(np.array([[0.2, 0.1, 1.0]]))
    points, mask = triangulate_midpoint(cam2_from_cam1, ray, cam2_from_cam1.rotation @ ray)
    assert np.isnan(points).all()
    assert not mask.any()
    poses = Rigid3(cam2_from_cam1.rotation[None][[0, 0, 0]], np.arange(9.0).reshape(3, 3))
    assert triangulate_many(poses, np.repeat(ray, 3, 0)) == Rejected("parallel_rays", "3 rays fix no point")


def test_rays_without_a_baseline_meet_in_the_centre_and_nothing_is_in_front():
    cam2_from_cam1 = Rigid3.exp(np.array([0.3, -0.2, 0.1, 0, 0, 0]))
    rays1 = unit(np.array([[0.2, 0.1, 1.0]]))
    points, mask = triangulate_midpoint(cam2_from_cam1, rays1, unit(np.array([[-0.2, 0.3, 1.0]])))
    np.testing.assert_array_equal(points, 0)
    assert not mask.any()


@pytest.mark.parametrize("angle", [1e-3, 1e-5, 1e-7])
def test_two_rays_lose_precision_in_proportion_to_their_angle_and_no_faster(angle):
    point = np.array([[0.3, -0.2, 1.0]])
    cam2_from_cam1 = Rigid3.exp(np.array([0, 0, 0, -angle, 0, 0]))
    points, mask = triangulate_midpoint(cam2_from_cam1, unit(point), unit(cam2_from_cam1 @ point))
    np.testing.assert_allclose(points, point, rtol=1e-15 / angle)
    assert mask.all()


def test_fewer_than_two_rays_are_rejected():
    for count in (0, 1):
        found = triangulate_many(Rigid3.identity((count,)), np.tile([0.0, 0, 1], (count, 1)))
        assert isinstance(found, Rejected)
        assert found.reason == "too_few_rays"


def test_no_pairs_give_no_points():
    none = np.zeros((0, 3))
    points, mask = triangulate_midpoint(Rigid3.identity(), none, none)
    assert points.shape == (0, 3)
    assert mask.shape == (0,)


def test_a_point_behind_either_camera_is_not_in_front():
    cam2_from_cam1 = Rigid3.exp(np.array([0, 0, 0, -1.0, 0, 0]))
    point = np.array([[0.5, 0.2, 4.0]])
    rays1, rays2 = unit(point), unit(cam2_from_cam1 @ point)
    for sign1, sign2 in [(1, 1), (1, -1), (-1, 1), (-1, -1)]:
        points, mask = triangulate_midpoint(cam2_from_cam1, sign1 * rays1, sign2 * rays2)
        np.testing.assert_allclose(points, point, rtol=1e-12)
        assert mask[0] == (sign1 > 0 and sign2 > 0)


def test_a_fisheye_sees_points_in_front_that_have_negative_depth():
    behind_the_image_plane = np.array([[3.0, 0, -1], [3.0, 0, -1]])
    rays = unit(behind_the_image_plane) * [[1], [-1]]
    assert in_front(Rigid3.identity(), rays, behind_the_image_plane).tolist() == [True, False]


def test_in_front_takes_one_camera_or_one_a_row(rng):
    cams_from_world, rays, point = scene(rng, 4)
    points = np.tile(point, (4, 1))
    assert in_front(cams_from_world, rays, points).all()
    assert in_front(cams_from_world[2], rays[[2, 2]] * [[1], [-1]], points[:2]).tolist() == [True, False]
    R, t = cams_from_world.rotation.matrix, cams_from_world.translation
    expected = cams_from_world @ points
    for k in range(4):
        np.testing.assert_allclose(kernels.range_along(R[k], t[k], rays[k], point), np.linalg.norm(expected[k]))
        np.testing.assert_allclose(kernels.depth_in(R[k], t[k], point), expected[k, 2], rtol=1e-12)


@pytest.mark.parametrize("angle", [1e-12, 1e-8, 1e-3, 1.0, np.pi / 2])
def test_the_triangulation_angle_is_exact_however_small(angle):
    center1 = np.array([0.0, 0, -1])
    center2 = np.array([np.sin(angle), 0, -np.cos(angle)])
    for found in (
        triangulation_angles(center1, center2, np.zeros((1, 3)))[0],
        kernels.triangulation_angle(center1, center2, np.zeros(3)),
    ):
        np.testing.assert_allclose(found, angle, rtol=1e-14)


def test_the_triangulation_angle_is_folded_at_a_right_angle():
    center1, center2, between = np.array([-1.0, 0, 0]), np.array([1.0, 0, 0]), np.array([[0, 1e-3, 0]])
    np.testing.assert_allclose(triangulation_angles(center1, center2, between), 2 * np.arctan(1e-3), rtol=1e-12)


def test_angles_broadcast_and_agree_with_the_kernel(rng):
    centers1, centers2, points = rng.normal(size=(3, 6, 3))
    angles = triangulation_angles(centers1[:, None], centers2[:, None], points[None])
    assert angles.shape == (6, 6)
    expected = [[kernels.triangulation_angle(a, b, p) for p in points] for a, b in zip(centers1, centers2, strict=True)]
    np.testing.assert_allclose(angles, expected, rtol=1e-12)
    np.testing.assert_allclose(angles, triangulation_angles(centers2[:, None], centers1[:, None], points), rtol=1e-12)


def test_a_point_at_a_centre_has_no_angle():
    assert triangulation_angles(np.zeros(3), np.ones(3), np.zeros((1, 3))).tolist() == [0.0]


def test_mismatched_arguments_are_refused(rng):
    rays = unit(rng.normal(size=(3, 3)))
    with pytest.raises((ValueError, TypeError)):
        triangulate_midpoint(Rigid3.identity(), rays, rays[:2])
    with pytest.raises(ValueError, match="single motion"):
        triangulate_midpoint(Rigid3.identity((3,)), rays, rays)
    with pytest.raises(ValueError, match="3 rays"):
        triangulate_many(Rigid3.identity((2,)), rays)
