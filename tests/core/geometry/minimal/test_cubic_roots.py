from __future__ import annotations

import numpy as np
import pytest

from sfm.core.geometry.minimal._cubic_kernels import cubic_roots


def _roots(coefficients):
    out = np.full(10, np.nan)
    return np.sort(out[: cubic_roots(np.asarray(coefficients, dtype=np.float64), out)])


def test_real_roots_of_cubics_are_those_of_the_companion_matrix():
    rng = np.random.default_rng(0)
    for _ in range(2000):
        coefficients = rng.normal(size=4) * 10.0 ** rng.uniform(-2, 2, 4)
        expected = np.roots(coefficients[::-1])
        expected = np.sort(expected[np.abs(expected.imag) < 1e-9 * np.abs(expected)].real)
        np.testing.assert_allclose(_roots(coefficients), expected, rtol=1e-7)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_three_real_roots_of_any_scale_are_found(scale):
    rng = np.random.default_rng(1)
    for _ in range(300):
        expected = np.sort(rng.uniform(-1, 1, 3) * 10)
        if np.diff(expected).min() < 1e-3:
            continue
        coefficients = np.poly(expected)[::-1] * scale
        np.testing.assert_allclose(_roots(coefficients), expected, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("lead", [0.0, 1e-18, 1e-4, -2e-3])
def test_roots_are_found_however_small_the_leading_coefficient_is(lead):
    # (x − 1)(x + 2) and a far root, if any.
    near = _roots([-2.0, 1.0, 1.0, lead])
    small = near[np.abs(near) < 100]
    np.testing.assert_allclose(small, [-2.0, 1.0], atol=abs(5 * lead))
    values = lead * small**3 + small**2 + small - 2
    assert np.abs(values).max() < 1e-11


def test_multiple_roots_and_degenerate_cubics_are_harmless():
    np.testing.assert_allclose(_roots([0.0, 0, 0, 2.0]), 0)
    np.testing.assert_allclose(_roots([-1.0, 3, -3, 1]), 1, atol=1e-4)
    assert all(np.abs(root - 1) < 1e-6 or np.abs(root + 2) < 1e-9 for root in _roots([2.0, -3, 0, 1]))
    assert len(_roots([0.0, 0, 0, 0])) == 0
    assert len(_roots([np.nan, 1, 1, 1])) == 0
    assert len(_roots([np.inf, 1, 1, 1])) == 0
