import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew

ANGLES = st.one_of(
    st.sampled_from([0.0, 1e-12, 9.999e-5, 1.0001e-4, np.pi - 1e-9, np.pi]),
    st.floats(0, np.pi),
    st.floats(1e-12, 1e-3).map(lambda gap: np.pi - gap),
)
DIRECTIONS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)
VECTORS = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)
TANGENTS = st.builds(
    lambda direction, angle, upsilon: np.append(angle * np.array(direction) / np.linalg.norm(direction), upsilon),
    DIRECTIONS,
    ANGLES,
    VECTORS,
)
MOTIONS = TANGENTS.map(Rigid3.exp)


def assert_same(a, b, atol=1e-12):
    np.testing.assert_allclose(a.matrix, b.matrix, rtol=0, atol=atol)


@given(MOTIONS, MOTIONS, MOTIONS)
def test_composition_is_associative(a, b, c):
    assert_same((a @ b) @ c, a @ (b @ c))


@given(MOTIONS)
def test_the_identity_changes_nothing(a):
    assert_same(a @ Rigid3.identity(), a)
    assert_same(Rigid3.identity() @ a, a)


@given(MOTIONS)
def test_a_motion_times_its_inverse_is_the_identity(a):
    assert_same(a @ a.inverse(), Rigid3.identity())
    assert_same(a.inverse() @ a, Rigid3.identity())


@given(MOTIONS, MOTIONS)
def test_inverse_of_a_product_is_the_reversed_product(a, b):
    assert_same((a @ b).inverse(), b.inverse() @ a.inverse())


@given(MOTIONS, MOTIONS, VECTORS)
def test_a_product_acts_as_one_after_the_other(a, b, x):
    np.testing.assert_allclose((a @ b) @ x, a @ (b @ x), rtol=0, atol=1e-12)


@given(MOTIONS, VECTORS)
def test_a_motion_acts_as_its_matrix_and_keeps_distances(a, x):
    np.testing.assert_allclose(a @ x, a.matrix @ np.append(x, 1), rtol=0, atol=1e-13)
    assert np.linalg.norm(a @ x - a @ np.zeros(3)) == pytest.approx(np.linalg.norm(x), abs=1e-13)


@given(TANGENTS)
def test_exp_is_the_matrix_exponential(xi):
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(xi[:3]), xi[3:]
    np.testing.assert_allclose(Rigid3.exp(xi).matrix, expm(generator)[:3], rtol=0, atol=1e-13)


@given(TANGENTS)
def test_log_undoes_exp(xi):
    found = Rigid3.exp(xi).log()
    if np.linalg.norm(xi[:3]) < np.pi - 1e-8:  # at π the axis may come back reversed
        np.testing.assert_allclose(found, xi, rtol=0, atol=1e-12)


@given(MOTIONS)
def test_exp_undoes_log(a):
    assert_same(Rigid3.exp(a.log()), a)


@given(MOTIONS, TANGENTS)
def test_the_adjoint_carries_a_tangent_across(a, xi):
    assert_same(a @ Rigid3.exp(xi), Rigid3.exp(a.adjoint() @ xi) @ a, atol=1e-11)


@given(MOTIONS, MOTIONS)
def test_the_adjoint_of_a_product_is_the_product_of_adjoints(a, b):
    np.testing.assert_allclose((a @ b).adjoint(), a.adjoint() @ b.adjoint(), rtol=0, atol=1e-11)


@given(MOTIONS)
def test_the_centre_is_what_the_pose_sends_to_zero(cam_from_world):
    np.testing.assert_allclose(cam_from_world @ cam_from_world.center, 0, rtol=0, atol=1e-12)


@given(MOTIONS)
def test_from_matrix_undoes_matrix(a):
    assert_same(Rigid3.from_matrix(a.matrix), a, atol=1e-14)
    assert_same(Rigid3.from_matrix(np.vstack([a.matrix, [0, 0, 0, 1]])), a, atol=1e-14)


def test_batch_axes_equal_a_loop(rng):
    xis, others = rng.normal(size=(2, 2, 5, 6))
    points = rng.normal(size=(2, 5, 3))
    batch, other = Rigid3.exp(xis), Rigid3.exp(others)
    assert batch.shape == (2, 5)
    assert len(batch) == 2
    moved, product, inverse, adjoint = batch @ points, batch @ other, batch.inverse(), batch.adjoint()
    for k in np.ndindex(2, 5):
        single = Rigid3.exp(xis[k])
        assert single.shape == ()
        assert_same(batch[k], single, atol=1e-14)
        assert_same(product[k], single @ other[k])
        assert_same(inverse[k], single.inverse())
        np.testing.assert_allclose(batch.log()[k], single.log(), rtol=0, atol=1e-13)
        np.testing.assert_allclose(batch.center[k], single.center, rtol=0, atol=1e-14)
        np.testing.assert_allclose(moved[k], single @ points[k], rtol=0, atol=1e-14)
        np.testing.assert_allclose(adjoint[k], single.adjoint(), rtol=0, atol=1e-14)
        np.testing.assert_array_equal(batch.matrix[k], batch[k].matrix)


def test_one_pose_composes_with_a_batch(rng):
    cams_from_world, world_from_new = Rigid3.exp(rng.normal(size=(4, 6))), Rigid3.exp(rng.normal(size=6))
    batch = cams_from_world @ world_from_new
    assert batch.shape == (4,)
    for k in range(4):
        assert_same(batch[k], cams_from_world[k] @ world_from_new)


def test_stacking_undoes_iteration(rng):
    batch = Rigid3.exp(rng.normal(size=(4, 6)))
    again = Rigid3.stack(list(batch))
    np.testing.assert_array_equal(again.rotation.wxyz, batch.rotation.wxyz)
    np.testing.assert_array_equal(again.translation, batch.translation)
    assert Rigid3.stack([]).shape == (0,)


def test_batches_of_different_shape_are_refused():
    with pytest.raises(ValueError, match="batch shape"):
        Rigid3(Rotation3.identity((2,)), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="expected an array"):
        Rigid3(Rotation3.identity(), np.zeros(2))


def test_a_motion_does_not_multiply_what_is_no_point():
    with pytest.raises(ValueError, match="expected points"):
        Rigid3.identity() @ np.zeros((2, 4))
    with pytest.raises(TypeError):
        Rigid3.identity() @ 3.0
