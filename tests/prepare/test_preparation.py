from __future__ import annotations

import numpy as np
import pytest

from sfm.core.errors import ConfigError
from sfm.core.imaging.noise import noise_sigma
from sfm.core.imaging.tone import tone
from sfm.prepare import PrepareConfig, prepare
from tests.features.rendering import texture

AUTO = PrepareConfig(mode="auto")


def photo(seed: int = 1) -> np.ndarray:
    """Detail at several scales, all grey values equally often, and a little noise, as photos have."""
    values = texture(seed, (240, 320)).astype(float) + np.random.default_rng(seed).normal(0, 0.6, (240, 320))
    ranks = np.argsort(np.argsort(values.ravel()))
    return (ranks * 256 // values.size).reshape(values.shape).astype(np.uint8)


def grey_levels(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(255 * values), 0, 255).astype(np.uint8)


def test_a_good_photo_stays_as_it_is():
    image = photo()
    result = prepare(image, AUTO)
    assert result.steps == ()
    assert result.image is image
    assert prepare(image).steps == ()


def test_a_dark_photo_is_lifted_by_gamma():
    dark = grey_levels((photo() / 255) ** 5)
    result = prepare(dark, AUTO)
    assert result.steps == ("gamma",)
    assert np.median(result.image) > 3 * np.median(dark)


def test_a_flat_photo_is_stretched_to_the_whole_range():
    result = prepare(grey_levels(0.5 + 0.1 * photo() / 255), AUTO)
    assert result.steps == ("stretch",)
    assert tone(result.image).range > 0.95


def test_a_photo_three_stops_too_dark_is_stretched():
    result = prepare((photo() / 4).astype(np.uint8), AUTO)
    assert result.steps[0] == "stretch"
    assert tone(result.image).range > 0.95


def test_a_noisy_photo_is_filtered_and_a_speckled_one_too():
    rng = np.random.default_rng(2)
    noisy = grey_levels(photo() / 255 * 0.9 + 0.05 + rng.normal(0, 0.06, (240, 320)))
    result = prepare(noisy, AUTO)
    assert result.steps == ("bilateral",)
    assert noise_sigma(result.image) < 0.5 * noise_sigma(noisy)
    chance = rng.random((240, 320))
    speckled = np.where(chance < 0.01, 0, np.where(chance > 0.99, 255, photo())).astype(np.uint8)
    assert prepare(speckled, AUTO).steps == ("median",)


def test_a_thing_before_a_black_background_is_not_a_dark_photo():
    image = photo()
    image[:, :200] = 2
    assert prepare(image, AUTO).steps == ()


def test_noise_in_the_dark_is_not_lifted():
    rng = np.random.default_rng(3)
    dark = grey_levels((photo() / 255) ** 5 * 0.5 + rng.normal(0, 0.018, (240, 320)))
    assert "gamma" not in prepare(dark, AUTO).steps


@pytest.mark.parametrize("mode", ["clahe", "gamma", "stretch", "bilateral", "median"])
def test_every_mode_does_what_it_is_called_on_every_image(mode):
    config = PrepareConfig(mode=mode)
    for image in (photo(), np.zeros((40, 50), np.uint8), np.full((16, 16), 200, np.uint8)):
        result = prepare(image, config)
        assert result.steps == (mode,)
        assert result.image.shape == image.shape
        assert result.image.dtype == np.uint8
    assert prepare(np.zeros((40, 50), np.uint8), AUTO).steps == ()


def test_the_summary_tells_what_was_measured():
    assert prepare(np.full((64, 64), 102, np.uint8), AUTO).summary() == (
        "grey values 0.40 to 0.40, median 0.40, noise 0.000, specks 0.0%"
    )


@pytest.mark.parametrize("options", [{"clahe_clip": 0.0}, {"target_median": 1.0}, {"noise_above": -1.0}])
def test_settings_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match="must"):
        PrepareConfig(**options)
