from __future__ import annotations

import numpy as np
import pytest

from sfm.core.imaging.noise import noise_sigma, specks_share, without_noise, without_specks
from sfm.core.imaging.tone import equalized_locally, stretched, tone, with_gamma

SLOPE = np.repeat(np.arange(256, dtype=np.uint8)[None], 256, axis=0)


def test_tone_of_a_slope_is_read_off_it():
    measured = tone(SLOPE)
    assert (measured.low, measured.high) == (0.0, 1.0)
    assert measured.median == pytest.approx((9 + 255) / 2 / 255, abs=0.01)  # black is left out
    assert tone(np.zeros((9, 9), np.uint8)).median == 0


def test_gamma_is_a_power_of_the_grey_value():
    np.testing.assert_allclose(with_gamma(SLOPE, 0.5)[0] / 255, np.sqrt(np.arange(256) / 255), atol=0.5 / 255)
    np.testing.assert_array_equal(with_gamma(SLOPE, 1.0), SLOPE)
    with pytest.raises(ValueError, match="gamma"):
        with_gamma(SLOPE, 0.0)


def test_stretching_takes_the_ends_to_black_and_white():
    result = stretched(SLOPE, 51 / 255, 204 / 255)[0]
    assert (result[51], result[204]) == (0, 255)
    assert result[128] == pytest.approx(255 * 77 / 153, abs=1)
    assert (np.diff(result.astype(int)) >= 0).all()
    with pytest.raises(ValueError, match="above low"):
        stretched(SLOPE, 0.5, 0.5)


def test_local_equalisation_raises_contrast_where_it_is_low():
    rng = np.random.default_rng(1)
    flat = np.clip(rng.normal(100, 4, (128, 128)), 0, 255).astype(np.uint8)
    assert equalized_locally(flat, 4.0).std() > 2 * flat.std()
    assert equalized_locally(flat, 4.0).std() > equalized_locally(flat, 2.0).std()


@pytest.mark.parametrize("sigma", [0.01, 0.03, 0.08])
def test_noise_on_a_slope_is_measured(sigma):
    rng = np.random.default_rng(2)
    values = np.linspace(0.3, 0.7, 256)[None] + rng.normal(0, sigma, (256, 256))
    assert noise_sigma(np.clip(np.rint(255 * values), 0, 255).astype(np.uint8)) == pytest.approx(sigma, rel=0.12)


def test_no_noise_where_there_is_none_or_nothing_can_be_said():
    assert noise_sigma(SLOPE) == 0
    assert noise_sigma(np.full((64, 64), 255, np.uint8)) == 0
    assert noise_sigma(np.zeros((8, 200), np.uint8)) == 0


def test_filters_take_away_what_they_are_for_and_keep_edges():
    rng = np.random.default_rng(3)
    clean = np.where(np.arange(128) < 64, 60, 190)[None].repeat(128, axis=0)
    noisy = np.clip(np.rint(clean + rng.normal(0, 8, clean.shape)), 0, 255).astype(np.uint8)
    filtered = without_noise(noisy, 8 / 255)
    assert (
        np.abs(filtered - clean.astype(float))[:, :60].mean() < 0.6 * np.abs(noisy - clean.astype(float))[:, :60].mean()
    )
    assert filtered[:, 64].mean() - filtered[:, 63].mean() > 110
    speckled = clean.astype(np.uint8)
    hit = rng.random(clean.shape) < 0.02
    speckled[hit] = 255
    assert specks_share(speckled) == pytest.approx(0.02, abs=0.01)
    assert specks_share(clean.astype(np.uint8)) == 0
    assert (without_specks(speckled) != clean).mean() < 0.005
