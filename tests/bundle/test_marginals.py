"""Blocks of inverses, by dense and by sparse factors, against whole inverses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, RigArrays, covariance, covariance_bytes
from sfm.bundle.marginals import Marginals, marginals
from sfm.bundle.problem import SolverChoice
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.optim.block_pattern import BlockPattern
from sfm.core.optim.dense_cholesky import DenseCholesky
from sfm.core.optim.sparse_cholesky import SparseCholesky

CHOICES: tuple[tuple[SolverChoice, int], ...] = (("dense", 1), ("sparse", 2), ("iterative", 1))
factors = pytest.mark.parametrize("kind", [DenseCholesky, SparseCholesky])


def chain(rng, rows: int, motions: int) -> tuple[BlockPattern, np.ndarray, np.ndarray]:
    """A chain with loops, its S of rather different units, and what costs nothing (6 rows, motions)."""
    first = np.r_[np.arange(rows - 1), np.arange(rows - 2), [0, 1, 2]]
    second = np.r_[np.arange(1, rows), np.arange(2, rows), [rows - 1, rows - 2, rows - 3]]
    pattern, units = BlockPattern.of_pairs(rows, first, second), 10.0 ** rng.uniform(-2, 2, 6 * rows)
    Q, S = rng.normal(size=(6 * rows, motions)), np.zeros((6 * rows, 6 * rows))
    for a, b in zip(first, second, strict=True):
        six = np.r_[6 * a : 6 * a + 6, 6 * b : 6 * b + 6]
        J = rng.normal(size=(12, 12))
        if motions:
            J -= J @ Q[six] @ np.linalg.pinv(Q[six])
        S[np.ix_(six, six)] += J.T @ J
    return pattern, S * units * units[:, None], Q / units[:, None]


def blocks_of(matrix: np.ndarray, pattern: BlockPattern) -> np.ndarray:
    rows = np.repeat(np.arange(pattern.rows), np.diff(pattern.offsets))
    return np.ascontiguousarray(matrix.reshape(pattern.rows, 6, pattern.rows, 6)[rows, :, pattern.columns])


def pseudo_inverse(S: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """By the eigenvalues of S scaled to a diagonal of ones, then projected."""
    scale = 1 / np.sqrt(np.diag(S))
    values, vectors = np.linalg.eigh(S * scale * scale[:, None])
    some = (vectors[:, Q.shape[1] :] / values[Q.shape[1] :]) @ vectors[:, Q.shape[1] :].T * scale * scale[:, None]
    basis = np.linalg.qr(Q)[0]
    P = np.eye(len(S)) - basis @ basis.T
    return P @ some @ P


@factors
@pytest.mark.parametrize("motions", [0, 1, 7])
def test_blocks_of_a_projected_inverse_are_those_of_the_whole(kind, motions, rng):
    pattern, S, Q = chain(rng, 25, motions)
    free = np.ones(150, bool)
    found = marginals(pattern, blocks_of(S, pattern), kind(pattern, ~free), free, Q, 1)
    assert isinstance(found, Marginals)
    expected = pseudo_inverse(S, Q)
    sigmas = np.sqrt(np.diag(expected))
    unit = blocks_of(sigmas * sigmas[:, None], pattern)
    np.testing.assert_allclose(found.blocks / unit, blocks_of(expected, pattern) / unit, rtol=0, atol=1e-9)
    one, other = np.array([3, 2, -1, 24]), np.array([2, 3, 4, 24])
    between = found.between(one, other)
    np.testing.assert_array_equal(between[0], between[1].T)
    assert not between[2].any()
    np.testing.assert_allclose(between[3], expected[144:, 144:], rtol=0, atol=1e-9 * np.abs(expected[144:, 144:]).max())
    with pytest.raises(ValueError, match="1 blocks are not in the pattern"):
        found.between(np.array([3]), np.array([20]))


@factors
def test_motions_that_repeat_one_another_count_once(kind, rng):
    pattern, S, Q = chain(rng, 12, 2)
    free = np.ones(72, bool)
    one = marginals(pattern, blocks_of(S, pattern), kind(pattern, ~free), free, Q, 1)
    twice = np.c_[Q, Q[:, :1] - 2 * Q[:, 1:], np.zeros(72)]
    other = marginals(pattern, blocks_of(S, pattern), kind(pattern, ~free), free, twice, 1)
    assert isinstance(one, Marginals)
    assert isinstance(other, Marginals)
    np.testing.assert_allclose(one.blocks, other.blocks, rtol=1e-6, atol=1e-9 * np.abs(one.blocks).max())


@factors
def test_the_entry_that_is_left_open_is_found_beside_motions_and_held_ones(kind, rng):
    pattern, S, Q = chain(rng, 12, 3)
    for entry in (0, 35, 71):
        free = np.ones(72, bool)
        free[[7, 8]] = False
        alone = S.copy()
        alone[entry], alone[:, entry] = 0.0, 0.0
        Q[entry] = 0.0
        for diagonal in (0.0, np.nan):
            alone[entry, entry] = diagonal
            assert marginals(pattern, blocks_of(alone, pattern), kind(pattern, ~free), free, Q, 1) == entry
    # Two entries that are one and the same: neither is seen alone.
    J = np.eye(72)
    J[40], J[41] = 0.0, 0.0
    J[40, 40], J[40, 41] = 3.0, -1.0
    free = np.ones(72, bool)
    S = J.T @ J
    found = marginals(pattern, blocks_of(S, pattern), kind(pattern, ~free), free, np.zeros((72, 0)), 1)
    assert found in (40, 41)


def ring(make_problem, rng, images: int = 30) -> BundleProblem:
    """Images each of whose points are seen by a few neighbours."""
    kind = {"model": "OPENCV", "cameras": 3, "free_params": tuple(range(8)), "seen": 1.0}
    problem = make_problem(rng, images=images, points=30 * images, **kind)
    near = np.abs(problem.obs_images - problem.obs_points % images) <= 2 + (problem.obs_points % 7 == 0) * 3
    columns = {name: getattr(problem, name)[near] for name in ("obs_images", "obs_points", "obs_points2D")}
    return dataclasses.replace(problem, **columns)


@pytest.mark.parametrize("gauge", ["two_cameras", "three_points", "free"])
def test_covariances_by_a_sparse_factor_are_those_by_a_dense_one(make_problem, rng, gauge):
    problem = ring(make_problem, rng)
    dense, sparse, iterative = (
        covariance(problem, BundleConfig(gauge=gauge, solver=solver), threads=threads) for solver, threads in CHOICES
    )
    assert isinstance(dense, BundleCovariance)
    for other in (sparse, iterative):
        assert isinstance(other, BundleCovariance)
        for name in ("poses", "centers", "params", "points3D"):
            one, two = getattr(dense, name), getattr(other, name)
            sigmas = np.sqrt(np.einsum("naa->na", one))
            unit = sigmas[:, None] * sigmas[:, :, None] + 1e-9 * np.nanmax(np.abs(one))
            np.testing.assert_allclose(one / unit, two / unit, rtol=0, atol=1e-8)
        assert other.variance_factor == dense.variance_factor


def test_a_sensor_and_its_rig_make_up_the_covariance_of_an_image(make_problem, rng):
    problem = make_problem(rng, images=12, points=200, seen=0.9)
    mounts = Rigid3.exp(np.array([[0.05, -0.1, 0.02, 0.4, -0.1, 0.3]]))
    frames, sensors = np.repeat(np.arange(6), 2).astype(np.int32), np.tile([-1, 0], 6).astype(np.int32)
    rigs = RigArrays(frames, sensors, problem.cams_from_world[::2], mounts, np.array([True]))
    problem = dataclasses.replace(problem, rigs=rigs, cams_from_world=rigs.cams_from_world)
    observed = problem.cams_from_world[problem.obs_images] @ problem.points3D[problem.obs_points]
    fx, fy, cx, cy = problem.camera_params[0, :4]
    points2D = observed[:, :2] / observed[:, 2:] * [fx, fy] + [cx, cy]
    constant = np.zeros(12, bool)
    constant[2:] = True
    problem = dataclasses.replace(problem, obs_points2D=points2D, free_poses=constant)
    by_dense = covariance(problem)
    assert isinstance(by_dense, BundleCovariance)
    by_sparse = covariance(problem, BundleConfig(solver="sparse"))
    for found in (by_dense, by_sparse):
        assert isinstance(found, BundleCovariance)
        # The first rig is constant, and so is its reference; what the other image does is what its sensor does.
        assert not found.poses[0].any()
        assert np.linalg.eigvalsh(found.poses[1]).min() > 0
        np.testing.assert_allclose(found.poses, by_dense.poses, rtol=1e-6, atol=1e-12)


def test_an_open_pose_is_named_by_a_sparse_factor_too(make_problem, rng):
    problem = ring(make_problem, rng)
    kept = (problem.obs_images != 13) | (np.cumsum(problem.obs_images == 13) <= 2)
    columns = {name: getattr(problem, name)[kept] for name in ("obs_images", "obs_points", "obs_points2D")}
    problem = dataclasses.replace(problem, **columns, free_params=np.zeros_like(problem.free_params))
    for gauge in ("two_cameras", "free"):
        found = covariance(problem, BundleConfig(gauge=gauge, solver="sparse"))
        assert isinstance(found, Rejected)
        assert (found.reason, found.detail) == ("undetermined_pose", "13")


def test_covariances_by_a_sparse_factor_say_that_they_take_less_memory(make_problem, rng):
    """How much each takes is in `test_memory`."""
    problem = ring(make_problem, rng, 150)
    few, many = (covariance_bytes(problem, BundleConfig(solver=solver)) for solver in ("sparse", "dense"))
    assert 0.2 < few / many < 0.6
