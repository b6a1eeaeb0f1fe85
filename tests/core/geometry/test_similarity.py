import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew
from sfm.core.geometry.similarity import Sim3, estimate_similarity

ANGLES = st.one_of(st.sampled_from([0.0, 1e-12, 1e-4, np.pi - 1e-9, np.pi]), st.floats(0, np.pi))
DIRECTIONS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)
VECTORS = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)
LOG_SCALES = st.one_of(st.sampled_from([0.0, 1e-12, -1e-6]), st.floats(-2, 2))
TANGENTS = st.builds(
    lambda direction, angle, upsilon, lam: np.concatenate(
        [angle * np.array(direction) / np.linalg.norm(direction), upsilon, [lam]]
    ),
    DIRECTIONS,
    ANGLES,
    VECTORS,
    LOG_SCALES,
)
SIMILARITIES = TANGENTS.map(Sim3.exp)
SEEDS = st.integers(0, 2**32 - 1)


def assert_same(a, b, rtol=1e-11):
    np.testing.assert_allclose(a.matrix, b.matrix, rtol=rtol, atol=rtol * np.abs(b.matrix).max())


@given(SIMILARITIES, SIMILARITIES, SIMILARITIES)
def test_composition_is_associative(a, b, c):
    assert_same((a @ b) @ c, a @ (b @ c))


@given(SIMILARITIES)
def test_a_similarity_times_its_inverse_is_the_identity(a):
    np.testing.assert_allclose((a @ a.inverse()).matrix, np.eye(3, 4), rtol=0, atol=1e-12)
    np.testing.assert_allclose((a.inverse() @ a).matrix, np.eye(3, 4), rtol=0, atol=1e-11)
    assert_same(a @ Sim3.identity(), a)
    assert_same(Sim3.identity() @ a, a)


@given(SIMILARITIES, SIMILARITIES)
def test_inverse_of_a_product_is_the_reversed_product(a, b):
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse())


@given(SIMILARITIES, SIMILARITIES, VECTORS)
def test_a_product_acts_as_one_after_the_other_and_as_its_matrix(a, b, x):
    np.testing.assert_allclose((a @ b) @ x, a @ (b @ x), rtol=1e-11, atol=1e-10)
    np.testing.assert_allclose(a @ x, a.matrix @ np.append(x, 1), rtol=1e-12, atol=1e-12)


@given(TANGENTS)
def test_exp_is_the_matrix_exponential(zeta):
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(zeta[:3]) + zeta[6] * np.eye(3), zeta[3:6]
    expected = expm(generator)[:3]
    np.testing.assert_allclose(Sim3.exp(zeta).matrix, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@given(TANGENTS)
def test_log_undoes_exp(zeta):
    if np.linalg.norm(zeta[:3]) < np.pi - 1e-8:  # at π the axis may come back reversed
        np.testing.assert_allclose(Sim3.exp(zeta).log(), zeta, rtol=0, atol=1e-11)


@given(SIMILARITIES)
def test_exp_undoes_log(a):
    assert_same(Sim3.exp(a.log()), a)


@given(SIMILARITIES, TANGENTS)
def test_the_adjoint_carries_a_tangent_across(a, zeta):
    assert_same(a @ Sim3.exp(zeta), Sim3.exp(a.adjoint() @ zeta) @ a, rtol=1e-9)


@given(TANGENTS)
def test_at_scale_one_it_is_a_rigid_motion(zeta):
    zeta = np.append(zeta[:6], 0.0)
    motion = Rigid3.exp(zeta[:6])
    assert_same(Sim3.exp(zeta), Sim3.from_rigid(motion))
    np.testing.assert_allclose(Sim3.from_rigid(motion).adjoint()[:6, :6], motion.adjoint(), rtol=0, atol=1e-13)


def test_batch_axes_equal_a_loop(rng):
    zetas, others = rng.normal(size=(2, 2, 4, 7))
    points, poses = rng.normal(size=(2, 4, 3)), Rigid3.exp(rng.normal(size=(2, 4, 6)))
    batch, other = Sim3.exp(zetas), Sim3.exp(others)
    assert batch.shape == (2, 4)
    assert len(batch) == 2
    moved, product, inverse, posed = batch @ points, batch @ other, batch.inverse(), batch.transform_pose(poses)
    for k in np.ndindex(2, 4):
        single = Sim3.exp(zetas[k])
        assert single.shape == ()
        assert_same(batch[k], single)
        assert_same(product[k], single @ other[k])
        assert_same(inverse[k], single.inverse())
        np.testing.assert_allclose(moved[k], single @ points[k], rtol=1e-12)
        np.testing.assert_allclose(posed[k].matrix, single.transform_pose(poses[k]).matrix, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(batch.log()[k], single.log(), rtol=0, atol=1e-12)
        np.testing.assert_allclose(batch.adjoint()[k], single.adjoint(), rtol=0, atol=1e-12)


@given(TANGENTS, SEEDS)
def test_transformed_poses_keep_every_projection(zeta, seed):
    rng = np.random.default_rng(seed)
    new_from_world, cams_from_world = Sim3.exp(zeta), Rigid3.exp(rng.normal(size=(3, 6)))
    points_in_world = rng.normal(size=(5, 3))
    cams_from_new = new_from_world.transform_pose(cams_from_world)
    in_cams = cams_from_world[:, None] @ points_in_world[None]
    again = cams_from_new[:, None] @ (new_from_world @ points_in_world)[None]
    np.testing.assert_allclose(again, new_from_world.scale * in_cams, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(cams_from_new.center, new_from_world @ cams_from_world.center, rtol=1e-9, atol=1e-9)


@given(SIMILARITIES, SEEDS, st.integers(3, 20))
def test_exact_points_give_back_their_similarity(b_from_a, seed, count):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    found = estimate_similarity(points, b_from_a @ points)
    np.testing.assert_allclose(found @ points, b_from_a @ points, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.scale, b_from_a.scale, rtol=1e-9)


def test_coplanar_points_are_enough(rng):
    points = rng.normal(size=(10, 3)) * [1, 1, 0]
    b_from_a = Sim3.exp(rng.normal(size=7))
    assert_same(estimate_similarity(points, b_from_a @ points), b_from_a)


@pytest.mark.parametrize("with_scale", [True, False])
def test_no_other_similarity_fits_noisy_points_better(rng, with_scale):
    points = rng.normal(size=(30, 3))
    target = Sim3.exp(rng.normal(size=7)) @ points + 0.1 * rng.normal(size=(30, 3))
    best = estimate_similarity(points, target, with_scale=with_scale)
    cost = np.square(best @ points - target).sum()
    for _ in range(200):
        step = 1e-3 * rng.normal(size=7) * ([1] * 6 + [with_scale])
        assert np.square((Sim3.exp(step) @ best) @ points - target).sum() > cost


def test_without_scale_the_scale_is_one(rng):
    points = rng.normal(size=(5, 3))
    assert estimate_similarity(points, 2 * points, with_scale=False).scale == 1


def test_mirrored_points_still_give_a_proper_rotation(rng):
    points = rng.normal(size=(20, 3))
    found = estimate_similarity(points, points * [1, 1, -1])
    assert np.linalg.det(found.rotation.matrix) == pytest.approx(1)
    assert found.scale > 0


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_collinear_points_are_rejected(rng, offset):
    line = offset + np.outer(np.linspace(0, 1, 7), rng.normal(size=3))
    anything = rng.normal(size=(7, 3))
    for a, b in [(line, anything), (anything, line), (line, line)]:
        found = estimate_similarity(a, b)
        assert isinstance(found, Rejected)
        assert found.reason == "collinear_points"


def test_coincident_points_are_rejected():
    assert not estimate_similarity(np.ones((5, 3)), np.ones((5, 3)))


def test_two_points_are_too_few(rng):
    points = rng.normal(size=(2, 3))
    assert estimate_similarity(points, points) == Rejected("too_few_points", "2 of 3 needed")


def test_sets_of_different_length_are_refused(rng):
    with pytest.raises((ValueError, TypeError)):
        estimate_similarity(rng.normal(size=(4, 3)), rng.normal(size=(5, 3)))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan])
def test_a_scale_must_be_positive(scale):
    with pytest.raises(ValueError, match="not positive"):
        Sim3(np.float64(scale), Rotation3.identity(), np.zeros(3))


def test_batch_shapes_must_agree():
    with pytest.raises(ValueError, match="batch shape"):
        Sim3(np.ones(2), Rotation3.identity((3,)), np.zeros((3, 3)))
    with pytest.raises(TypeError):
        Sim3.identity() @ Rigid3.identity()
