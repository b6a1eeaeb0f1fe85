"""Kernels of the detection against plain twins."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.special import erf

from calib import _detect_kernels as kernels

SHAPE = np.array([10.3, 9.6, 0.2, 1.9, 0.8, 120.0, 60.0, 0.5, -0.3, 0.01, -0.02])


def intensity(p, x, y):
    """The model as its docstring has it."""
    dx, dy = x - p[0], y - p[1]
    product = 1.0
    for angle, bend in ((p[2], p[9]), (p[3], p[10])):
        across = np.cos(angle) * dx + np.sin(angle) * dy
        along = -np.sin(angle) * dx + np.cos(angle) * dy
        product = product * erf((across + bend / 2 * (along**2 + p[4] ** 2)) / (np.sqrt(2) * p[4]))
    return p[5] + p[7] * dx + p[8] * dy + p[6] * product


def normals(p):
    return np.cos(p[2]), np.sin(p[2]), np.cos(p[3]), np.sin(p[3])


def test_the_model_and_its_derivatives_are_those_of_the_twin(rng):
    for x, y in rng.uniform(6, 14, (20, 2)):
        jacobian = np.empty(kernels.PARAMETERS)
        value = kernels.crossing_model(SHAPE, *normals(SHAPE), x - SHAPE[0], y - SHAPE[1], jacobian)
        assert value == pytest.approx(intensity(SHAPE, x, y), abs=1e-10)
        for k in range(kernels.PARAMETERS):
            step = np.zeros(kernels.PARAMETERS)
            step[k] = 1e-6
            slope = (intensity(SHAPE + step, x, y) - intensity(SHAPE - step, x, y)) / 2e-6
            assert jacobian[k] == pytest.approx(slope, rel=1e-5, abs=1e-4)


NOTHING = np.zeros(4)


def fitted(photo, windows, starts, values=NOTHING, weights=NOTHING):
    """Parameters, covariances and root mean squares of the residuals."""
    count = len(starts)
    shapes, covariances, residuals = np.empty((count, 11)), np.empty((count, 2, 2)), np.empty(count)
    all_values, all_weights = (np.broadcast_to(part, (count, 4)).copy() for part in (values, weights))
    kernels.fit_crossings(photo, windows, 400, all_values, all_weights, starts, shapes, covariances, residuals)
    return shapes, covariances, residuals


def started(x, y, angle1=0.1, angle2=1.8):
    return np.array([[x, y, angle1, angle2, 0, 0, 0, 0, 0, 0, 0]], float)


@pytest.mark.parametrize("weights", [[0.0, 0, 0, 0], [40.0, 40, 1e6, 1e6]])
def test_a_fit_and_its_covariance_are_those_of_the_twin(rng, weights):
    y, x = np.mgrid[:20, :20] + 0.5
    photo = np.clip(np.rint(intensity(SHAPE, x, y) + rng.normal(0, 2, x.shape)), 0, 255).astype(np.uint8)
    radius, expected, weights = 7.0, SHAPE[7:] + [0.1, 0.1, 0.003, -0.003], np.array(weights)
    shapes, covariances, residuals = fitted(photo, np.eye(2)[None] / radius, started(11, 9), expected, weights)
    found = shapes[:, :2]

    def twin_residuals(p, inside):
        return np.append((intensity(p, x, y) - photo)[inside], np.sqrt(weights) * (p[7:] - expected))

    # The window is that of the last start, so that the twin takes the pixels around both and must agree with one.
    agree = []
    for centre in ([11.0, 9.0], found[0]):
        inside = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 <= radius**2
        twin = least_squares(twin_residuals, SHAPE, x_scale="jac", xtol=1e-12, args=(inside,))
        square, inverse = np.sum(twin.fun[:-4] ** 2), np.linalg.inv(twin.jac.T @ twin.jac)
        covariance = square / (inside.sum() - 11 + np.diag(inverse)[7:] @ weights) * inverse[:2, :2]
        agree.append(
            np.abs(twin.x[:2] - found[0]).max() < 0.02 and np.allclose(covariance, covariances[0], rtol=0.15, atol=1e-5)
        )
    assert any(agree)
    assert np.abs(found[0] - SHAPE[:2]).max() < 0.1
    assert shapes[0, 4] == pytest.approx(0.8, abs=0.1)
    assert residuals[0] == pytest.approx(2.0, abs=0.3)


def test_pixels_that_are_cut_off_or_flat_give_no_corner():
    photo = np.full((20, 20), 90, np.uint8)
    windows = np.broadcast_to(np.eye(2) / 6, (2, 2, 2)).copy()
    starts = np.concatenate([started(1, 1, 0, 1.6), started(30, 5, 0, 1.6)])
    shapes, covariances, residuals = fitted(photo, windows, starts)
    assert np.isnan(shapes).all()
    assert np.isnan(covariances).all()
    assert np.isnan(residuals).all()


def test_what_is_expected_of_a_small_window_makes_its_corner_twice_as_certain(rng):
    """And the errors are as small as the covariances say."""
    y, x = np.mgrid[:20, :20] + 0.5
    clean, windows, errors, variances = intensity(SHAPE, x, y), np.eye(2)[None] / 4.0, [], []
    for _ in range(200):
        photo = np.clip(np.rint(clean + rng.normal(0, 3, x.shape)), 0, 255).astype(np.uint8)
        start = started(10.3 + rng.normal(0, 0.1), 9.6 + rng.normal(0, 0.1), 0.2, 1.9)
        alone, known = fitted(photo, windows, start), fitted(photo, windows, start, SHAPE[7:], np.full(4, 1e6))
        errors.append([one[0][0, :2] - SHAPE[:2] for one in (alone, known)])
        variances.append([np.trace(one[1][0]) / 2 for one in (alone, known)])
    rms, predicted = np.sqrt(np.mean(np.square(errors), axis=(0, 2))), np.sqrt(np.mean(variances, axis=0))
    assert rms[1] < 0.6 * rms[0]
    np.testing.assert_allclose(predicted, rms, rtol=0.12)


def test_the_blur_of_a_bent_edge_moves_no_corner():
    """The image is blurred by sums over a fine grid, not by the model."""
    fine, curvature, blur = 16, 0.02, 1.5
    y, x = (np.mgrid[: 24 * fine, : 24 * fine] + 0.5) / fine - 12.1
    sharp = np.sign(x + curvature / 2 * y**2) * np.sign(y + curvature / 2 * x**2)
    image = gaussian_filter(120 + 60 * sharp, blur * fine).reshape(24, fine, 24, fine).mean(axis=(1, 3))
    photo = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    expected, weights = np.array([0, 0, curvature, curvature]), np.full(4, 1e8)
    shapes, _, _ = fitted(photo, np.eye(2)[None] / 8.0, started(12, 12, 0, np.pi / 2), expected, weights)
    # Without the term in s² it would be off by ½ κ s² = 0.022 px in x and in y.
    assert np.abs(shapes[0, :2] - 12.1).max() < 0.005
