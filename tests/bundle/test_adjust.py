from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleConfig, adjust, squared_errors
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.events import BundleAdjusted, BundlePlanned
from sfm.core.geometry.rigid import Rigid3

TIGHT = BundleConfig(relative_cost_tolerance=1e-12, max_iterations=200)
LOSSES = ("trivial", "huber", "soft_l1", "cauchy")


def relative_poses(problem):
    """Rotations between cameras, and centres up to the gauge: distances divided by the first one."""
    R = problem.cams_from_world.rotation.matrix
    centers = problem.cams_from_world.center
    distances = np.linalg.norm(centers[:, None] - centers, axis=-1)
    return np.einsum("iab,jcb->ijac", R, R), distances / distances[0, 1]


def cost_of(problem):
    return 0.5 * float(np.nansum(squared_errors(problem)))


@pytest.mark.parametrize(
    ("model", "free_params"),
    [
        ("PINHOLE", ()),
        ("PINHOLE", (0, 1)),
        ("SIMPLE_RADIAL", (0, 3)),
        ("OPENCV", (0, 1, 4, 5)),
        ("OPENCV_FISHEYE", (0, 1, 4)),
        ("EUCM", ()),
    ],
)
def test_perfect_data_are_recovered_from_a_perturbed_start(make_problem, perturbed, rng, model, free_params):
    truth = make_problem(rng, model=model, free_params=free_params, images=8, points=120)
    result = adjust(perturbed(truth, rng), TIGHT)
    assert result.initial_cost > 1e3
    assert result.final_cost < 1e-12
    assert result.invalid == result.lost == 0
    for estimated, true in zip(relative_poses(result.problem), relative_poses(truth), strict=True):
        np.testing.assert_allclose(estimated, true, atol=1e-6)
    np.testing.assert_allclose(result.problem.camera_params, truth.camera_params, rtol=1e-5, atol=1e-6)


def test_cameras_of_their_own_are_recovered(make_problem, perturbed, rng):
    truth = make_problem(rng, model="SIMPLE_RADIAL", cameras=6, free_params=(0, 3), points=150)
    result = adjust(perturbed(truth, rng), TIGHT)
    assert result.final_cost < 1e-10
    np.testing.assert_allclose(result.problem.camera_params[:, 0], 800, rtol=1e-5)


def test_cameras_with_different_numbers_of_free_parameters_go_together(make_problem, perturbed, rng):
    truth = make_problem(rng, model="OPENCV", cameras=3, noise_px=0.5, points=150)
    free = truth.free_params.copy()
    free[0, [0, 1, 4]], free[2, 0] = True, True
    start = perturbed(dataclasses.replace(truth, free_params=free), rng)
    result = adjust(start, TIGHT)
    assert result.final_cost < cost_of(truth)
    assert np.array_equal(result.problem.camera_params[~free], start.camera_params[~free])
    assert np.all(result.problem.camera_params[free] != start.camera_params[free])


def test_the_costs_are_those_of_the_problems(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=0.5), rng)
    result = adjust(start)
    assert result.initial_cost == pytest.approx(cost_of(start), rel=1e-12)
    assert result.final_cost == pytest.approx(cost_of(result.problem), rel=1e-12)
    assert result.final_cost == result.table[-1].cost
    assert len(result.table) == result.iterations + 1


def test_an_observation_of_half_the_variance_counts_as_the_same_one_twice(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=1.0), rng)
    count = len(start.obs_images)
    precise = np.arange(count) % 3 == 0
    weighted = dataclasses.replace(start, obs_sigmas=np.where(precise, np.sqrt(0.5), 1.0))
    rows = np.concatenate([np.arange(count), np.flatnonzero(precise)])
    doubled = dataclasses.replace(
        start, obs_images=start.obs_images[rows], obs_points=start.obs_points[rows],
        obs_points2D=start.obs_points2D[rows],
    )  # fmt: skip
    one, two, plain = (adjust(problem, TIGHT) for problem in (weighted, doubled, start))
    assert one.final_cost == pytest.approx(two.final_cost, rel=1e-9)
    shapes = [relative_poses(result.problem)[1] for result in (one, two, plain)]
    np.testing.assert_allclose(shapes[0], shapes[1], atol=1e-6)
    assert np.abs(shapes[0] - shapes[2]).max() > 1e-4


def test_the_minimum_is_stationary(make_problem, perturbed, rng):
    result = adjust(perturbed(make_problem(rng, noise_px=1.0, model="SIMPLE_RADIAL", free_params=(0, 3)), rng), TIGHT)
    best = result.problem
    for _ in range(20):
        assert cost_of(perturbed(best, rng, size=1e-5)) >= result.final_cost * (1 - 1e-12)


@pytest.mark.parametrize("loss", LOSSES)
def test_the_final_cost_does_not_depend_on_the_gauge(make_problem, perturbed, rng, loss):
    start = perturbed(make_problem(rng, noise_px=1.0), rng)
    fixed = adjust(start, dataclasses.replace(TIGHT, loss=loss))
    free = adjust(start, dataclasses.replace(TIGHT, loss=loss, gauge="free"))
    world = Rigid3.exp(np.array([0.4, -1.0, 0.7, 3.0, -2.0, 5.0]))
    moved = dataclasses.replace(
        start,
        cams_from_world=start.cams_from_world @ Rigid3.stack([world.inverse()] * len(start.free_poses)),
        points3D=world @ start.points3D,
    )
    assert free.final_cost == pytest.approx(fixed.final_cost, rel=1e-8)
    assert adjust(moved, dataclasses.replace(TIGHT, loss=loss)).final_cost == pytest.approx(fixed.final_cost, rel=1e-8)


def test_every_step_of_a_free_scene_can_be_solved(make_problem, perturbed, rng):
    """However small the damping has become that keeps the matrix definite."""
    problem = perturbed(make_problem(rng, noise_px=1.0), rng)
    config = BundleConfig(
        gauge="free", loss="soft_l1", loss_scale_px=0.2, max_iterations=80, relative_cost_tolerance=0.0
    )  # fmt: skip
    table = adjust(problem, config).table
    assert min(row.damping for row in table) <= 1e-10
    assert all(row.step_norm > 0 for row in table[1:])


def test_two_cameras_hold_six_and_one_freedoms(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=1.0), rng)
    result = adjust(start)
    before, after = start.cams_from_world, result.problem.cams_from_world
    same = np.all(before.rotation.wxyz == after.rotation.wxyz, 1) & np.all(before.translation == after.translation, 1)
    assert np.sum(same) == 1


@pytest.mark.parametrize("loss", ["huber", "soft_l1", "cauchy"])
def test_a_robust_loss_resists_outliers(make_problem, perturbed, rng, loss):
    truth = make_problem(rng, images=8, points=150, noise_px=0.3)
    points2D = truth.obs_points2D.copy()
    wrong = rng.choice(len(points2D), len(points2D) // 20, replace=False)
    points2D[wrong] += rng.uniform(20, 60, (len(wrong), 2))
    start = perturbed(dataclasses.replace(truth, obs_points2D=points2D), rng, size=0.005)

    def rotation_error(problem):
        return np.abs(relative_poses(problem)[0] - relative_poses(truth)[0]).max()

    robust = adjust(start, dataclasses.replace(TIGHT, loss=loss))
    plain = adjust(start, TIGHT)
    assert rotation_error(robust.problem) < 4e-3
    assert rotation_error(robust.problem) < 0.3 * rotation_error(plain.problem)


def test_what_is_constant_stays_the_same_to_the_last_bit(make_problem, perturbed, rng):
    problem = make_problem(rng, noise_px=0.5, model="SIMPLE_RADIAL", cameras=2, images=7)
    free_params = problem.free_params.copy()
    free_params[1, [0, 3]] = True
    free_poses, free_points = np.arange(7) % 3 > 0, np.arange(len(problem.points3D)) % 4 > 0
    start = dataclasses.replace(
        perturbed(problem, rng), free_params=free_params, free_poses=free_poses, free_points=free_points
    )
    after = adjust(start).problem
    assert np.array_equal(after.camera_params[~free_params], start.camera_params[~free_params])
    assert np.array_equal(after.points3D[~free_points], start.points3D[~free_points])
    for of in (lambda p: p.cams_from_world.rotation.wxyz, lambda p: p.cams_from_world.translation):
        assert np.array_equal(of(after)[~free_poses], of(start)[~free_poses])
        assert np.all(of(after)[free_poses] != of(start)[free_poses])
    assert np.all(after.points3D[free_points] != start.points3D[free_points])


@pytest.mark.parametrize("which", ["points", "poses", "params"])
def test_one_kind_alone_can_be_adjusted(make_problem, perturbed, rng, which):
    truth = make_problem(rng, model="SIMPLE_RADIAL")
    only = dataclasses.replace(
        truth,
        free_points=np.full(len(truth.points3D), which == "points"),
        free_poses=np.full(len(truth.free_poses), which == "poses"),
        free_params=np.isin(np.arange(MAX_PARAMS), (0, 3))[None] & (which == "params"),
    )
    result = adjust(perturbed(only, rng), TIGHT)
    assert result.final_cost < 1e-12
    np.testing.assert_allclose(result.problem.points3D, truth.points3D, atol=1e-7)
    np.testing.assert_allclose(result.problem.cams_from_world.matrix, truth.cams_from_world.matrix, atol=1e-7)
    np.testing.assert_allclose(result.problem.camera_params, truth.camera_params, rtol=1e-7)


def test_the_number_of_threads_changes_no_bit(make_problem, perturbed, rng):
    problem = make_problem(
        rng, images=30, points=3000, noise_px=0.5, seen=0.4, model="SIMPLE_RADIAL", cameras=3, free_params=(0, 3)
    )
    start = perturbed(problem, rng)
    one, two, five = (adjust(start, BundleConfig(max_iterations=3), threads=threads) for threads in (1, 2, 5))
    for other in (two, five):
        assert one.table == other.table
        assert np.array_equal(one.problem.points3D, other.problem.points3D)
        assert np.array_equal(one.problem.camera_params, other.problem.camera_params)
        assert np.array_equal(one.problem.cams_from_world.matrix, other.problem.cams_from_world.matrix)


def test_the_order_of_observations_does_not_matter(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=0.5), rng)
    order = rng.permutation(len(start.obs_images))
    shuffled = dataclasses.replace(
        start,
        obs_images=start.obs_images[order],
        obs_points=start.obs_points[order],
        obs_points2D=start.obs_points2D[order],
    )
    first, second = adjust(start), adjust(shuffled)
    assert first.table == second.table
    assert np.array_equal(first.problem.points3D, second.problem.points3D)


def test_an_image_that_sees_a_point_twice_counts_twice(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=1.0), rng)
    doubled = dataclasses.replace(
        start,
        obs_images=np.concatenate([start.obs_images, start.obs_images]),
        obs_points=np.concatenate([start.obs_points, start.obs_points]),
        obs_points2D=np.concatenate([start.obs_points2D, start.obs_points2D]),
    )
    once, twice = adjust(start, TIGHT), adjust(doubled, TIGHT)
    assert twice.final_cost == pytest.approx(2 * once.final_cost, rel=1e-9)
    assert twice.iterations <= once.iterations + 2


def test_the_inputs_are_not_modified_and_the_event_tells_the_outcome(make_problem, perturbed, rng):
    start = perturbed(make_problem(rng, noise_px=0.5), rng)
    copies = start.points3D.copy(), start.camera_params.copy(), start.cams_from_world.translation.copy()
    events = []
    result = adjust(start, observer=events.append, scope="local")
    assert np.array_equal(start.points3D, copies[0])
    assert np.array_equal(start.camera_params, copies[1])
    assert np.array_equal(start.cams_from_world.translation, copies[2])
    plan, event = events
    assert isinstance(plan, BundlePlanned)
    assert (plan.scope, plan.solver, plan.observations) == ("local", "dense", len(start.obs_images))
    assert 0 < plan.memory_bytes < 1 << 20
    assert isinstance(event, BundleAdjusted)
    assert (event.scope, event.reason) == ("local", result.reason)
    assert (event.initial_cost, event.final_cost) == (result.initial_cost, result.final_cost)
    assert (event.images, event.points, event.observations) == (6, 60, len(start.obs_images))


@pytest.mark.parametrize("loss", ["tukey", "truncated"])
def test_losses_that_give_up_on_outliers_find_the_truth_from_afar_if_graduated(make_problem, perturbed, rng, loss):
    truth = make_problem(rng, images=6, points=80, seen=1.0)
    measured = truth.obs_points2D + 0.2 * rng.normal(size=truth.obs_points2D.shape)
    wrong = rng.random(len(measured)) < 0.2
    measured[wrong] += rng.uniform(-200, 200, (int(wrong.sum()), 2))
    start = perturbed(dataclasses.replace(truth, obs_points2D=measured), rng, 0.03)
    assert np.sqrt(np.nanmedian(squared_errors(start))) > 10
    found = {}
    for graduated in (True, False):
        config = BundleConfig(loss=loss, loss_scale_px=2.0, graduated=graduated, relative_cost_tolerance=1e-8)
        result = adjust(start, config)
        found[graduated] = np.sqrt(squared_errors(result.problem))
    assert np.median(found[True][~wrong]) < 0.4
    assert (found[True][~wrong] < 2).mean() > 0.97
    assert (found[True][wrong] > 2).mean() > 0.9
    assert np.median(found[False][~wrong]) > 2


@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_the_gradient_stops_a_scene_in_any_units(make_problem, perturbed, rng, loss):
    problem = perturbed(make_problem(rng, images=6, points=80, noise_px=0.5, free_params=(0, 1)), rng)
    config = BundleConfig(loss=loss, relative_cost_tolerance=1e-30, gradient_tolerance=1e-7)
    plain = adjust(problem, config)
    assert plain.reason == "gradient"
    poses, sigmas = problem.cams_from_world, np.full(len(problem.obs_images), 1e-4)
    larger = dataclasses.replace(
        problem, cams_from_world=Rigid3(poses.rotation, 1e3 * poses.translation), points3D=1e3 * problem.points3D
    )
    weighed = dataclasses.replace(problem, obs_sigmas=sigmas)
    for other, scale in ((larger, 1.0), (weighed, 1e4)):
        result = adjust(other, dataclasses.replace(config, loss_scale_px=scale))
        assert result.reason == "gradient"
        assert result.iterations == plain.iterations


def test_the_gradient_of_points_alone_stops_too(make_problem, perturbed, rng):
    problem = make_problem(rng, images=6, points=40, noise_px=0.5)
    problem = dataclasses.replace(problem, free_poses=np.zeros(6, bool))
    result = adjust(perturbed(problem, rng), BundleConfig(relative_cost_tolerance=1e-30, gradient_tolerance=1e-7))
    assert result.reason == "gradient"
    again = adjust(result.problem, BundleConfig(gradient_tolerance=1e-7))
    assert (again.reason, again.iterations) == ("gradient", 0)
