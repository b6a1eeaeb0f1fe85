"""The normal equations against slow, dense ones that are differentiated numerically."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleConfig, squared_errors
from sfm.bundle.gauge import held_by_two_cameras
from sfm.bundle.layout import lay_out
from sfm.bundle.system import BundleSystem
from sfm.core.cameras import Camera
from sfm.core.cameras.models import model_by_id
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.optim import evaluate_loss

DAMPING = 0.03


def turned(poses, tangent):
    """Poses after a step in world axes: R exp(ω), and the centre at C − υ."""
    rotation = poses.rotation @ Rotation3.exp(tangent[:, :3])
    return Rigid3(rotation, -(rotation @ (poses.center - tangent[:, 3:])))


class Slow:
    """Residuals written out, and dense matrices of central differences; unknowns are poses, parameters, points."""

    def __init__(self, problem, loss):
        self.problem, self.loss = problem, loss
        self.poses, self.points = np.flatnonzero(problem.free_poses), np.flatnonzero(problem.free_points)
        self.params = np.argwhere(problem.free_params)
        self.count = 6 * len(self.poses) + len(self.params) + 3 * len(self.points)

    def moved(self, delta):
        problem = self.problem
        tangent = np.zeros((len(problem.free_poses), 6))
        a, b = 6 * len(self.poses), 6 * len(self.poses) + len(self.params)
        tangent[self.poses] = delta[:a].reshape(-1, 6)
        params, points = problem.camera_params.copy(), problem.points3D.copy()
        params[tuple(self.params.T)] += delta[a:b]
        points[self.points] += delta[b:].reshape(-1, 3)
        poses = turned(problem.cams_from_world, tangent)
        return dataclasses.replace(problem, cams_from_world=poses, camera_params=params, points3D=points)

    def residuals(self, delta):
        problem = self.moved(delta)
        in_camera = problem.cams_from_world[problem.obs_images] @ problem.points3D[problem.obs_points]
        out = -problem.obs_points2D
        for c, number in enumerate(problem.model_ids):
            info = model_by_id(int(number))
            camera = Camera(info.name, 1000, 760, problem.camera_params[c, : len(info.param_names)])
            mine = problem.image_cameras[problem.obs_images] == c
            out[mine] += camera.project(in_camera[mine])[0]
        return out if problem.obs_sigmas is None else out / problem.obs_sigmas[:, None]

    def cost(self, delta):
        return 0.5 * evaluate_loss(self.loss, np.sum(self.residuals(delta) ** 2, 1))[0].sum()

    def gradient(self):
        return self._differences(self.cost)

    def weighted(self):
        """Rows scaled by √ρ', and their Jacobian."""
        r = self.residuals(np.zeros(self.count))
        root = np.sqrt(evaluate_loss(self.loss, np.sum(r**2, 1))[1])
        J = self._differences(lambda d: self.residuals(d).ravel())
        return (root[:, None] * r).ravel(), np.repeat(root, 2)[:, None] * J.T

    def _differences(self, function):
        steps = np.full(self.count, 1e-6)
        a = 6 * len(self.poses)
        sizes = np.abs(self.problem.camera_params[tuple(self.params.T)])
        steps[a : a + len(self.params)] = np.maximum(1e-6 * sizes, 2e-5)
        columns = []
        for k, h in enumerate(steps):
            delta = np.zeros(self.count)
            delta[k] = h
            columns.append((function(delta) - function(-delta)) / (2 * h))
        return np.array(columns)


def system_of(problem, loss, gauge=False):
    layout = lay_out(problem, np.isfinite(squared_errors(problem)))
    held = held_by_two_cameras(problem, layout) if gauge else np.zeros((len(layout.slot_frame), 6), bool)
    return BundleSystem(problem, layout, held, BundleConfig(loss=loss), 1), held


def parts(system):
    """Gradient of the system in the order of `Slow`: padding and constant points left out."""
    shared = system.gradient[~system.held]
    return np.concatenate([shared, system._g[system.free_points].ravel()])


@pytest.fixture(params=["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "EUCM"])
def mixed(request, make_problem, perturbed, rng):
    """Two cameras with different free parameters, an image and some points constant, an image seeing a point twice,
    and observations of different precision."""
    problem = make_problem(rng, images=4, points=12, model=request.param, cameras=2, noise_px=1.0, seen=0.9)
    names = model_by_id(int(problem.model_ids[0])).param_names
    free = problem.free_params.copy()
    free[0, : len(names)], free[1, 0] = True, True
    problem = dataclasses.replace(
        problem,
        free_params=free,
        free_poses=np.array([True, True, False, True]),
        free_points=np.arange(12) % 5 > 0,
        obs_images=np.append(problem.obs_images, problem.obs_images[:3]),
        obs_points=np.append(problem.obs_points, problem.obs_points[:3]),
        obs_points2D=np.concatenate([problem.obs_points2D, problem.obs_points2D[:3] + 0.5]),
    )
    sigmas = rng.uniform(0.5, 2.0, len(problem.obs_images))
    return perturbed(dataclasses.replace(problem, obs_sigmas=sigmas), rng, 0.003)


@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_cost_and_gradient_agree_with_numeric_ones(mixed, loss):
    system, _ = system_of(mixed, loss)
    cost, largest = system.linearize()
    slow = Slow(mixed, loss)
    expected = slow.gradient()
    assert cost == pytest.approx(slow.cost(np.zeros(slow.count)), rel=1e-12)
    np.testing.assert_allclose(parts(system), expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    assert largest == pytest.approx(np.abs(expected).max(), rel=1e-5)


@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_the_eliminated_step_equals_that_of_the_dense_normal_equations(mixed, loss):
    system, _ = system_of(mixed, loss)
    system.linearize()
    trial = system.try_step(DAMPING)
    slow = Slow(mixed, loss)
    r, J = slow.weighted()
    H, g = J.T @ J, J.T @ r
    D = np.diag(np.diag(H))
    delta = -np.linalg.solve(H + DAMPING * D, g)
    predicted = -g @ delta - 0.5 * delta @ H @ delta
    assert trial is not None
    assert trial.step_norm == pytest.approx(np.linalg.norm(delta), rel=1e-5)
    assert trial.predicted_decrease == pytest.approx(predicted, rel=1e-5)
    assert trial.cost == pytest.approx(slow.cost(delta), rel=1e-4)
    system.accept()
    moved = slow.moved(delta)
    step = np.abs(delta).max()
    np.testing.assert_allclose(system.points3D, moved.points3D, atol=1e-5 * step)
    np.testing.assert_allclose(system.camera_params, moved.camera_params, atol=1e-4 * step)
    np.testing.assert_allclose(system.cams_from_world.matrix, moved.cams_from_world.matrix, atol=1e-5 * step)


def test_held_entries_drop_out_of_the_step(make_problem, perturbed, rng):
    problem = perturbed(make_problem(rng, images=4, points=15, noise_px=1.0, seen=1.0), rng, 0.005)
    system, held = system_of(problem, "trivial", gauge=True)
    assert sorted(held.sum(axis=1)) == [0, 0, 1, 6]
    system.linearize()
    trial = system.try_step(DAMPING)
    slow = Slow(problem, "trivial")
    r, J = slow.weighted()
    keep = np.concatenate([~held.ravel(), np.ones(45, bool)])
    J = J[:, keep]
    H = J.T @ J
    delta = -np.linalg.solve(H + DAMPING * np.diag(np.diag(H)), J.T @ r)
    assert trial is not None
    assert trial.step_norm == pytest.approx(np.linalg.norm(delta), rel=1e-5)
    assert np.linalg.matrix_rank(H, tol=1e-9 * np.linalg.norm(H, 2)) == len(H)


def test_squared_errors_are_those_of_the_camera_whatever_the_sigmas(mixed):
    slow = Slow(dataclasses.replace(mixed, obs_sigmas=None), "trivial")
    expected = np.sum(slow.residuals(np.zeros(slow.count)) ** 2, 1)
    np.testing.assert_allclose(squared_errors(mixed), expected, rtol=1e-9)


def test_one_constant_pose_leaves_only_the_scale_to_hold(make_problem, rng):
    problem = make_problem(rng, images=4, points=15, seen=1.0)
    for free, expected in (([False, True, True, True], [0, 0, 1]), ([False, True, False, True], [0, 0])):
        _, held = system_of(dataclasses.replace(problem, free_poses=np.array(free)), "trivial", gauge=True)
        assert sorted(held.sum(axis=1)) == expected
