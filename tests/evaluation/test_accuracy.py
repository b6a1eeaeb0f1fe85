from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm.evaluation.accuracy import area_under_recall, mean_average_accuracy


def slow_area(errors: list[float], limit: float, steps: int = 200_000) -> float:
    """The mean of the recall polygon on [0, limit], sampled."""
    finite = sorted(e for e in errors if e <= limit)
    knots = np.array([0.0, *finite])
    values = np.arange(len(knots)) / len(errors)
    at = (np.arange(steps) + 0.5) * limit / steps
    return float(np.interp(at, knots, values).mean())


def test_area_of_evenly_spread_errors_by_hand() -> None:
    # Polygon from (0, 0) to (0.5, 1): at 0.25 the last knot inside is (0.2, 0.4), then level: 0.04 + 0.02 of 0.25.
    # At 0.5 a triangle, half. At 1 the triangle and a full half: 3/4.
    errors = np.array([0.3, 0.1, 0.5, 0.2, 0.4])
    np.testing.assert_allclose(area_under_recall(errors, [0.25, 0.5, 1.0]), [0.24, 0.5, 0.75], atol=1e-12)


def test_area_of_one_error_by_hand() -> None:
    # Beyond its threshold it adds nothing; at 1 a triangle of base 0.5 and a full half.
    np.testing.assert_allclose(area_under_recall(np.array([0.5]), [0.3, 1.0]), [0.0, 0.75], atol=1e-12)


def test_perfect_poses_score_one_and_failures_zero() -> None:
    assert area_under_recall(np.zeros(7), [1.0])[0] == 1
    assert area_under_recall(np.full(7, np.inf), [1.0])[0] == 0


def test_failures_scale_the_area_by_the_share_of_the_rest() -> None:
    errors = np.array([0.1, 0.2, 0.4])
    alone = area_under_recall(errors, [1.0])[0]
    with_failures = area_under_recall(np.r_[errors, [np.inf] * 3], [1.0])[0]
    np.testing.assert_allclose(with_failures, alone / 2, atol=1e-12)


def test_an_error_equal_to_the_threshold_is_inside() -> None:
    np.testing.assert_allclose(area_under_recall(np.array([1.0, 1.0]), [1.0])[0], 0.5 * 0.5 * 1, atol=1e-12)


def test_floor_makes_small_errors_perfect_at_once() -> None:
    errors = np.array([0.01, 0.02, 0.5])
    # r = 2/3 on [0, 0.02], then a line to (0.5, 1), then level.
    by_hand = 2 / 3 * 0.02 + (0.5 - 0.02) * (2 / 3 + 1) / 2 + 0.5
    np.testing.assert_allclose(area_under_recall(errors, [1.0], min_error=0.02)[0], by_hand, atol=1e-12)


@given(st.lists(st.floats(0, 3), min_size=1, max_size=12, unique=True), st.floats(0.1, 4))
def test_area_equals_the_sampled_polygon(errors: list[float], limit: float) -> None:
    area = area_under_recall(np.array(errors), [limit])[0]
    assert abs(area - slow_area(errors, limit)) < 1e-3
    assert 0 <= area <= 1


@given(st.lists(st.floats(0, 3), min_size=1, max_size=12), st.floats(0, 1))
def test_larger_errors_never_score_better(errors: list[float], growth: float) -> None:
    # Growing past the threshold may only lose area; within it, too.
    smaller = area_under_recall(np.array(errors), [1.0, 2.0])
    larger = area_under_recall(np.array(errors) + growth, [1.0, 2.0])
    assert np.all(larger <= smaller + 1e-12)


def test_no_errors_give_nan_and_bad_input_raises() -> None:
    assert np.isnan(area_under_recall(np.zeros(0), [1.0])[0])
    with pytest.raises(ValueError, match="positive"):
        area_under_recall(np.ones(2), [0.0])
    with pytest.raises(ValueError, match="negative"):
        area_under_recall(np.array([-1.0]), [1.0])
    with pytest.raises(ValueError, match="NaN"):
        area_under_recall(np.array([np.nan]), [1.0])


def test_mean_average_accuracy_counts_whole_degrees() -> None:
    # 0.5 is inside all ten limits, 3.2 inside 4…10, 12 in none: (10 + 7) / 30.
    np.testing.assert_allclose(mean_average_accuracy(np.array([0.5, 3.2, 12.0])), 17 / 30)
    assert np.isnan(mean_average_accuracy(np.zeros(0)))
