from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from sfm.core.geometry.epipolar import essential_from_pose
from sfm.core.geometry.minimal._linear_kernels import solve
from sfm.core.geometry.minimal._polynomial_kernels import real_roots
from sfm.core.geometry.minimal._six_point_kernels import _constraints
from sfm.core.geometry.minimal.p4pf import solve_p4pf
from sfm.core.geometry.minimal.six_point import solve_six_point_one_sided_focal, solve_six_point_shared_focal
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

PRINCIPAL_TO_CORNER = np.array([800.0, 600.0])


def _photographed_twice(rng, focal1, focal2, count=6):
    """Points in both of two images of 1600 × 1200 px whose cameras look at them from different sides."""
    while True:
        points2D_1 = rng.uniform(-1, 1, (count, 2)) * PRINCIPAL_TO_CORNER
        depths = rng.uniform(3, 6, (count, 1)) * focal1 / 1900
        points = np.concatenate([points2D_1 / focal1, np.ones((count, 1))], axis=1) * depths
        turned = Rotation3.exp(rng.normal(size=3) * 0.25)
        pose = Rigid3(turned, turned @ (rng.normal(size=3) * [1, 0.3, 0.5]))
        middle = (pose @ points).mean(0)
        axis = np.cross(middle, [0, 0, 1.0])
        angle = np.arctan2(np.linalg.norm(axis), middle[2])
        aim = Rotation3.exp(axis / np.linalg.norm(axis) * angle + rng.normal(size=3) * 0.05 * 1900 / focal2)
        pose = Rigid3(aim, np.zeros(3)) @ pose
        seen = pose @ points
        points2D_2 = focal2 * seen[:, :2] / seen[:, 2:]
        if seen[:, 2].min() > 0 and (np.abs(points2D_2) < 1.2 * PRINCIPAL_TO_CORNER).all():
            return points2D_1, points2D_2, pose


def _fundamental(pose, focal1, focal2):
    inverse1, inverse2 = (np.diag([1 / f, 1 / f, 1.0]) for f in (focal1, focal2))
    matrix = inverse2 @ essential_from_pose(pose) @ inverse1
    return matrix / np.linalg.norm(matrix)


def _error(found, true_matrix, true_focal):
    """The relative error of F or f, whichever is larger, of the best solution."""
    matrices, focals = found
    signs = np.sign(np.einsum("sij,ij->s", matrices, true_matrix))[:, None, None]
    by_matrix = np.abs(signs * matrices - true_matrix).max((1, 2)) / np.abs(true_matrix).max()
    return np.maximum(by_matrix, np.abs(focals / true_focal - 1)).min(initial=np.inf)


def test_six_points_contain_the_true_shared_focal_length_for_every_field_of_view():
    rng = np.random.default_rng(0)
    errors = []
    for focal in np.repeat([800.0, 1200, 1900, 4000], 250):
        points2D_1, points2D_2, pose = _photographed_twice(rng, focal, focal)
        found = solve_six_point_shared_focal(points2D_1, points2D_2)
        errors.append(_error(found, _fundamental(pose, focal, focal), focal))
        assert len(found[0]) <= 15
    assert np.mean(np.array(errors) > 1e-6) < 0.01
    assert np.median(errors) < 1e-12


def test_six_points_contain_the_true_focal_length_beside_a_calibrated_camera():
    rng = np.random.default_rng(1)
    errors = []
    for focal in np.repeat([800.0, 1200, 1900, 4000], 250):
        points2D_1, points2D_2, pose = _photographed_twice(rng, focal, 1900.0)
        found = solve_six_point_one_sided_focal(points2D_1, points2D_2 / 1900)
        errors.append(_error(found, _fundamental(pose, focal, 1.0), focal))
        assert len(found[0]) <= 9
    assert np.mean(np.array(errors) > 1e-6) < 0.01
    assert np.median(errors) < 1e-12


@pytest.mark.parametrize("shared", [True, False])
def test_all_solutions_of_six_points_fit_them_and_make_an_essential_matrix(shared):
    rng = np.random.default_rng(2)
    fits, gaps = [], []
    for _ in range(200):
        points2D_1, points2D_2, _ = _photographed_twice(rng, 1500.0, 1500.0)
        a, b = points2D_1 / 1500, points2D_2 / 1500
        matrices, focals = (solve_six_point_shared_focal if shared else solve_six_point_one_sided_focal)(a, b)
        one = np.ones((6, 1))
        fits += np.abs(np.einsum("ni,sij,nj->sn", np.hstack([b, one]), matrices, np.hstack([a, one]))).ravel().tolist()
        for matrix, focal in zip(matrices, focals, strict=True):
            k1, k2 = np.diag([focal, focal, 1.0]), np.diag([focal, focal, 1.0]) if shared else np.eye(3)
            first, second, third = np.linalg.svd(k2 @ matrix @ k1)[1]
            gaps.append(max(first - second, third) / first)
    assert max(fits) < 1e-9
    assert np.mean(np.array(gaps) > 1e-6) < 0.01


@pytest.mark.parametrize("shared", [True, False])
def test_the_cubics_of_the_six_point_kernel_are_the_trace_and_determinant_constraints(shared):
    rng = np.random.default_rng(3)
    forms, c = rng.normal(size=(3, 3, 3)), np.empty((3, 10, 10))
    _constraints(forms, shared, c)
    x, y, w = rng.normal(size=3)
    F = x * forms[:, :, 0] + y * forms[:, :, 1] + forms[:, :, 2]
    Q1, Q2 = np.diag([1, 1, w]), np.diag([1, 1, w]) if shared else np.eye(3)
    S = F @ Q1 @ F.T @ Q2
    expected = np.append((2 * S @ F - np.trace(S) * F).ravel(), np.linalg.det(F))
    monomials = [x**3, x * x * y, x * y * y, y**3, x * x, x * y, y * y, x, y, 1]
    np.testing.assert_allclose((c[0] + w * c[1] + w * w * c[2]) @ monomials, expected, rtol=1e-9, atol=1e-12)


def _seen_points(rng, focal, thickness):
    """Four points in one image of 1600 × 1200 px, in a slab of a relative thickness."""
    while True:
        pose = Rigid3(Rotation3.exp(rng.normal(size=3)), rng.normal(size=3) * 0.3 + [0, 0, 4 * focal / 1900])
        points = Rotation3.exp(rng.normal(size=3)) @ (rng.uniform(-1, 1, (4, 3)) * [1, 1, thickness])
        seen = pose @ points
        points2D = focal * seen[:, :2] / seen[:, 2:]
        if seen[:, 2].min() > 0.5 and (np.abs(points2D) < PRINCIPAL_TO_CORNER).all():
            return (
                points2D,
                points * 10 + 7,
                Rigid3(pose.rotation, pose.translation * 10 - pose.rotation @ np.full(3, 7.0)),
            )


@pytest.mark.parametrize("thickness", [1.0, 0.01, 0.0])
def test_four_points_contain_the_true_pose_and_focal_length_also_on_a_plane(thickness):
    rng = np.random.default_rng(4)
    errors = []
    for focal in np.repeat([1000.0, 1900, 5000], 333):
        points2D, points3D, pose = _seen_points(rng, focal, thickness)
        found, focals = solve_p4pf(points2D, points3D)
        assert len(focals) <= 8
        error = np.abs(focals / focal - 1) + np.abs(found.rotation.matrix - pose.rotation.matrix).max((1, 2))
        error += np.abs(found.translation - pose.translation).max(1) / np.linalg.norm(pose.translation)
        errors.append(error.min(initial=np.inf))
    assert np.mean(np.array(errors) > 1e-6) < 0.01
    assert np.median(errors) < 1e-12


def test_all_solutions_of_four_exact_points_that_show_them_there_see_them_in_front():
    rng = np.random.default_rng(5)
    for _ in range(200):
        points2D, points3D, _ = _seen_points(rng, 1900.0, 1.0)
        found, focals = solve_p4pf(points2D, points3D)
        for k, focal in enumerate(focals):
            seen = found[k] @ points3D
            np.testing.assert_allclose(found[k].rotation.matrix @ found[k].rotation.matrix.T, np.eye(3), atol=1e-9)
            if np.abs(focal * seen[:, :2] / seen[:, 2:] - points2D).max() < 1e-3:
                assert (seen[:, 2] > 0).all()


def test_the_unit_of_the_pixels_is_that_of_the_focal_length():
    rng = np.random.default_rng(6)
    a, b, _ = _photographed_twice(rng, 1500.0, 1500.0)
    for solver, other in ((solve_six_point_shared_focal, b), (solve_six_point_one_sided_focal, b / 1500)):
        in_px = solver(a, other)[1]
        in_thousands = solver(a / 1000, other / 1000 if other is b else other)[1]
        np.testing.assert_allclose(np.sort(in_thousands) * 1000, np.sort(in_px), rtol=1e-6)
    points2D, points3D, _ = _seen_points(rng, 1900.0, 1.0)
    in_px, in_thousands = solve_p4pf(points2D, points3D)[1], solve_p4pf(points2D / 1000, points3D)[1]
    np.testing.assert_allclose(np.sort(in_thousands) * 1000, np.sort(in_px), rtol=1e-6)


DEGENERATE = {
    "one point": (np.ones((6, 2)), np.ones((6, 3))),
    "a line": (np.arange(6.0)[:, None] * [1.0, 2], np.arange(6.0)[:, None] * [1.0, 2, 3]),
    "nothing": (np.zeros((6, 2)), np.zeros((6, 3))),
    "not a number": (np.full((6, 2), np.nan), np.full((6, 3), np.nan)),
    "infinite": (np.full((6, 2), np.inf), np.full((6, 3), np.inf)),
    "a frontal plane": (
        np.array([[0.0, 0], [1, 0], [0, 1], [1, 1], [2, 1], [1, 3]]),
        np.array([[0.0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1], [2, 1, 1], [1, 3, 1]]),
    ),
}


@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_samples_give_no_solution_or_a_finite_one(case):
    flat, solid = DEGENERATE[case]
    for solver in (solve_six_point_shared_focal, solve_six_point_one_sided_focal):
        for partners in (flat, flat + 0.5, flat[::-1]):
            matrices, focals = solver(flat, partners)
            assert np.isfinite(matrices).all()
            assert np.isfinite(focals).all()
    for points3D in (solid, solid[::-1]):
        poses, focals = solve_p4pf(flat[:4], points3D[:4])
        assert np.isfinite(poses.matrix).all()
        assert np.isfinite(focals).all()


def test_a_sample_of_the_wrong_size_is_refused():
    for solver, widths in ((solve_six_point_shared_focal, (2, 2)), (solve_p4pf, (2, 3))):
        with pytest.raises(ValueError, match="minimal sample"):
            solver(np.ones((3, widths[0])), np.ones((3, widths[1])))
    with pytest.raises(ValueError, match="minimal sample"):
        solve_six_point_one_sided_focal(np.ones((5, 2)), np.ones((5, 2)))


def test_linear_systems_are_solved_as_by_numpy():
    rng = np.random.default_rng(7)
    for size in (3, 4):
        a, b = rng.normal(size=(size, size)), rng.normal(size=size)
        a[0, 0] = 0.0
        x = b.copy()
        solve(a.copy(), x)
        np.testing.assert_allclose(x, np.linalg.solve(a, b), rtol=1e-9)


def test_roots_within_the_unit_interval_are_those_of_the_companion_matrix():
    rng = np.random.default_rng(8)
    out = np.empty(16)
    for _ in range(200):
        c = rng.normal(size=int(rng.integers(2, 17)))
        expected = np.roots(c[::-1])
        expected = np.sort(expected[(np.abs(expected.imag) < 1e-9) & (np.abs(expected.real) < 1)].real)
        np.testing.assert_allclose(np.sort(out[: real_roots(c, out, True)]), expected, rtol=1e-6, atol=1e-8)
    assert real_roots(np.zeros(5), out, True) == 0


_PROGRAM = """
import numpy as np
from sfm.core.geometry.minimal.p4pf import solve_p4pf
from sfm.core.geometry.minimal.six_point import solve_six_point_one_sided_focal, solve_six_point_shared_focal
rng = np.random.default_rng(7)
x1 = rng.uniform(-1, 1, (6, 3)) + [0, 0, 5]
x2 = x1 @ np.array([[0.8, 0, -0.6], [0, 1.0, 0], [0.6, 0, 0.8]]).T + [3, 0.2, 1.1]
p1, p2 = (x[:, :2] / x[:, 2:] for x in (x1, x2))
found = [*solve_six_point_shared_focal(p1, p2), *solve_six_point_one_sided_focal(p1, p2)]
poses, focals = solve_p4pf(p2[:4], x1[:4])
found += [poses.matrix, focals]
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
    assert all(len(values) for values in compiled)
    for a, b in zip(compiled, interpreted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-8)
