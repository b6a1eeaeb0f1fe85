import numpy as np
import pytest

from sfm.mapping.noise import learn_sigmas


def _errors(sigmas, rng):
    return np.linalg.norm(rng.normal(0, 1, (len(sigmas), 2)) * sigmas[:, None], axis=1)


def test_the_noise_of_each_scale_is_recovered():
    rng = np.random.default_rng(0)
    scales = np.exp(rng.uniform(0, np.log(8), 20_000))
    true = np.hypot(0.15, 0.1 * scales)
    # Of 2 v residuals of a point, 3 are spent on the point.
    views = rng.integers(2, 9, len(scales)).astype(float)
    found = learn_sigmas(_errors(true * np.sqrt((2 * views - 3) / (2 * views)), rng), scales, views)
    assert np.median(np.abs(found / true - 1)) < 0.06
    assert np.abs(found / true - 1).max() < 0.25  # a group has one σ


def test_outliers_and_unknown_errors_do_not_count():
    rng = np.random.default_rng(1)
    errors = _errors(np.full(5000, 0.3), rng)
    errors[::10], errors[5::50] = 50.0, np.nan
    found = learn_sigmas(errors, rng.uniform(1, 9, 5000), np.full(5000, 1e6))
    assert found.min() > 0.27
    assert found.max() < 0.39


@pytest.mark.parametrize(("count", "scales"), [(5000, 0.0), (500, None)])
def test_alike_scales_and_few_observations_make_one_group(count, scales):
    rng = np.random.default_rng(2)
    given = rng.uniform(1, 9, count) if scales is None else np.full(count, scales)
    assert len(np.unique(learn_sigmas(_errors(np.full(count, 0.3), rng), given, np.full(count, 5.0)))) == 1


@pytest.mark.parametrize("errors", [np.zeros(900), np.full(900, np.nan), np.zeros(0)])
def test_residuals_that_vanish_or_are_unknown_leave_positive_sigmas(errors):
    found = learn_sigmas(errors, np.linspace(1, 2, len(errors)), np.full(len(errors), 2.0))
    assert found.shape == errors.shape
    assert np.all(found == 0.01)


def test_the_order_of_observations_does_not_matter():
    rng = np.random.default_rng(3)
    errors, scales, views = rng.uniform(0, 1, 2000), rng.uniform(1, 9, 2000), rng.integers(2, 9, 2000).astype(float)
    order = rng.permutation(2000)
    expected = learn_sigmas(errors, scales, views)[order]
    np.testing.assert_array_equal(learn_sigmas(errors[order], scales[order], views[order]), expected)
