"""What the minimum of a problem must not depend on: names, orders, the frame and the unit of the world, the solver."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from sfm.bundle import BundleConfig, BundleProblem, adjust, squared_errors
from sfm.bundle.priors import DistancePrior, GravityPrior, PointPrior, PositionPrior
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.similarity import Sim3, estimate_similarity
from sfm.core.optim.losses import LOSSES
from tests.bundle.conftest import build, perturb
from tests.bundle.test_rigs import build_rig, disturbed

TIGHT = BundleConfig(relative_cost_tolerance=1e-12, max_iterations=200)
SOLVERS = ("dense", "sparse", "iterative")


def noisy(rng: np.random.Generator) -> BundleProblem:
    """Three cameras with parameters of their own, a perturbed start."""
    problem = build(rng, images=7, points=70, model="OPENCV", cameras=3, noise_px=0.5, free_params=(0, 1, 4))
    return perturb(problem, rng, 0.005)


def renamed(problem: BundleProblem, images: np.ndarray, points: np.ndarray, cameras: np.ndarray) -> BundleProblem:
    """The same problem, the rows of each kind in another order; row k was row `images[k]` …"""
    new_image, new_point, new_camera = (np.argsort(order).astype(np.int32) for order in (images, points, cameras))
    return dataclasses.replace(
        problem,
        model_ids=problem.model_ids[cameras],
        camera_params=problem.camera_params[cameras],
        free_params=problem.free_params[cameras],
        image_cameras=new_camera[problem.image_cameras[images]],
        cams_from_world=problem.cams_from_world[images],
        free_poses=problem.free_poses[images],
        points3D=problem.points3D[points],
        free_points=problem.free_points[points],
        obs_images=new_image[problem.obs_images],
        obs_points=new_point[problem.obs_points],
    )


@pytest.mark.parametrize("what", ["images", "points", "cameras"])
def test_the_minimum_does_not_depend_on_the_order_of(rng, what):
    start = noisy(rng)
    sizes = {"images": len(start.free_poses), "points": len(start.points3D), "cameras": len(start.model_ids)}
    orders = {name: rng.permutation(size) if name == what else np.arange(size) for name, size in sizes.items()}
    assert not np.array_equal(orders[what], np.arange(sizes[what]))
    plain, other = adjust(start, TIGHT), adjust(renamed(start, **orders), TIGHT)
    assert other.initial_cost == pytest.approx(plain.initial_cost, rel=1e-12)
    assert other.final_cost == pytest.approx(plain.final_cost, rel=1e-10)
    np.testing.assert_allclose(
        other.problem.camera_params, plain.problem.camera_params[orders["cameras"]], rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("shift", [0.0, 1e6])
def test_the_minimum_does_not_depend_on_where_and_how_large_the_world_is(rng, scale, shift):
    start = noisy(rng)
    turn = Rotation3.exp(np.array([0.3, -1.1, 0.7]))
    to = scale * shift * np.array([1.0, -0.5, 0.7])
    rotation = start.cams_from_world.rotation @ turn.inverse()
    centers = scale * (turn @ start.cams_from_world.center) + to
    elsewhere = dataclasses.replace(
        start,
        cams_from_world=Rigid3(rotation, -(rotation @ centers)),
        points3D=scale * (turn @ start.points3D) + to,
    )
    plain, other = adjust(start, TIGHT), adjust(elsewhere, TIGHT)
    # Coordinates of 1e6 units have lost 1e-10 units, 1e-8 px at these distances.
    assert other.initial_cost == pytest.approx(plain.initial_cost, rel=1e-7)
    assert other.final_cost == pytest.approx(plain.final_cost, rel=1e-7)
    np.testing.assert_allclose(other.problem.camera_params, plain.problem.camera_params, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("loss", LOSSES)
def test_a_second_adjustment_has_nothing_left_to_do(rng, loss):
    config = dataclasses.replace(TIGHT, loss=loss, loss_scale_px=2.0)
    first = adjust(noisy(rng), dataclasses.replace(config, graduated=True))
    second = adjust(first.problem, config)
    assert second.initial_cost == pytest.approx(first.final_cost, rel=1e-12)
    assert 0 <= second.initial_cost - second.final_cost <= 1e-9 * first.final_cost
    assert second.iterations <= 3
    np.testing.assert_allclose(second.problem.points3D, first.problem.points3D, atol=1e-4)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("loss", LOSSES)
def test_the_cost_never_rises(rng, loss, solver):
    start = perturb(build(rng, noise_px=1.0, model="SIMPLE_RADIAL", free_params=(0, 3), points=50), rng, 0.02)
    config = dataclasses.replace(TIGHT, loss=loss, loss_scale_px=3.0, max_iterations=40, solver=solver)
    result = adjust(start, config)
    costs = [row.cost for row in result.table]
    assert len(costs) > 3
    assert all(after <= before for before, after in itertools.pairwise(costs))
    assert costs[-1] < costs[0]
    assert all((row.cost_change > 0) == row.accepted or row.cost_change == 0 for row in result.table)


def loop(rng: np.random.Generator) -> BundleProblem:
    """A ring of 14 images, each point in a few neighbours, and the last ones see what the first do."""
    problem = build(rng, images=14, points=160, noise_px=0.5, seen=1.0, free_params=(0,))
    near = (problem.obs_images - problem.obs_points % 14) % 14 < 4
    return perturb(keep(problem, near), rng, 0.003)


def apart(rng: np.random.Generator) -> BundleProblem:
    """Two halves that share neither points nor cameras."""
    problem = build(rng, images=10, points=80, cameras=2, noise_px=0.5, seen=1.0, free_params=(0,))
    return perturb(keep(problem, problem.obs_images % 2 == problem.obs_points % 2), rng, 0.003)


def wide(rng: np.random.Generator) -> BundleProblem:
    """A camera of twelve free parameters for each image: two shared rows each."""
    free = tuple(range(12))
    problem = build(rng, images=4, points=150, cameras=4, model="FULL_OPENCV", noise_px=0.3, seen=1.0, free_params=free)
    priors = {"prior_params": problem.camera_params, "prior_sigmas": np.tile([20.0] * 4 + [0.02] * 12, (4, 1))}
    return dataclasses.replace(perturb(problem, rng, 0.002), **priors)


def rig(rng: np.random.Generator) -> BundleProblem:
    """Five moments of three sensors that may move on their rig, one of two camera parameters free."""
    return disturbed(build_rig(rng, free_sensors=True, free_params=(0, 3)), rng)


def known(rng: np.random.Generator) -> BundleProblem:
    """All kinds of priors: positions with a bias, directions, distances, points."""
    problem = build(rng, images=8, points=60, noise_px=0.5, free_params=(0,))
    rows, poses = np.arange(8, dtype=np.int32), problem.cams_from_world
    down = np.array([0.0, 1.0, 0.0])
    measured = poses.center + 0.05 * rng.normal(size=(8, 3))
    priors = (
        PositionPrior.of_sigmas(rows, measured, 0.05, bias_sigma=0.5),
        GravityPrior(rows, poses.rotation.matrix @ down, np.full(8, 0.01), down),
        DistancePrior(rows[:2], rows[3:5], np.linalg.norm(poses.center[:2] - poses.center[3:5], axis=1), np.ones(2)),
        PointPrior.of_sigmas(rows[:3], problem.points3D[:3], 0.01),
    )
    return dataclasses.replace(perturb(problem, rng, 0.005), priors=priors)


def keep(problem: BundleProblem, rows: np.ndarray) -> BundleProblem:
    """Only some of the observations (n,)."""
    columns = {name: getattr(problem, name)[rows] for name in ("obs_images", "obs_points", "obs_points2D")}
    return dataclasses.replace(problem, **columns)


@pytest.mark.parametrize("make", [loop, apart, wide, rig, known])
def test_all_solvers_find_the_same_minimum(rng, make):
    start = make(rng)
    config = dataclasses.replace(TIGHT, relative_cost_tolerance=1e-13, max_iterations=400)
    results = {name: adjust(start, dataclasses.replace(config, solver=name)) for name in SOLVERS}
    dense = results["dense"]
    assert dense.final_cost < 0.9 * dense.initial_cost
    for name in ("sparse", "iterative"):
        assert results[name].initial_cost == dense.initial_cost
        assert results[name].final_cost == pytest.approx(dense.final_cost, rel=1e-9), name
    np.testing.assert_allclose(
        results["sparse"].problem.camera_params, dense.problem.camera_params, rtol=1e-5, atol=1e-5
    )
    assert results["sparse"].iterations <= dense.iterations + 3


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_number_of_threads_changes_no_bit_of_any_solver(rng, solver):
    """Enough observations for several chunks of images and points."""
    problem = build(rng, images=24, points=1600, cameras=24, seen=0.5, model="SIMPLE_RADIAL", free_params=(0, 3))
    start = perturb(problem, rng, 0.003)
    config = BundleConfig(max_iterations=2, solver=solver, loss="huber")
    one, others = adjust(start, config), [adjust(start, config, threads=threads) for threads in (2, 3, 7)]
    assert len(start.obs_images) > 2 * 8192
    for other in others:
        assert one.table == other.table
        assert np.array_equal(one.problem.points3D, other.problem.points3D)
        assert np.array_equal(one.problem.camera_params, other.problem.camera_params)
        assert np.array_equal(one.problem.cams_from_world.matrix, other.problem.cams_from_world.matrix)


@pytest.mark.parametrize("make", [loop, rig])
def test_the_gauge_of_two_cameras_is_one_similarity_away_from_the_free_one(rng, make):
    """One pose and one coordinate of a second centre are as they were."""
    start = make(rng)
    config = dataclasses.replace(TIGHT, relative_cost_tolerance=1e-9)
    held, free = adjust(start, config), adjust(start, dataclasses.replace(config, gauge="free"))
    assert held.final_cost == free.final_cost
    motion = estimate_similarity(free.problem.points3D, held.problem.points3D)
    assert isinstance(motion, Sim3)
    np.testing.assert_allclose(motion @ free.problem.points3D, held.problem.points3D, atol=1e-9)
    before, after = (problem.cams_from_world.center for problem in (start, held.problem))
    same = np.flatnonzero(np.abs(after - before).max(axis=1) < 1e-12)
    assert len(same) == 1
    rows, axes = np.nonzero(np.abs(after - before) < 1e-12)
    baselines = np.abs(before - before[same[0]])
    assert any(axis == np.argmax(baselines[row]) for row, axis in zip(rows, axes, strict=True) if row != same[0])
    from_held = squared_errors(held.problem)
    np.testing.assert_allclose(from_held, squared_errors(free.problem), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("free", ["poses", "points", "params", "poses points", "poses params", "points params"])
def test_any_part_may_be_constant(rng, free, solver):
    truth = build(rng, images=5, points=40, model="SIMPLE_RADIAL", cameras=2, free_params=(0, 3))
    truth = dataclasses.replace(
        truth,
        free_poses=np.full(5, "poses" in free),
        free_points=np.full(40, "points" in free),
        free_params=truth.free_params & ("params" in free),
    )
    result = adjust(perturb(truth, rng, 0.005), dataclasses.replace(TIGHT, solver=solver, gauge="free"))
    assert result.initial_cost > 10
    assert result.final_cost < 1e-12
