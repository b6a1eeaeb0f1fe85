from __future__ import annotations

import os
import subprocess
import sys

import jaxtyping
import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.epipolar import essential_from_pose
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.robust import (
    RansacConfig,
    estimate_absolute_pose_with_focal,
    estimate_relative_pose_one_focal,
    estimate_relative_pose_shared_focal,
)
from sfm.core.robust._focal_views_kernels import FocalViews
from sfm.core.robust._loss_kernels import TRUNCATED
from sfm.core.robust._problem_kernels import SIZE, equations, model_of, moved, parameters, squared_errors, start
from sfm.core.robust.focal import centered_pixels
from sfm.core.robust.focal_absolute_pose import focal_resection, state_of

REFUSED = (ValueError, jaxtyping.TypeCheckError)
FISHEYE = Camera("OPENCV_FISHEYE", 1600, 1200, np.array([500.0, 505, 800, 600, 0.02, -0.004, 0, 0]))
CONFIG = RansacConfig(max_error_px=2.0)


def _camera(focal, model="SIMPLE_PINHOLE"):
    if model == "SIMPLE_RADIAL":
        return Camera(model, 1600, 1200, np.array([focal, 810.0, 590, -0.05]))
    if model == "PINHOLE":
        return Camera(model, 1600, 1200, np.array([focal, 1.1 * focal, 810.0, 590]))
    return Camera(model, 1600, 1200, np.array([focal, 810.0, 590]))


def _two_views(camera1, camera2, *, count=300, outliers=0.4, noise=0.5, seed=0):
    """Keypoints of points around one that both cameras look at, from one and from another distance."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3)) * [1.2, 1, 1] + [0, 0, 5]
    turn = Rotation3.exp(np.array([0.15, -0.5, 0.1]) + 0.1 * rng.normal(size=3))
    pose = Rigid3(turn, np.array([0.3, -0.2, 6.5]) - turn @ np.array([0, 0, 5.0]))
    pixels = [camera1.project(points)[0], camera2.project(pose @ points)[0]]
    first, second = (p + rng.normal(size=p.shape) * noise for p in pixels)
    wrong = int(outliers * count)
    second[:wrong] = rng.uniform(0, 1, (wrong, 2)) * [1600, 1200]
    return first, second, pose, wrong


def _views_of_points(camera, *, count=200, outliers=0.4, noise=0.5, seed=0, thickness=1.5):
    rng = np.random.default_rng(seed)
    tilt = Rotation3.exp(np.array([0.6, 0.5, 0.0]))
    points = tilt @ (rng.uniform(-1, 1, (count, 3)) * [1.5, 1.2, thickness]) + np.array([0, 0, 5.0])
    pose = Rigid3(Rotation3.exp(rng.normal(size=3)), rng.normal(size=3) * 3)
    pixels = camera.project(points)[0] + rng.normal(size=(count, 2)) * noise
    wrong = int(outliers * count)
    pixels[:wrong] = rng.uniform(0, 1, (wrong, 2)) * [1600, 1200]
    return pixels, pose.inverse() @ points, pose, wrong


def _angle_deg(a, b):
    return float(np.degrees((a.rotation @ b.rotation.inverse()).angle))


def _direction_deg(a, b):
    cosine = a.translation @ b.translation / np.linalg.norm(a.translation) / np.linalg.norm(b.translation)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL"])
@pytest.mark.parametrize("focal", [1000.0, 2500.0])
def test_a_shared_focal_length_is_found_with_the_relative_pose_whatever_the_guess(model, focal):
    true, guess = _camera(focal, model), _camera(1.0 if model == "SIMPLE_PINHOLE" else focal * 1.1, model)
    p1, p2, pose, wrong = _two_views(true, true)
    found = estimate_relative_pose_shared_focal(p1, p2, guess, CONFIG, rng=np.random.default_rng(0))
    assert found.camera1.mean_focal_length == pytest.approx(true.mean_focal_length, rel=0.04)
    assert found.camera1 is found.camera2
    assert found.camera1.focal_lengths[1] / found.camera1.focal_lengths[0] == pytest.approx(
        true.focal_lengths[1] / true.focal_lengths[0]
    )
    assert _angle_deg(found.cam2_from_cam1, pose) < 1.0
    assert _direction_deg(found.cam2_from_cam1, pose) < 2.0
    assert np.linalg.norm(found.cam2_from_cam1.translation) == pytest.approx(1)
    assert found.inliers[wrong:].mean() > 0.97
    assert found.inliers[:wrong].mean() < 0.1
    assert found.in_front[wrong:].mean() > 0.95


@pytest.mark.parametrize("focal", [1000.0, 2500.0])
def test_one_focal_length_is_found_beside_a_calibrated_camera(focal):
    true, known = _camera(focal), _camera(1500.0, "SIMPLE_RADIAL")
    p1, p2, pose, wrong = _two_views(true, known)
    found = estimate_relative_pose_one_focal(p1, p2, _camera(1900.0), known, CONFIG, rng=np.random.default_rng(0))
    assert found.camera1.mean_focal_length == pytest.approx(focal, rel=0.03)
    assert found.camera2 is known
    assert _angle_deg(found.cam2_from_cam1, pose) < 1.0
    assert _direction_deg(found.cam2_from_cam1, pose) < 2.0
    assert found.inliers[wrong:].mean() > 0.97


def test_exact_pairs_give_the_exact_focal_length():
    true = _camera(1700.0)
    p1, p2, pose, _ = _two_views(true, true, noise=0.0, outliers=0.0)
    shared = estimate_relative_pose_shared_focal(p1, p2, _camera(900.0), CONFIG, rng=np.random.default_rng(0))
    one = estimate_relative_pose_one_focal(p1, p2, _camera(900.0), true, CONFIG, rng=np.random.default_rng(0))
    for found in (shared, one):
        assert found.camera1.mean_focal_length == pytest.approx(1700, rel=1e-4)
        assert _angle_deg(found.cam2_from_cam1, pose) < 1e-2
        assert found.inliers.all()


@pytest.mark.parametrize("thickness", [1.5, 0.0])
@pytest.mark.parametrize("factor", [0.25, 1.0, 3.0])
def test_an_absolute_pose_has_its_focal_length_whatever_the_guess_also_of_a_tilted_plane(thickness, factor):
    true = _camera(1700.0)
    pixels, points, pose, wrong = _views_of_points(true, thickness=thickness)
    found = estimate_absolute_pose_with_focal(
        pixels, points, _camera(1700.0 * factor), CONFIG, rng=np.random.default_rng(0)
    )
    assert found.camera.mean_focal_length == pytest.approx(1700, rel=0.01)
    assert np.linalg.norm(found.cam_from_world.center - pose.center) < 0.05
    assert found.inliers[wrong:].mean() > 0.97
    assert found.inliers[:wrong].mean() < 0.1


def test_points_behind_the_camera_are_no_inliers_of_a_pose_with_unknown_focal_length():
    true = _camera(1700.0)
    pixels, points, pose, _ = _views_of_points(true, outliers=0.0)
    behind = pose.inverse() @ -(pose @ points[:40])
    found = estimate_absolute_pose_with_focal(
        np.concatenate([pixels, pixels[:40]]),
        np.concatenate([points, behind]),
        _camera(1200.0),
        CONFIG,
        rng=np.random.default_rng(0),
    )
    assert found.inliers[:200].mean() > 0.97
    assert not found.inliers[200:].any()


def test_only_perspective_cameras_have_centered_pixels_and_they_are_those_of_a_pinhole():
    camera = _camera(1500.0, "PINHOLE")
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3)) + [0, 0, 3]
    pixels, valid = centered_pixels(camera.project(points)[0], camera)
    assert valid.all()
    np.testing.assert_allclose(pixels, camera.mean_focal_length * points[:, :2] / points[:, 2:], atol=1e-9)
    _, valid = centered_pixels(np.array([[np.nan, 3.0], [np.inf, 1.0], [800.0, 600.0]]), camera)
    assert valid.tolist() == [False, False, True]
    p = np.zeros((20, 2))
    for estimate in (
        lambda: estimate_relative_pose_shared_focal(p, p, FISHEYE, rng=np.random.default_rng(0)),
        lambda: estimate_relative_pose_one_focal(p, p, _camera(900.0), FISHEYE, rng=np.random.default_rng(0)),
        lambda: estimate_absolute_pose_with_focal(p, np.ones((20, 3)), FISHEYE, rng=np.random.default_rng(0)),
    ):
        with pytest.raises(ValueError, match="perspective"):
            estimate()


def _views_problem(shared):
    rng = np.random.default_rng(1)
    p1, p2, pose, _ = _two_views(_camera(1000.0), _camera(1000.0), count=40, outliers=0.0)
    data = np.ascontiguousarray(np.concatenate([p1 - [810, 590], p2 - [810, 590]], axis=1).T) / 1000
    turned = Rotation3.exp(0.01 * rng.normal(size=3)) @ pose.rotation
    inverse = np.diag([1 / 1.1, 1 / 1.1, 1.0])
    F = (inverse if shared else np.eye(3)) @ essential_from_pose(Rigid3(turned, pose.translation)) @ inverse
    model = np.zeros(SIZE)
    model[:9], model[9] = F.ravel(), np.log(1.1)
    return FocalViews(shared, data), model


def _resection_problem():
    rng = np.random.default_rng(2)
    pixels, points, pose, _ = _views_of_points(_camera(1000.0), count=40, outliers=0.0)
    problem, _ = focal_resection(pixels, points, _camera(900.0), 4.0)
    K = np.diag([1.1, 1.1, 1.0])
    turned = (Rotation3.exp(0.01 * rng.normal(size=3)) @ pose.rotation).matrix
    model = np.zeros(SIZE)
    model[:12] = np.append((K @ turned).ravel(), K @ pose.translation)
    return problem.data, model


PROBLEMS = {
    "shared": lambda: _views_problem(True),
    "one-sided": lambda: _views_problem(False),
    "resection": _resection_problem,
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_gradients_of_focal_problems_are_the_derivatives_of_the_cost(name):
    problem, model = PROBLEMS[name]()
    state = np.zeros(SIZE)
    assert start(problem, model, state)
    dof = parameters(problem)

    def cost(state):
        hessian, gradient = np.zeros((dof, dof)), np.zeros(dof)
        return equations(problem, state, TRUNCATED, 1.0, 1e9, hessian, gradient), gradient, hessian

    _, gradient, _ = cost(state)
    numeric = np.empty(dof)
    for k in range(dof):
        step = np.zeros(dof)
        step[k] = 1e-6
        numeric[k] = (cost(moved(problem, state, step))[0] - cost(moved(problem, state, -step))[0]) / 4e-6
    np.testing.assert_allclose(gradient, numeric, rtol=2e-3, atol=2e-3 * np.abs(numeric).max())


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_cost_of_a_state_is_the_sum_of_the_squared_errors_of_its_model(name):
    problem, model = PROBLEMS[name]()
    state, back = np.zeros(SIZE), np.zeros(SIZE)
    start(problem, model, state)
    model_of(problem, state, back)
    squares = np.empty(problem.data.shape[1])
    squared_errors(problem, back, 0, len(squares), squares)
    dof = parameters(problem)
    total = equations(problem, state, TRUNCATED, 1.0, 1e9, np.zeros((dof, dof)), np.zeros(dof))
    assert total == pytest.approx(squares.sum(), rel=1e-9)


def test_the_state_of_a_resection_is_its_pose_and_focal_length():
    _, model = _resection_problem()
    state = state_of(model)
    np.testing.assert_allclose(state[:9].reshape(3, 3) @ state[:9].reshape(3, 3).T, np.eye(3), atol=1e-9)
    assert state[12] == pytest.approx(np.log(1.1))
    np.testing.assert_allclose(state[11], model[11])


def _estimators():
    config = RansacConfig(max_iterations=200)
    camera = _camera(1500.0)
    return {
        "shared": lambda a, b, rng: estimate_relative_pose_shared_focal(a, b, camera, config, rng=rng),
        "one-sided": lambda a, b, rng: estimate_relative_pose_one_focal(a, b, camera, camera, config, rng=rng),
        "absolute": lambda a, b, rng: estimate_absolute_pose_with_focal(
            a, np.concatenate([b, 1e3 + b[:, :1]], axis=1), camera, config, rng=rng
        ),
    }


DEGENERATE = {
    "nothing": (np.zeros((0, 2)), np.zeros((0, 2))),
    "fewer than minimal": (np.arange(6.0).reshape(3, 2), np.arange(6.0).reshape(3, 2)),
    "one point": (np.full((50, 2), 300.0), np.full((50, 2), 300.0)),
    "a line": (np.arange(50.0)[:, None] * [8.0, 4], np.arange(50.0)[:, None] * [6.0, 5]),
    "not a number": (np.full((50, 2), np.nan), np.full((50, 2), np.nan)),
    "infinite": (np.full((50, 2), np.inf), np.full((50, 2), 1.0)),
    "not moved": (np.random.default_rng(8).uniform(0, 1200, (60, 2)),) * 2,
}


@pytest.mark.parametrize("estimator", ["shared", "one-sided", "absolute"])
@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_data_are_rejected_or_give_finite_results(estimator, case):
    found = _estimators()[estimator](*DEGENERATE[case], np.random.default_rng(0))
    if isinstance(found, Rejected):
        assert found.reason
        return
    assert case in ("one point", "a line", "not moved")
    pose, camera = (
        (found.cam_from_world, found.camera) if estimator == "absolute" else (found.cam2_from_cam1, found.camera1)
    )
    assert np.isfinite(pose.matrix).all()
    assert np.isfinite(camera.params).all()


@pytest.mark.parametrize("estimator", ["shared", "one-sided", "absolute"])
def test_point_sets_of_different_lengths_are_refused(estimator):
    with pytest.raises(REFUSED):
        _estimators()[estimator](np.zeros((20, 2)), np.zeros((19, 2)), np.random.default_rng(0))


@pytest.mark.parametrize("estimator", ["shared", "one-sided"])
def test_rows_that_are_not_finite_are_ignored_and_the_seed_gives_the_bits(estimator):
    camera = _camera(1500.0)
    p1, p2, _, wrong = _two_views(camera, camera, outliers=0.2)
    p1[-3], p2[-5] = np.nan, np.inf
    first, second = (_estimators()[estimator](p1, p2, np.random.default_rng(3)) for _ in range(2))
    assert first.inliers[wrong:].mean() > 0.9
    assert not first.inliers[[-3, -5]].any()
    np.testing.assert_array_equal(first.inliers, second.inliers)
    np.testing.assert_array_equal(first.cam2_from_cam1.matrix, second.cam2_from_cam1.matrix)
    assert first.camera1.mean_focal_length == second.camera1.mean_focal_length


_PROGRAM = """
import numpy as np
from sfm.core.cameras import Camera
from sfm.core.geometry.epipolar import essential_from_pose
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.robust import RansacConfig, estimate_absolute_pose_with_focal
from sfm.core.robust import estimate_relative_pose_one_focal, estimate_relative_pose_shared_focal
camera = Camera("SIMPLE_PINHOLE", 1600, 1200, np.array([1300.0, 800, 600]))
rng = np.random.default_rng(0)
points = rng.uniform(-1, 1, (30, 3)) + [0, 0, 5]
turn = Rotation3.exp(np.array([0.15, -0.5, 0.1]))
pose = Rigid3(turn, np.array([0.3, -0.2, 6.5]) - turn @ np.array([0, 0, 5.0]))
p1, p2 = camera.project(points)[0], camera.project(pose @ points)[0]
p1, p2 = p1 + 0.3 * rng.normal(size=p1.shape), p2 + 0.3 * rng.normal(size=p2.shape)
config = RansacConfig(min_iterations=5, max_iterations=5, min_inliers=8, max_error_px=3)
g = np.random.default_rng
shared = estimate_relative_pose_shared_focal(p1, p2, camera, config, rng=g(1))
one = estimate_relative_pose_one_focal(p1, p2, camera, camera, config, rng=g(1))
absolute = estimate_absolute_pose_with_focal(p2, points, camera, config, rng=g(1))
out = [shared.cam2_from_cam1.matrix, shared.camera1.params, one.cam2_from_cam1.matrix, one.camera1.params]
out += [absolute.cam_from_world.matrix, absolute.camera.params]
print(repr([m.ravel().tolist() for m in out]))
"""


def test_estimates_are_the_same_without_compilation():
    outputs = [
        subprocess.run(
            [sys.executable, "-c", _PROGRAM],
            env={**os.environ, "NUMBA_DISABLE_JIT": disabled},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for disabled in ("0", "1")
    ]
    compiled, interpreted = (eval(text) for text in outputs)
    for a, b in zip(compiled, interpreted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7)
