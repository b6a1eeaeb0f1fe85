"""Kernels of the detection against plain twins."""

from __future__ import annotations

import numpy as np
import pytest
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
        product = product * erf((across + bend / 2 * along**2) / (np.sqrt(2) * p[4]))
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


def test_a_fit_and_its_covariance_are_those_of_the_twin(rng):
    y, x = np.mgrid[:20, :20] + 0.5
    photo = np.clip(np.rint(intensity(SHAPE, x, y) + rng.normal(0, 2, x.shape)), 0, 255).astype(np.uint8)
    start, radius = np.array([[11.0, 9.0]]), 7.0
    found, covariances, measures = np.empty((1, 2)), np.empty((1, 2, 2)), np.empty((1, 4))
    window = np.eye(2)[None] / radius
    kernels.fit_crossings(photo, start, window, np.array([[0.1, 1.8]]), 400, found, covariances, measures)
    # The window is that of the last start, so that the twin takes the pixels around both and must agree with one.
    agree = []
    for centre in (start[0], found[0]):
        inside = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 <= radius**2
        twin = least_squares(lambda p, i=inside: (intensity(p, x, y) - photo)[i], SHAPE, x_scale="jac", xtol=1e-12)
        variance = 2 * twin.cost / (inside.sum() - kernels.PARAMETERS)
        covariance = variance * np.linalg.inv(twin.jac.T @ twin.jac)[:2, :2]
        agree.append(
            np.abs(twin.x[:2] - found[0]).max() < 0.02 and np.allclose(covariance, covariances[0], rtol=0.15, atol=1e-5)
        )
    assert any(agree)
    assert np.abs(found[0] - SHAPE[:2]).max() < 0.1
    assert measures[0, 0] == pytest.approx(0.8, abs=0.1)


def test_pixels_that_are_cut_off_or_flat_give_no_corner():
    photo = np.full((20, 20), 90, np.uint8)
    where = np.array([[1.0, 1.0], [30.0, 5.0]])
    found, covariances, measures = np.empty((2, 2)), np.empty((2, 2, 2)), np.empty((2, 4))
    windows = np.broadcast_to(np.eye(2) / 6, (2, 2, 2)).copy()
    angles = np.broadcast_to([0.0, 1.6], (2, 2)).copy()
    kernels.fit_crossings(photo, where, windows, angles, 400, found, covariances, measures)
    assert np.isnan(found).all()
    assert np.isnan(covariances).all()
