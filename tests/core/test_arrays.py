import copy
import dataclasses
import pickle
from typing import Any

import numpy as np
import pytest

from sfm.core.arrays import FloatArray, Value, readonly
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.similarity import Sim3

PROTOCOLS = range(2, pickle.HIGHEST_PROTOCOL + 1)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Pair(Value):
    points: FloatArray
    inner: Any

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", readonly(self.points, (None, 2)))


def test_a_fitting_array_is_shared_and_cannot_be_written():
    array = np.arange(6.0).reshape(3, 2)
    view = readonly(array, (3, 2))
    assert np.shares_memory(view, array)
    assert not view.flags.writeable
    assert array.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        view[0, 0] = 1


@pytest.mark.parametrize(
    "array", [np.arange(6, dtype=np.int32).reshape(3, 2), np.asfortranarray(np.ones((3, 2))), [[1, 2]]]
)
def test_another_type_or_layout_is_converted(array):
    view = readonly(array, (None, 2))
    assert view.dtype == np.float64
    assert view.flags.c_contiguous
    np.testing.assert_array_equal(view, array)


@pytest.mark.parametrize(
    ("actual", "expected"),
    [
        ((3, 2), (3, 2)),
        ((3, 2), (None, 2)),
        ((0, 2), (None, 2)),
        ((), ()),
        ((3,), (..., 3)),
        ((5, 4, 3), (..., 3)),
        ((0, 3), (..., 3)),
        ((2, 3, 3), (..., 3, 3)),
    ],
)
def test_shapes_that_fit_are_kept(actual, expected):
    assert readonly(np.zeros(actual), expected).shape == actual


@pytest.mark.parametrize(
    ("actual", "expected"),
    [
        ((3, 2), (2, 3)),
        ((3,), (None, 2)),
        ((3, 2, 1), (None, 2)),
        ((), (1,)),
        ((1,), ()),
        ((), (..., 3)),
        ((4,), (..., 3)),
        ((3,), (..., 3, 3)),
    ],
)
def test_shapes_that_do_not_fit_are_refused_with_both(actual, expected):
    with pytest.raises(ValueError, match="expected an array of shape") as error:
        readonly(np.zeros(actual), expected)
    assert str(expected) in str(error.value)
    assert str(actual) in str(error.value)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_arrays_stay_read_only_through_every_pickle_protocol(protocol):
    value = Pair(np.arange(4.0).reshape(2, 2), Rigid3.exp(np.arange(6.0)))
    again = pickle.loads(pickle.dumps(value, protocol))
    assert type(again) is Pair
    np.testing.assert_array_equal(again.points, value.points)
    np.testing.assert_array_equal(again.inner.matrix, value.inner.matrix)
    assert not again.points.flags.writeable
    assert not again.inner.translation.flags.writeable
    assert not again.inner.rotation.wxyz.flags.writeable


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_motions_keep_every_bit_through_pickling(protocol, rng):
    for value in (Rigid3.exp(rng.normal(size=(20, 6))), Sim3.exp(rng.normal(size=7))):
        again = pickle.loads(pickle.dumps(value, protocol))
        assert again.shape == value.shape
        np.testing.assert_array_equal(again.matrix, value.matrix)


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy])
def test_copies_are_read_only(copied):
    assert not copied(Pair(np.zeros((1, 2)), None)).points.flags.writeable


def test_values_are_compared_by_identity_and_can_be_keys():
    one, other = Pair(np.zeros((1, 2)), None), Pair(np.zeros((1, 2)), None)
    assert one != other
    assert [one] == [one]
    assert len({one, other}) == 2


def test_values_change_by_replacement_only():
    value = Pair(np.zeros((1, 2)), None)
    with pytest.raises(dataclasses.FrozenInstanceError):
        value.points = np.ones((1, 2))  # pyright: ignore[reportAttributeAccessIssue]
    changed = dataclasses.replace(value, points=np.ones((3, 2)))
    assert changed.points.sum() == 6
    assert value.points.sum() == 0
    with pytest.raises(ValueError, match="expected an array"):
        dataclasses.replace(value, points=np.ones(3))
