from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from datasets.synthetic import CLEAN, SensorConfig, expose
from datasets.synthetic.sensor import encode, gamma

GREY = np.full((200, 300, 3), 0.3, np.float32)


def linear(photo: np.ndarray) -> np.ndarray:
    """The inverse of sRGB."""
    value = photo / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def test_a_clean_sensor_applies_nothing_but_gamma(rng):
    radiance = rng.uniform(0, 1, (20, 30, 3)).astype(np.float32)
    photo = expose(radiance, CLEAN, rng)
    np.testing.assert_array_equal(photo, np.rint(255 * gamma(radiance)).astype(np.uint8))
    np.testing.assert_allclose(linear(photo), radiance, atol=0.006)


def test_noise_has_the_standard_deviation_that_was_asked_for(rng):
    photo = expose(GREY, dataclasses.replace(CLEAN, noise=0.03), rng)
    assert linear(photo).std() == pytest.approx(0.03 * np.sqrt(0.31), rel=0.05)
    assert linear(photo).mean() == pytest.approx(0.3, rel=0.01)


def test_corners_are_darker_by_the_vignetting(rng):
    signal = linear(expose(GREY, dataclasses.replace(CLEAN, vignetting=0.4), rng))
    assert signal[0, 0, 0] == pytest.approx(0.6 * 0.3, rel=0.03)
    assert signal[100, 150, 0] == pytest.approx(0.3, rel=0.02)


def test_a_stop_of_exposure_doubles_the_light(rng):
    signal = linear(expose(GREY, dataclasses.replace(CLEAN, exposure_ev=1.0), rng))
    assert signal.mean() == pytest.approx(0.6, rel=0.01)
    jittered = [linear(expose(GREY, dataclasses.replace(CLEAN, exposure_jitter_ev=0.2), rng)).mean() for _ in range(60)]
    assert np.std(np.log2(np.array(jittered) / 0.3)) == pytest.approx(0.2, rel=0.35)


def test_blur_spreads_a_point_by_its_standard_deviation(rng):
    point = np.zeros((41, 41, 3), np.float32)
    point[20, 20] = 20.0
    signal = linear(expose(point, dataclasses.replace(CLEAN, blur_px=2.0), rng))[..., 0]
    x = np.arange(41) - 20
    assert np.sqrt((signal.sum(0) * x**2).sum() / signal.sum()) == pytest.approx(2.0, rel=0.1)


def test_overexposure_is_white(rng):
    assert np.all(expose(10 * GREY, CLEAN, rng) == 255)


def test_the_same_seed_takes_the_same_photo():
    config = SensorConfig()
    photos = [expose(GREY, config, np.random.default_rng(seed)) for seed in (4, 4, 5)]
    np.testing.assert_array_equal(photos[0], photos[1])
    assert not np.array_equal(photos[0], photos[2])
    assert encode(photos[0], config) == encode(photos[1], config)


def test_files_hold_the_photo(rng):
    photo = rng.integers(0, 256, (30, 40, 3), np.uint8)
    png = cv2.imdecode(np.frombuffer(encode(photo, CLEAN), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(png[..., ::-1], photo)
    smooth = cv2.GaussianBlur(photo, (0, 0), 5)
    jpeg = cv2.imdecode(np.frombuffer(encode(smooth, SensorConfig(jpeg_quality=95)), np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(jpeg[..., ::-1].astype(float) - smooth).mean() < 3


@pytest.mark.parametrize("change", [{"noise": -1.0}, {"vignetting": 1.0}, {"jpeg_quality": 0}, {"blur_px": -0.1}])
def test_impossible_sensors_are_refused(change):
    with pytest.raises(ValueError, match="must"):
        SensorConfig(**change)
