from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from sfm.core.geometry.epipolar import essential_from_pose
from sfm.core.geometry.homogeneous import to_homogeneous, transform_points
from sfm.core.geometry.minimal._linear_kernels import nullspace
from sfm.core.geometry.minimal._polynomial_kernels import real_roots
from sfm.core.geometry.minimal.five_point import solve_five_point
from sfm.core.geometry.minimal.p3p import solve_p3p
from sfm.core.geometry.minimal.seven_point import solve_four_point, solve_seven_point
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3


def _unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _two_views(rng, count):
    pose = Rigid3(Rotation3.exp(rng.normal(size=3) * 0.4), _unit(rng.normal(size=3)))
    points = rng.uniform(-1, 1, (count, 3)) * [2, 2, 1.5] + [0, 0, 5]
    return pose, points, pose @ points


def _sign_free_error(found, truth):
    truth = truth / np.linalg.norm(truth) * np.linalg.norm(found[0]) if len(found) else truth
    return min((min(np.abs(m - truth).max(), np.abs(m + truth).max()) for m in found), default=np.inf)


def test_real_roots_are_those_of_the_companion_matrix():
    rng = np.random.default_rng(0)
    out = np.empty(10)
    for _ in range(300):
        degree = int(rng.integers(1, 11))
        c = rng.normal(size=degree + 1) * 10.0 ** rng.uniform(-3, 3)
        expected = np.roots(c[::-1])
        expected = np.sort(expected[np.abs(expected.imag) < 1e-9].real)
        found = np.sort(out[: real_roots(c, out)])
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("roots", [[0.0], [1.0, -1.0], [1e-8, 2.0, 3.0], [1e6, -1e-6, 0.5], [0.0, 0.5, 1e3, -7.0]])
def test_real_roots_at_the_borders_of_the_unit_interval_and_of_every_size_are_found(roots):
    out = np.empty(10)
    count = real_roots(np.poly(roots)[::-1].copy(), out)
    np.testing.assert_allclose(np.sort(out[:count]), np.sort(roots), rtol=1e-6, atol=1e-10)


@pytest.mark.parametrize("smallest", [0.0, 1e-18])
def test_a_leading_coefficient_of_nearly_zero_changes_no_root(smallest):
    rng = np.random.default_rng(9)
    out = np.empty(10)
    for degree in (2, 3, 5, 9):
        roots = np.sort(rng.uniform(-3, 3, degree))
        count = real_roots(np.append(np.poly(roots)[::-1], smallest), out)
        np.testing.assert_allclose(np.sort(out[:count]), roots, rtol=1e-5, atol=1e-6)


def test_simple_roots_are_found_beside_a_multiple_one():
    out = np.empty(10)
    count = real_roots(np.poly([0.7, 0.7, 0.7, -2.0, 0.1])[::-1].copy(), out)
    for root in (-2.0, 0.1):
        assert np.abs(out[:count] - root).min() < 1e-6


@pytest.mark.parametrize("c", [np.zeros(4), np.array([1.0, np.nan, 0, 1]), np.array([1.0, 0, 1, 0])])
def test_polynomials_without_real_roots_have_none(c):
    assert real_roots(c, np.empty(10)) == 0


def test_nullspace_is_orthonormal_and_annihilated():
    rng = np.random.default_rng(1)
    for rows in (5, 7, 8):
        a = rng.normal(size=(rows, 9))
        basis = np.empty((9 - rows, 9))
        assert nullspace(a.copy(), basis)
        np.testing.assert_allclose(basis @ basis.T, np.eye(9 - rows), atol=1e-13)
        assert np.abs(a @ basis.T).max() < 1e-12
    a[3] = a[5]
    assert not nullspace(a, basis)


def test_five_points_contain_the_true_essential_matrix_and_all_solutions_are_essential():
    rng = np.random.default_rng(2)
    errors = []
    for _ in range(1000):
        pose, x1, x2 = _two_views(rng, 5)
        found = solve_five_point(_unit(x1), _unit(x2))
        errors.append(_sign_free_error(found, essential_from_pose(pose)))
        assert len(found) <= 10
        assert np.abs(np.einsum("ni,sij,nj->sn", _unit(x2), found, _unit(x1))).max() < 1e-9
    errors = np.array(errors)
    assert np.median(errors) < 1e-12
    assert np.mean(errors > 1e-6) < 0.01
    singular = np.linalg.svd(found)[1]
    np.testing.assert_allclose(singular, np.tile([1, 1, 0], (len(found), 1)), atol=1e-6)


def test_five_points_on_a_plane_still_contain_the_true_essential_matrix():
    rng = np.random.default_rng(3)
    errors = []
    for _ in range(200):
        pose, x1, _ = _two_views(rng, 5)
        x1[:, 2] = 5 + 0.3 * x1[:, 0] - 0.2 * x1[:, 1]
        errors.append(_sign_free_error(solve_five_point(_unit(x1), _unit(pose @ x1)), essential_from_pose(pose)))
    assert np.median(errors) < 1e-10
    assert np.mean(np.array(errors) > 1e-4) < 0.05


def test_seven_points_contain_the_true_fundamental_matrix_and_all_solutions_have_rank_two():
    rng = np.random.default_rng(4)
    for _ in range(300):
        pose, x1, x2 = _two_views(rng, 7)
        p1, p2 = 800 * x1[:, :2] / x1[:, 2:] + [640, 480], 800 * x2[:, :2] / x2[:, 2:] + [640, 480]
        found = solve_seven_point(p1, p2)
        assert 1 <= len(found) <= 3
        k = np.array([[800.0, 0, 640], [0, 800, 480], [0, 0, 1]])
        truth = np.linalg.inv(k).T @ essential_from_pose(pose) @ np.linalg.inv(k)
        assert _sign_free_error(found, truth) < 1e-7
        assert np.abs(np.linalg.svd(found)[1][:, 2]).max() < 1e-10


def test_four_points_give_the_homography_that_maps_them():
    rng = np.random.default_rng(5)
    for _ in range(300):
        h = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]) + rng.normal(size=(3, 3)) * [[0.2], [0.2], [1e-4]]
        p1 = rng.uniform(0, 1000, (4, 2))
        p2 = transform_points(h, p1)
        found = solve_four_point(p1, p2)
        assert len(found) == 1
        np.testing.assert_allclose(transform_points(found[0], p1), p2, rtol=1e-6, atol=1e-4)


def test_three_points_contain_the_true_pose_and_all_solutions_see_the_points_on_their_rays():
    rng = np.random.default_rng(6)
    for _ in range(1000):
        points = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-2, 2)
        pose = Rigid3(Rotation3.exp(rng.normal(size=3)), rng.normal(size=3) * 0.3 + [0, 0, 4 * np.abs(points).max()])
        rays = _unit(pose @ points)
        found = solve_p3p(rays, points)
        assert 1 <= len(found) <= 4
        size = np.linalg.norm(pose.translation)
        errors = np.abs(found.rotation.matrix - pose.rotation.matrix).max((1, 2))
        errors += np.abs(found.translation - pose.translation).max(1) / size
        assert errors.min() < 1e-6
        for k in range(len(found)):
            np.testing.assert_allclose(_unit(found[k] @ points), rays, atol=1e-6)


def test_degenerate_samples_give_no_solution_or_a_finite_one():
    one, line = np.ones((7, 2)), np.arange(7.0)[:, None] * [1.0, 2.0]
    nothing = np.full((7, 2), np.nan)
    for points in (one, line, nothing):
        rays = _unit(to_homogeneous(points[:5]))
        assert np.isfinite(solve_five_point(rays, rays)).all()
        assert np.isfinite(solve_p3p(rays[:3], np.arange(9.0).reshape(3, 3)).translation).all()
        if not np.isnan(points).any():
            assert np.isfinite(solve_seven_point(points, points)).all()
            assert len(solve_four_point(points[:4], points[:4])) == 0
    assert len(solve_p3p(_unit(np.eye(3) + 1), np.arange(3.0)[:, None] * [1.0, 2, 3])) == 0


@pytest.mark.parametrize(
    ("solver", "width"), [(solve_five_point, 3), (solve_seven_point, 2), (solve_four_point, 2), (solve_p3p, 3)]
)
def test_a_sample_of_the_wrong_size_is_refused(solver, width):
    with pytest.raises(ValueError, match="minimal sample"):
        solver(np.ones((2, width)), np.ones((2, width)))


_PROGRAM = """
import numpy as np
from sfm.core.geometry.minimal.five_point import solve_five_point
from sfm.core.geometry.minimal.p3p import solve_p3p
from sfm.core.geometry.minimal.seven_point import solve_four_point, solve_seven_point
rng = np.random.default_rng(7)
x1 = rng.uniform(-1, 1, (7, 3)) + [0, 0, 5]
x2 = x1 @ np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1.0]]).T + [1, 0.2, 0.1]
r1, r2 = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (x1, x2))
p1, p2 = (x[:, :2] / x[:, 2:] for x in (x1, x2))
found = [solve_five_point(r1[:5], r2[:5]), solve_seven_point(p1, p2), solve_four_point(p1[:4], p2[:4])]
found.append(solve_p3p(r2[:3], x1[:3]).matrix)
print(repr([np.round(f, 9).ravel().tolist() for f in found]))
"""


def test_solvers_give_the_same_answers_without_compilation():
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
    assert len(compiled) == 4
    for a, b in zip(compiled, interpreted, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)
