"""Kernels of the refinement against slow twins."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib import _refine_kernels as kernels
from calib.refine_board import board_shape
from calib.refine_lenses import lens_by_name
from calib.refine_system import CalibrationSystem, Estimate
from calib.refine_views import BoardView, gather
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.optim.losses import evaluate_loss
from tests.calib.boards_in_space import FISHEYE, LENS, flat_board, poses_before, seen

BOARD = flat_board(11, 8)  # 88 corners: more than the lanes of one pass


def covered(view: BoardView, rng: np.random.Generator) -> BoardView:
    """The view with a covariance for each corner."""
    roots = rng.normal(size=(len(view.corner_ids), 2, 2)) * 0.1 + 0.3 * np.eye(2)
    return dataclasses.replace(view, covariances=roots @ roots.swapaxes(1, 2))


def problem(camera, rng, shape="paraboloid"):
    poses = poses_before(camera, 4, rng)
    views = [covered(view, rng) for view in seen(camera, BOARD, poses, rng, 1.0)]
    bent = board_shape(shape, BOARD)
    bent = dataclasses.replace(bent, coefficients=0.01 * rng.normal(size=bent.basis.shape[2]))
    stacked = Rigid3.stack(poses)
    return gather(BOARD, views), Estimate(camera, stacked.rotation.matrix, np.array(stacked.translation), bent)


def whitened(observations, camera, shape, R, t) -> np.ndarray:
    """Residuals (n, 2) by the plain functions."""
    view = observations.view_of
    points = np.einsum("nij,nj->ni", R[view], shape.points3D[observations.rows]) + t[view]
    d = camera.project(points)[0] - observations.points2D
    a, b, c = observations.roots.T
    return np.stack([a * d[:, 0] + b * d[:, 1], c * d[:, 1]], 1)


PRISM = Camera(
    "FULL_OPENCV_THIN_PRISM", 1280, 960,
    np.array([900, 905, 644, 473, -0.2, 0.05, 1e-3, -5e-4, 0.01, 0.05, 0.02, 0.004, 2e-3, -1e-3, -3e-3, 1e-3]),
)  # fmt: skip
RADIAL = Camera("RADIAL", 1280, 960, np.array([1050.0, 651.0, 468.0, -0.21, 0.09]))


@pytest.mark.parametrize(
    ("camera", "lens"), [(LENS, "opencv4"), (PRISM, "opencv12"), (RADIAL, "radial"), (FISHEYE, "fisheye")]
)
def test_blocks_are_products_of_numeric_derivatives(camera, lens, rng):
    observations, estimate = problem(camera, rng)
    columns = lens_by_name(lens).columns()
    system = CalibrationSystem(observations, estimate, columns, free_shape=True)

    def residuals(view: int, x: np.ndarray) -> np.ndarray:
        R, t = estimate.rotations.copy(), estimate.translations.copy()
        turn = Rotation3.exp(x[:3])
        R[view], t[view] = turn.matrix @ R[view], turn @ t[view] + x[3:6]
        params = camera.params.copy()
        params[columns] += x[6 : 6 + len(columns)]
        coefficients = estimate.shape.coefficients + x[6 + len(columns) :]
        bent = dataclasses.replace(estimate.shape, coefficients=coefficients)
        rows = slice(observations.offsets[view], observations.offsets[view + 1])
        return whitened(observations, camera.with_params(params), bent, R, t)[rows].ravel()

    width = 6 + len(columns) + 3
    steps = np.r_[np.full(6, 1e-6), np.abs(camera.params[columns]) * 1e-5 + 1e-7, np.full(3, 1e-6)]
    for view in range(len(observations)):
        J = np.empty((len(residuals(view, np.zeros(width))), width + 1))
        for k in range(width):
            x = np.zeros(width)
            x[k] = steps[k]
            J[:, k] = (residuals(view, x) - residuals(view, -x)) / (2 * steps[k])
        J[:, -1] = residuals(view, np.zeros(width))
        expected, scale = J.T @ J, np.sqrt(np.diag(J.T @ J))
        found = np.tril(system.blocks[view])
        np.testing.assert_allclose(
            found / np.outer(scale, scale), np.tril(expected / np.outer(scale, scale)), atol=1e-6
        )
        assert system.view_costs[view] == pytest.approx(0.5 * expected[-1, -1], rel=1e-12)


def test_a_robust_loss_weighs_each_corner(rng):
    observations, estimate = problem(LENS, rng)
    system = CalibrationSystem(observations, estimate, lens_by_name("opencv4").columns(), loss="cauchy", loss_scale=0.7)
    e = whitened(observations, LENS, estimate.shape, estimate.rotations, estimate.translations)
    rho, weight = evaluate_loss("cauchy", np.sum(e**2, 1), 0.7)
    view = observations.view_of
    np.testing.assert_allclose(system.view_costs, 0.5 * np.bincount(view, rho), rtol=1e-12)
    np.testing.assert_allclose(system.blocks[:, -1, -1], np.bincount(view, weight * np.sum(e**2, 1)), rtol=1e-12)


def test_residuals_are_in_px_and_do_not_disturb_the_blocks(rng):
    observations, estimate = problem(LENS, rng)
    system = CalibrationSystem(observations, estimate, lens_by_name("opencv4").columns())
    before = system.blocks.copy()
    points = np.einsum(
        "nij,nj->ni", estimate.rotations[observations.view_of], estimate.shape.points3D[observations.rows]
    )
    pixels, _ = LENS.project(points + estimate.translations[observations.view_of])
    np.testing.assert_allclose(system.residuals(), pixels - observations.points2D, atol=1e-10)
    np.testing.assert_array_equal(system.blocks, before)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_a_step_solves_the_whole_normal_equations(damping, rng):
    observations, estimate = problem(LENS, rng)
    system = CalibrationSystem(observations, estimate, lens_by_name("opencv4").columns(), free_shape=True)
    views, shared = len(observations), system.shared_count
    H, g = np.zeros((6 * views + shared,) * 2), np.zeros(6 * views + shared)
    for v, block in enumerate(system.blocks):
        full = np.tril(block) + np.tril(block, -1).T
        at = np.r_[np.arange(6 * v, 6 * v + 6), np.arange(6 * views, 6 * views + shared)]
        H[np.ix_(at, at)] += full[:-1, :-1]
        g[at] += full[-1, :-1]
    diagonal = np.diag(H).copy()
    expected = -np.linalg.solve(H + damping * np.diag(diagonal), g)
    L, Y, S = np.zeros((views, 6, 6)), np.empty((views, 6, shared + 1)), np.empty((shared + 1, shared + 1))
    of_poses, of_shared = diagonal[: 6 * views].reshape(-1, 6), diagonal[6 * views :]
    by_pose, by_shared, straight = np.empty((views, 6)), np.empty(shared), np.zeros((shared, shared))
    assert kernels.eliminate_views(system.blocks, of_poses, damping, L, Y, S)
    square, slope, damped = kernels.step_views(
        system.blocks, of_poses, of_shared, damping, L, Y, S, straight, np.zeros_like(S), by_pose, by_shared
    )
    assert square == pytest.approx(expected @ expected, rel=1e-6)
    assert slope == pytest.approx(g @ expected, rel=1e-9)
    assert damped == pytest.approx(diagonal @ expected**2, rel=1e-6)
    scale = np.sqrt(diagonal)
    np.testing.assert_allclose(np.r_[by_pose.ravel(), by_shared] * scale, expected * scale, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(
        system.shared_inverse(), np.linalg.inv(H)[6 * views :, 6 * views :], rtol=1e-5, atol=1e-12
    )


def test_a_view_without_corners_cannot_be_solved():
    assert not kernels.eliminate_views(
        np.zeros((1, 8, 8)), np.zeros((1, 6)), 0.0, np.zeros((1, 6, 6)), np.zeros((1, 6, 2)), np.zeros((2, 2))
    )


def test_what_is_shared_and_not_determined_has_no_step():
    blocks = np.eye(9)[None].copy()
    blocks[0, 7, 7] = 0.0
    L, Y, S = np.zeros((1, 6, 6)), np.zeros((1, 6, 3)), np.zeros((3, 3))
    assert kernels.eliminate_views(blocks, np.ones((1, 6)), 0.0, L, Y, S)
    parts = L, Y, S, np.zeros((2, 2)), np.zeros((3, 3)), np.zeros((1, 6)), np.zeros(2)
    assert np.all(np.isnan(kernels.step_views(blocks, np.ones((1, 6)), np.ones(2), 0.0, *parts)))


def random_definite(count: int, rng: np.random.Generator) -> np.ndarray:
    root = rng.normal(size=(count, count))
    return root @ root.T + 0.1 * np.eye(count)


def test_a_secant_bends_the_matrix_as_the_gradient_has_grown(rng):
    H, bend = random_definite(5, rng), random_definite(5, rng) - random_definite(5, rng)
    step, gradient = rng.normal(size=5), rng.normal(size=5)
    grown = (H + random_definite(5, rng)) @ step
    S = np.zeros((6, 6))
    S[:5, :5], S[5, :5] = np.tril(H), gradient + grown
    lacking = grown - H @ step
    sized = bend * min(1.0, abs(step @ lacking) / abs(step @ bend @ step))
    rest = lacking - sized @ step
    along = grown @ step
    expected = sized + (np.outer(rest, grown) + np.outer(grown, rest)) / along
    expected -= (rest @ step) * np.outer(grown, grown) / along**2
    kernels.bend_by_secant(S, step, gradient, bend)
    np.testing.assert_allclose(bend, expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose((H + bend) @ step, grown, rtol=1e-10)


def test_a_gradient_that_does_not_grow_along_the_step_bends_nothing(rng):
    H, step = random_definite(3, rng), rng.normal(size=3)
    S, bend = np.zeros((4, 4)), np.zeros((3, 3))
    S[:3, :3], S[3, :3] = np.tril(H), -step
    kernels.bend_by_secant(S, step, np.zeros(3), bend)
    np.testing.assert_array_equal(bend, 0.0)


def test_damping_is_by_the_diagonal_of_the_normal_matrix_and_never_zero(rng):
    blocks = rng.uniform(0.1, 1.0, (3, 9, 9))
    blocks[:, 7, 7] = 0.0  # a parameter that no view tells of
    blocks[1, 2, 2] = 0.0
    diagonal, shared_diagonal = np.empty((3, 6)), np.empty(2)
    steepest = kernels.scale_views(blocks, 1e-3, 0.5, diagonal, shared_diagonal)
    of_poses = np.diagonal(blocks, axis1=1, axis2=2)[:, :6]
    np.testing.assert_allclose(diagonal, 0.5 * np.maximum(of_poses, 1e-3 * of_poses.max()))
    np.testing.assert_allclose(shared_diagonal, [0.5 * blocks[:, 6, 6].sum(), 0.5])
    assert steepest == pytest.approx(max(blocks[:, 8, :6].max(), blocks[:, 8, 6:8].sum(0).max()))


def test_poses_move_by_the_exponential_on_the_left(rng):
    R, t = Rotation3.exp(rng.normal(size=(5, 3))).matrix, rng.normal(size=(5, 3))
    steps = rng.normal(size=(5, 6)) * np.array([1.0, 1e-2, 1e-5, 0.0, 3.0])[:, None]
    new_R, new_t = np.empty_like(R), np.empty_like(t)
    kernels.move_poses(R, t, steps, new_R, new_t)
    turns = Rotation3.exp(steps[:, :3])
    np.testing.assert_allclose(new_R, turns.matrix @ R, atol=1e-14)
    np.testing.assert_allclose(new_t, turns @ t + steps[:, 3:], atol=1e-13)
