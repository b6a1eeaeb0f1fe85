from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleConfig, adjust, squared_errors
from sfm.bundle.priors import DistancePrior, GravityPrior, PointPrior, PositionPrior
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.geometry.rigid import Rigid3


def is_finite(problem):
    return (
        np.all(np.isfinite(problem.points3D))
        and np.all(np.isfinite(problem.camera_params))
        and np.all(np.isfinite(problem.cams_from_world.matrix))
    )


def keep(problem, mask):
    return dataclasses.replace(
        problem,
        obs_images=problem.obs_images[mask],
        obs_points=problem.obs_points[mask],
        obs_points2D=problem.obs_points2D[mask],
    )


def same_parameters(one, other):
    return (
        np.array_equal(one.points3D, other.points3D, equal_nan=True)
        and np.array_equal(one.camera_params, other.camera_params)
        and np.array_equal(one.cams_from_world.matrix, other.cams_from_world.matrix)
    )


def test_without_observations_nothing_changes(make_problem, rng):
    start = keep(make_problem(rng, free_params=(0,)), np.zeros(0, int))
    result = adjust(start)
    assert result.reason == "no_free_parameters"
    assert (result.initial_cost, result.final_cost, result.iterations) == (0, 0, 0)
    assert same_parameters(result.problem, start)


def test_without_anything_nothing_happens(make_problem, rng):
    start = make_problem(rng)
    empty = dataclasses.replace(
        keep(start, np.zeros(0, int)),
        cams_from_world=Rigid3.identity((0,)),
        image_cameras=np.zeros(0, np.int32),
        points3D=np.zeros((0, 3)),
        free_poses=np.zeros(0, bool),
        free_points=np.zeros(0, bool),
    )
    assert adjust(empty).reason == "no_free_parameters"


def test_with_everything_constant_the_cost_is_told(make_problem, rng):
    start = make_problem(rng, noise_px=1.0)
    start = dataclasses.replace(
        start, free_poses=np.zeros_like(start.free_poses), free_points=np.zeros_like(start.free_points)
    )
    result = adjust(start)
    assert result.reason == "no_free_parameters"
    assert result.final_cost == pytest.approx(0.5 * squared_errors(start).sum(), rel=1e-12)
    assert same_parameters(result.problem, start)


def test_no_iterations_means_no_change(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng), rng)
    result = adjust(start, BundleConfig(max_iterations=0))
    assert result.reason == "max_iterations"
    assert same_parameters(result.problem, start)


def test_images_and_points_without_observations_stay_put(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=0.5), rng)
    start = keep(start, (start.obs_images != 2) & (start.obs_points % 7 != 3))
    after = adjust(start).problem
    assert np.array_equal(after.cams_from_world[2].matrix, start.cams_from_world[2].matrix)
    assert np.array_equal(after.points3D[3::7], start.points3D[3::7])
    assert is_finite(after)


def test_observations_behind_the_camera_are_counted_and_left_out(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=0.5), rng)
    points = start.points3D.copy()
    points[:3] = start.cams_from_world.center[:3] - 2 * (points[:3] - start.cams_from_world.center[:3])
    start = dataclasses.replace(start, points3D=points)
    behind = int(np.isnan(squared_errors(start)).sum())
    result = adjust(start, BundleConfig(loss="huber"))
    assert 3 <= behind == result.invalid
    assert result.final_cost < 1e-2 * result.initial_cost
    assert is_finite(result.problem)


def test_values_that_are_not_finite_touch_only_their_own_point(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=0.5), rng)
    points, points2D = start.points3D.copy(), start.obs_points2D.copy()
    points[0], points2D[5] = np.nan, np.inf
    result = adjust(dataclasses.replace(start, points3D=points, obs_points2D=points2D))
    assert result.invalid == np.sum(start.obs_points == 0) + (start.obs_points[5] != 0)
    assert np.all(np.isfinite(result.problem.points3D[1:]))
    assert np.all(np.isfinite(result.problem.cams_from_world.matrix))
    assert result.final_cost < 1e-2 * result.initial_cost


def test_points_seen_once_are_safe(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=0.5), rng)
    first = np.zeros(len(start.obs_points), bool)
    first[np.unique(start.obs_points, return_index=True)[1]] = True
    result = adjust(keep(start, first | (start.obs_points > 20)))
    assert is_finite(result.problem)
    assert result.final_cost < 1e-2 * result.initial_cost


def test_cameras_at_one_place_without_parallax_are_safe(make_problem, perturbed, rng):
    start = make_problem(rng, noise_px=0.5, seen=1.0)
    R = start.cams_from_world.rotation
    pure_rotation = Rigid3(R, -np.einsum("iab,b->ia", R.matrix, start.cams_from_world.center[0]))
    in_camera = pure_rotation[start.obs_images] @ start.points3D[start.obs_points]
    visible = in_camera[:, 2] > 0.5
    points2D = np.array([800.0, 820.0]) * in_camera[:, :2] / in_camera[:, 2:] + [500.0, 380.0]
    start = dataclasses.replace(start, cams_from_world=pure_rotation, obs_points2D=points2D)
    start = keep(start, visible)
    result = adjust(perturbed(start, rng, 0.005))
    assert is_finite(result.problem)
    assert result.final_cost < 1e-2 * result.initial_cost


def test_two_identical_cameras_are_safe(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=0.5, images=5), rng)
    t, q = start.cams_from_world.translation.copy(), start.cams_from_world.rotation.wxyz.copy()
    t[1], q[1] = t[0], q[0]
    start = dataclasses.replace(start, cams_from_world=Rigid3(type(start.cams_from_world.rotation)(q), t))
    result = adjust(start)
    assert is_finite(result.problem)
    assert result.final_cost < result.initial_cost


def test_a_camera_with_two_points_is_safe(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=0.5), rng)
    result = adjust(keep(start, (start.obs_images != 1) | (start.obs_points < 2)))
    assert is_finite(result.problem)
    assert result.final_cost < 1e-2 * result.initial_cost


def test_two_models_in_one_problem_are_adjusted_side_by_side(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=0.5, images=8), rng)
    start = keep(start, (start.obs_images < 4) == (start.obs_points < 30))
    result = adjust(start, BundleConfig(relative_cost_tolerance=1e-10))
    assert is_finite(result.problem)
    assert result.final_cost < 1e-2 * result.initial_cost


def test_a_point_that_would_pass_through_a_camera_does_not_stop_the_rest(make_problem, perturbed, rng):
    start = make_problem(rng, noise_px=0.5)
    points = start.points3D.copy()
    center, axis = start.cams_from_world.center[0], start.cams_from_world.rotation.matrix[0, 2]
    points[:5] = center + 1e-3 * axis + 1e-4 * rng.normal(size=(5, 3))
    start = perturbed(start, rng, 0.005)
    start = dataclasses.replace(start, points3D=points)
    result = adjust(start, BundleConfig(loss="soft_l1", max_iterations=60))
    assert is_finite(result.problem)
    others = start.obs_points >= 5
    assert np.nanmean(squared_errors(result.problem)[others]) < 2.0


@pytest.mark.parametrize(
    "change",
    [
        {"obs_images": np.array([0, 99], np.int32)},
        {"obs_points": np.array([0, -1], np.int32)},
        {"obs_points2D": np.zeros((2, 3))},
        {"free_poses": np.ones(3, bool)},
        {"obs_sigmas": np.array([1.0, 0.0])},
        {"obs_sigmas": np.array([1.0, np.inf])},
        {"obs_sigmas": np.ones(3)},
        {"model_ids": np.array([7], np.int32)},
        {"free_params": np.isin(np.arange(MAX_PARAMS), (0, 4))[None]},
        {"prior_params": np.zeros((1, MAX_PARAMS))},
        {"prior_params": np.zeros((1, MAX_PARAMS)), "prior_sigmas": np.zeros((1, MAX_PARAMS))},
        {"prior_params": np.zeros((1, MAX_PARAMS)), "prior_sigmas": np.full((1, MAX_PARAMS), np.nan)},
        {
            "prior_params": np.full((1, MAX_PARAMS), np.nan),
            "prior_sigmas": np.ones((1, MAX_PARAMS)),
            "free_params": np.arange(MAX_PARAMS)[None] == 0,
        },
    ],
)
def test_arrays_that_do_not_fit_are_refused(make_problem, rng, change):
    start = keep(make_problem(rng), np.arange(2))
    with pytest.raises((ValueError, TypeError)):
        dataclasses.replace(start, **change)


def test_settings_out_of_range_are_refused():
    for scale in (0.0, -1.0, 1e-200, 1e-13, 1e13, 1e200, np.inf, np.nan):
        with pytest.raises(ValueError, match="loss_scale_px"):
            BundleConfig(loss_scale_px=scale)
    for tolerance in (-1.0, 1.0, 2.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="relative_cost_tolerance"):
            BundleConfig(relative_cost_tolerance=tolerance)
        with pytest.raises(ValueError, match="gradient_tolerance"):
            BundleConfig(gradient_tolerance=tolerance)
    BundleConfig(relative_cost_tolerance=0.0, gradient_tolerance=0.0)
    with pytest.raises(ValueError, match="max_iterations"):
        BundleConfig(max_iterations=-1)


@pytest.mark.parametrize("sigma", [1e-200, 1e-13, 1e13])
def test_absurd_standard_deviations_are_refused(make_problem, rng, sigma):
    problem = make_problem(rng)
    observations, images = len(problem.obs_images), np.arange(6, dtype=np.int32)
    far, one = np.full(problem.camera_params.shape, np.inf), np.ones(1)
    far[0, 0] = sigma
    for change in (
        {"obs_sigmas": np.r_[sigma, np.ones(observations - 1)]},
        {"prior_params": problem.camera_params, "prior_sigmas": far},
    ):
        with pytest.raises(ValueError, match=r"within 1e-12\.\."):
            dataclasses.replace(problem, **change)
    for make in (
        lambda: PositionPrior.of_sigmas(images, np.zeros((6, 3)), sigma),
        lambda: PositionPrior.of_sigmas(images, np.zeros((6, 3)), 1.0, bias_sigma=sigma),
        lambda: PointPrior.of_sigmas(images, np.zeros((6, 3)), sigma),
        lambda: GravityPrior(images[:1], np.eye(3)[:1], sigma * one, np.eye(3)[0]),
        lambda: DistancePrior(images[:1], images[1:2], one, sigma * one),
        lambda: DistancePrior(images[:1], images[1:2], one, one, loss_scale=sigma),
    ):
        with pytest.raises(ValueError, match=r"within 1e-12\.\.1e|positive variances"):
            make()


def test_the_least_and_the_largest_standard_deviations_give_finite_costs(make_problem, perturbed, rng):
    problem = perturbed(make_problem(rng, noise_px=0.3, free_params=(0,)), rng, 0.01)
    for sigma in (1e-12, 1e12):
        known = np.full(problem.camera_params.shape, np.inf)
        known[0, 0] = sigma
        stated = dataclasses.replace(
            problem,
            obs_sigmas=np.full(len(problem.obs_images), sigma),
            prior_params=problem.camera_params + 1.0,
            prior_sigmas=known,
        )
        for loss in ("trivial", "cauchy"):
            result = adjust(stated, BundleConfig(loss=loss, loss_scale_px=sigma, max_iterations=5))
            assert np.isfinite([row.cost for row in result.table]).all()
            assert np.isfinite(result.problem.points3D).all()


@pytest.mark.parametrize("value", [1e20, 1e160, np.inf, np.nan])
def test_a_camera_that_no_image_has_may_hold_anything(make_problem, perturbed, rng, value):
    problem = perturbed(make_problem(rng, noise_px=0.3, free_params=(0,)), rng, 0.01)
    unused = dataclasses.replace(
        problem,
        model_ids=np.r_[problem.model_ids, problem.model_ids].astype(np.int32),
        camera_params=np.concatenate([problem.camera_params, np.where(np.arange(MAX_PARAMS) < 4, value, 0.0)[None]]),
        free_params=np.concatenate([problem.free_params, np.zeros((1, MAX_PARAMS), bool)]),
    )
    found, expected = adjust(unused), adjust(problem)
    assert found.table == expected.table
    padded = problem.camera_params.copy()
    padded[0, -1] = value
    if np.isfinite(value):
        assert adjust(dataclasses.replace(problem, camera_params=padded)).table == expected.table
    else:
        with pytest.raises(ValueError, match="camera_params must be zero behind"):
            dataclasses.replace(problem, camera_params=padded)
