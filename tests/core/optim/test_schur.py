from __future__ import annotations

import numpy as np
import pytest

from sfm.core.optim import schur


def packed(blocks):
    """Symmetric 3×3 blocks as (xx, xy, xz, yy, yz, zz)."""
    return np.ascontiguousarray(blocks[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])


def unpacked(rows):
    return rows[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def test_inverse_blocks_equal_numpy(rng):
    J = rng.normal(size=(50, 6, 3))
    blocks = np.einsum("pki,pkj->pij", J, J)
    for damping in (0.0, 1e-4, 1e3):
        M = np.empty((50, 6))
        schur.invert_blocks(0, 50, packed(blocks), damping, M)
        damped = blocks + damping * np.einsum("pii,ij->pij", blocks, np.eye(3))
        np.testing.assert_allclose(unpacked(M), np.linalg.inv(damped), rtol=1e-9, atol=1e-12 * np.abs(M).max())


def test_inverses_of_singular_blocks_are_finite_and_positive_semidefinite(rng):
    J = rng.normal(size=(40, 2, 3))
    J[20:, 1] = J[20:, 0]
    blocks = np.concatenate([np.einsum("pki,pkj->pij", J, J), np.zeros((1, 3, 3))])
    for damping in (0.0, 1e-12, 1e-4):
        M = np.empty((41, 6))
        schur.invert_blocks(0, 41, packed(blocks), damping, M)
        assert np.all(np.isfinite(M))
        values = np.linalg.eigvalsh(unpacked(M))
        assert np.all(values >= -1e-12 * values[:, -1:])
        assert np.all(M[40] == 0)


def random_couplings(rng, points, poses, cameras, size):
    """Couplings as the kernels want them: sorted by point and slot, an image twice in some points."""
    rows = [np.sort(rng.integers(0, poses, rng.integers(1, 6))) for _ in range(points)]
    point = np.repeat(np.arange(points), [len(r) for r in rows]).astype(np.int32)
    slot = np.concatenate(rows).astype(np.int32)
    starts = np.searchsorted(point, np.arange(points))
    border = [np.flatnonzero(rng.random(cameras) < 0.6) for _ in range(points)]
    border_point = np.repeat(np.arange(points), [len(r) for r in border]).astype(np.int32)
    border_slot = np.concatenate(border).astype(np.int32)
    offsets = np.searchsorted(border_point, np.arange(points + 1))
    W, B = rng.normal(size=(len(slot), 3, 6)), rng.normal(size=(len(border_slot), 3, size))
    return point, slot, starts, W, border_point, border_slot, offsets, B


@pytest.mark.parametrize(("stripes", "copies"), [(1, 1), (3, 1), (3, 3)])
def test_elimination_equals_the_dense_schur_complement(rng, stripes, copies):
    points, poses, cameras, size = 30, 5, 2, 3
    point, slot, starts, W, border_point, border_slot, offsets, B = random_couplings(rng, points, poses, cameras, size)
    M = packed(np.einsum("pki,pkj->pij", *[rng.normal(size=(points, 4, 3))] * 2))
    g = rng.normal(size=(points, 3))
    system = schur.ReducedSystem.allocate(poses, cameras * size, copies)
    for k in range(stripes):
        mine = np.flatnonzero(slot % stripes == k)
        schur.eliminate_poses(
            mine, starts, point, slot, W, M, g, offsets, border_slot, B,
            system.blocks[k % copies], system.border[k % copies], system.pose_side[k % copies],
        )  # fmt: skip
    everything = np.arange(len(border_slot))
    corner, corner_side = system.corner[0], system.corner_side[0]
    schur.eliminate_border(everything, offsets, border_point, border_slot, B, M, g, corner, corner_side)
    S, side = system.matrix(), system.side()

    E = np.zeros((6 * poses + cameras * size, 3 * points))
    for o in range(len(slot)):
        E[6 * slot[o] : 6 * slot[o] + 6, 3 * point[o] : 3 * point[o] + 3] += W[o].T
    for e in range(len(border_slot)):
        row = 6 * poses + size * border_slot[e]
        E[row : row + size, 3 * border_point[e] : 3 * border_point[e] + 3] += B[e].T
    inverse = np.zeros((3 * points, 3 * points))
    for p, block in enumerate(unpacked(M)):
        inverse[3 * p : 3 * p + 3, 3 * p : 3 * p + 3] = block
    np.testing.assert_allclose(np.tril(S), np.tril(-E @ inverse @ E.T), atol=1e-11)
    np.testing.assert_allclose(side, E @ inverse @ g.ravel(), atol=1e-11)


def small_system(rng, definite=True):
    J = rng.normal(size=(40, 15))
    full = J.T @ J if definite else -J.T @ J
    system = schur.ReducedSystem.allocate(2, 3)
    blocks = full[:12, :12].reshape(2, 6, 2, 6).transpose(0, 2, 1, 3)
    system.blocks[0] = blocks[[0, 1, 1], [0, 0, 1]]
    system.border[0] = full[12:, :12].reshape(3, 2, 6).transpose(1, 0, 2)
    system.corner[0] = full[12:, 12:]
    side = rng.normal(size=15)
    system.pose_side[0], system.corner_side[0] = side[:12].reshape(2, 6), side[12:]
    return system, full, side


def test_the_reduced_system_is_solved_with_held_entries_at_zero(rng):
    system, full, side = small_system(rng)
    held = np.zeros(15, bool)
    held[[0, 7, 13]] = True
    damping = np.linspace(0.1, 1, 15)
    delta = schur.solve_reduced(system, damping, held)
    keep = ~held
    expected = np.linalg.solve((full + np.diag(damping))[np.ix_(keep, keep)], side[keep])
    assert np.all(delta[held] == 0)
    np.testing.assert_allclose(delta[keep], expected, rtol=1e-9, atol=1e-12)


def test_an_indefinite_system_has_no_solution(rng):
    system, _, _ = small_system(rng, definite=False)
    assert schur.solve_reduced(system, np.zeros(15), np.zeros(15, bool)) is None
