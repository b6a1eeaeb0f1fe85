import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation as ScipyRotation

from sfm.core.geometry.rotation import Rotation3, left_jacobian, skew

DIRECTIONS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)
# Zero, below and above the switch to the series, ordinary, just below π and π itself.
ANGLES = st.one_of(
    st.sampled_from([0.0, 1e-300, 1e-12, 9.999e-5, 1e-4, 1.0001e-4, np.pi - 1e-9, np.pi - 1e-15, np.pi]),
    st.floats(0, np.pi),
    st.floats(1e-9, 1e-3),
    st.floats(1e-12, 1e-3).map(lambda gap: np.pi - gap),
)


def _rotation_vector(direction, angle):
    return angle * np.asarray(direction) / np.linalg.norm(direction)


OMEGAS = st.builds(_rotation_vector, DIRECTIONS, ANGLES)
ROTATIONS = OMEGAS.map(Rotation3.exp)
VECTORS = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)


def distance(a, b):
    """Angle of a⁻¹ b."""
    return float((a.inverse() @ b).angle)


@given(ROTATIONS, ROTATIONS, ROTATIONS)
def test_composition_is_associative(a, b, c):
    assert distance((a @ b) @ c, a @ (b @ c)) < 1e-14


@given(ROTATIONS)
def test_the_identity_changes_nothing(a):
    assert distance(a @ Rotation3.identity(), a) == pytest.approx(0, abs=1e-15)
    assert distance(Rotation3.identity() @ a, a) == pytest.approx(0, abs=1e-15)


@given(ROTATIONS)
def test_a_rotation_times_its_inverse_is_the_identity(a):
    np.testing.assert_allclose((a @ a.inverse()).wxyz, [1, 0, 0, 0], rtol=0, atol=1e-15)


@given(ROTATIONS, ROTATIONS)
def test_inverse_of_a_product_is_the_reversed_product(a, b):
    assert distance((a @ b).inverse(), b.inverse() @ a.inverse()) < 1e-14


@given(ROTATIONS, ROTATIONS, VECTORS)
def test_a_product_acts_as_one_after_the_other(a, b, x):
    np.testing.assert_allclose((a @ b) @ x, a @ (b @ x), rtol=0, atol=1e-13)


@given(ROTATIONS, ROTATIONS)
def test_matrices_multiply_as_rotations_do_and_are_proper(a, b):
    np.testing.assert_allclose((a @ b).matrix, a.matrix @ b.matrix, rtol=0, atol=1e-14)
    np.testing.assert_allclose(a.matrix.T @ a.matrix, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(a.matrix) == pytest.approx(1, abs=1e-14)


@given(OMEGAS)
def test_matrix_and_quaternion_are_those_of_scipy(omega):
    theirs = ScipyRotation.from_rotvec(omega)
    ours = Rotation3.exp(omega)
    np.testing.assert_allclose(ours.matrix, theirs.as_matrix(), rtol=0, atol=2e-15)
    np.testing.assert_allclose(ours.wxyz, theirs.as_quat(scalar_first=True), rtol=0, atol=1e-15)


@given(OMEGAS)
def test_log_undoes_exp(omega):
    found = Rotation3.exp(omega).log()
    near_half_turn = np.linalg.norm(omega) > np.pi - 1e-6
    if near_half_turn and found @ omega < 0:
        found = found - 2 * np.pi * found / np.linalg.norm(found)  # at π both ends of the axis are right
    np.testing.assert_allclose(found, omega, rtol=1e-14, atol=1e-15)


@given(OMEGAS)
def test_tiny_rotations_keep_their_digits(omega):
    if 0 < np.linalg.norm(omega) < 1e-3:
        np.testing.assert_allclose(Rotation3.exp(omega).log(), omega, rtol=1e-14, atol=1e-300)


@given(ROTATIONS)
def test_exp_undoes_log(a):
    assert distance(Rotation3.exp(a.log()), a) < 1e-14


@given(ROTATIONS)
def test_the_angle_is_the_length_of_the_log(a):
    assert 0 <= a.angle <= np.pi
    np.testing.assert_allclose(a.angle, np.linalg.norm(a.log()), rtol=1e-14, atol=1e-300)


@given(ROTATIONS)
def test_from_matrix_undoes_matrix(a):
    assert distance(Rotation3.from_matrix(a.matrix), a) < 3e-15


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_from_matrix_finds_half_turns_about_the_axes(axis):
    half_turn = np.diag(np.where(np.arange(3) == axis, 1.0, -1.0))
    expected = np.zeros(4)
    expected[axis + 1] = 1
    np.testing.assert_array_equal(np.abs(Rotation3.from_matrix(half_turn).wxyz), expected)


@given(ROTATIONS)
def test_a_quaternion_and_its_negative_are_one_rotation(a):
    b = Rotation3(-a.wxyz)
    np.testing.assert_array_equal(b.matrix, a.matrix)
    np.testing.assert_array_equal(b.angle, a.angle)
    if a.angle < np.pi - 1e-12:
        np.testing.assert_allclose(b.log(), a.log(), rtol=0, atol=1e-15)


@given(ROTATIONS)
def test_building_from_a_unit_quaternion_keeps_every_bit(a):
    np.testing.assert_array_equal(Rotation3(a.wxyz).wxyz, a.wxyz)


@given(ROTATIONS, OMEGAS)
def test_the_adjoint_carries_a_tangent_across(a, omega):
    assert distance(a @ Rotation3.exp(omega), Rotation3.exp(a.adjoint() @ omega) @ a) < 2e-14


@given(OMEGAS)
def test_the_left_jacobian_is_the_numeric_derivative(omega):
    step = 1e-6
    columns = [
        ((Rotation3.exp(omega + d) @ Rotation3.exp(omega).inverse()).log()
         - (Rotation3.exp(omega - d) @ Rotation3.exp(omega).inverse()).log()) / (2 * step)
        for d in step * np.eye(3)
    ]  # fmt: skip
    np.testing.assert_allclose(left_jacobian(omega), np.stack(columns, 1), rtol=0, atol=2e-9)


@pytest.mark.parametrize("direction", np.eye(3))
def test_the_left_jacobian_does_not_jump_where_the_series_ends(direction):
    """Either side is compared with the series, to the order that counts there."""
    for angle in (1e-4 * (1 - 1e-9), 1e-4 * (1 + 1e-9), 3e-4):
        k = skew(angle * direction)
        expected = np.eye(3) + (1 / 2 - angle**2 / 24) * k + (1 / 6 - angle**2 / 120) * (k @ k)
        np.testing.assert_allclose(left_jacobian(angle * direction), expected, rtol=0, atol=5e-16)


@given(VECTORS, VECTORS)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), rtol=0, atol=1e-13)


def test_batch_axes_equal_a_loop(rng):
    omegas, others, points = rng.normal(size=(3, 2, 5, 3))
    batch, other = Rotation3.exp(omegas), Rotation3.exp(others)
    assert batch.shape == (2, 5)
    assert len(batch) == 2
    moved, product, jacobians = batch @ points, batch @ other, left_jacobian(omegas)
    for k in np.ndindex(2, 5):
        single = Rotation3.exp(omegas[k])
        assert single.shape == ()
        np.testing.assert_array_equal(batch[k].wxyz, single.wxyz)
        np.testing.assert_allclose(batch.log()[k], single.log(), rtol=1e-14)
        np.testing.assert_allclose(batch.matrix[k], single.matrix, rtol=1e-14)
        np.testing.assert_allclose(batch.angle[k], single.angle, rtol=1e-14)
        np.testing.assert_allclose(moved[k], single @ points[k], rtol=1e-13)
        np.testing.assert_allclose(product.wxyz[k], (single @ other[k]).wxyz, rtol=1e-13)
        np.testing.assert_allclose(jacobians[k], left_jacobian(omegas[k]), rtol=1e-13)
        np.testing.assert_allclose(
            Rotation3.from_matrix(batch.matrix).wxyz[k], Rotation3.from_matrix(single.matrix).wxyz
        )


def test_one_rotation_moves_many_points_and_many_rotations_one(rng):
    rotations, points = Rotation3.exp(rng.normal(size=(4, 3))), rng.normal(size=(7, 3))
    every = rotations[:, None] @ points[None]
    assert every.shape == (4, 7, 3)
    for i in range(4):
        np.testing.assert_allclose(every[i], rotations[i] @ points, rtol=1e-12, atol=1e-14)


def test_indexing_selects_by_number_slice_list_mask_and_new_axis(rng):
    batch = Rotation3.exp(rng.normal(size=(4, 3)))
    np.testing.assert_array_equal(batch[-1].wxyz, batch.wxyz[-1])
    np.testing.assert_array_equal(batch[1:3].wxyz, batch.wxyz[1:3])
    np.testing.assert_array_equal(batch[[3, 0]].wxyz, batch.wxyz[[3, 0]])
    np.testing.assert_array_equal(batch[batch.wxyz[:, 1] > 0].wxyz, batch.wxyz[batch.wxyz[:, 1] > 0])
    assert batch[:, None].shape == (4, 1)
    assert [r.shape for r in batch] == [()] * 4
    with pytest.raises(IndexError):
        batch[4]
    with pytest.raises(IndexError):
        batch[0, 0]


def test_an_empty_batch_is_a_batch():
    none = Rotation3.identity((0,))
    assert len(none) == 0
    assert (none @ none).shape == (0,)
    assert none.log().shape == (0, 3)
    assert Rotation3.from_matrix(np.zeros((0, 3, 3))).shape == (0,)


def test_a_single_rotation_has_no_length():
    with pytest.raises(TypeError, match="no length"):
        len(Rotation3.identity())


@pytest.mark.parametrize("wxyz", [np.zeros(4), np.array([np.nan, 0, 0, 1]), np.array([np.inf, 0, 0, 1]), np.ones(3)])
def test_what_is_no_quaternion_is_refused(wxyz):
    with pytest.raises(ValueError, match="quaternion"):
        Rotation3(wxyz)


def test_points_of_another_dimension_are_refused():
    with pytest.raises(ValueError, match="expected points"):
        Rotation3.identity() @ np.zeros((5, 2))
    with pytest.raises(TypeError):
        Rotation3.identity() @ "x"


def test_the_quaternion_is_read_only():
    with pytest.raises(ValueError, match="read-only"):
        Rotation3.identity().wxyz[0] = 2
