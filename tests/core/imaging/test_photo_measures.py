"""Sharpness, exposure and fingerprints of pictures whose blur, light and copies are known."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from sfm.core.imaging.exposure import exposure_of
from sfm.core.imaging.fingerprint import NEAR, fingerprint, near_pairs
from sfm.core.imaging.sharpness import sharpness
from tests.pictures import texture

PHOTO = cv2.cvtColor(texture(1, (768, 1024)), cv2.COLOR_RGB2GRAY)


def shaken(image: np.ndarray, length: int, kind: str) -> np.ndarray:
    kernels = {"right": np.ones((1, length)), "down": np.ones((length, 1)), "diagonal": np.eye(length)}
    return cv2.filter2D(image, -1, kernels[kind] / length)


def test_a_wave_has_its_frequency():
    """sin(ω x) sin(ω y): along x and y differences give 2 (1 − cos ω) / sin ω, along a diagonal both terms mix."""
    omega = 0.4
    wave = np.sin(omega * np.arange(640))
    image = np.rint(128 + 100 * np.outer(wave, wave)).astype(np.uint8)
    assert sharpness(image) == pytest.approx(2 * (1 - np.cos(omega)) / np.sin(omega), rel=0.02)


def test_blur_lowers_sharpness_step_by_step():
    values = [sharpness(PHOTO)] + [sharpness(cv2.GaussianBlur(PHOTO, (0, 0), sigma)) for sigma in (0.5, 1, 2, 4)]
    assert all(after < 0.97 * before for before, after in itertools.pairwise(values))
    assert 0.55 < values[2] / values[0] < 0.85
    assert values[3] / values[0] < 0.65


@pytest.mark.parametrize("kind", ["right", "down", "diagonal"])
def test_shake_in_any_one_direction_is_seen(kind):
    assert sharpness(shaken(PHOTO, 12, kind)) < 0.6 * sharpness(PHOTO)


def test_contrast_brightness_noise_and_turns_hardly_matter():
    plain, rng = sharpness(PHOTO), np.random.default_rng(0)
    assert sharpness((PHOTO * 0.4 + 20).astype(np.uint8)) == pytest.approx(plain, rel=0.03)
    noisy = np.clip(PHOTO + 4 * rng.normal(size=PHOTO.shape), 0, 255).astype(np.uint8)
    assert sharpness(noisy) == pytest.approx(plain, rel=0.1)
    for k in range(1, 4):
        assert sharpness(np.ascontiguousarray(np.rot90(PHOTO, k))) == pytest.approx(plain, rel=0.03)


def test_a_larger_photo_of_the_same_is_as_sharp():
    large = cv2.resize(PHOTO, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    assert sharpness(large) == pytest.approx(sharpness(PHOTO), rel=0.05)


def test_a_sharp_object_before_a_blurred_ground_is_sharp():
    blurred = cv2.GaussianBlur(PHOTO, (0, 0), 6)
    blurred[200:500, 300:700] = PHOTO[200:500, 300:700]
    assert sharpness(blurred) > 0.8 * sharpness(PHOTO)


@pytest.mark.parametrize("shape", [(16, 16), (24, 4000), (300, 400)])
def test_a_picture_without_edges_has_no_sharpness(shape):
    noise = np.random.default_rng(0).normal(128, 1, shape).astype(np.uint8)
    for image in (np.full(shape, 90, np.uint8), noise):
        assert np.isnan(sharpness(image))


def test_exposure_is_what_the_pixels_say():
    image = np.zeros((10, 10, 3), np.uint8)
    image[:4] = 255
    image[4:7] = (100, 100, 100)
    exposure = exposure_of(image)
    assert exposure.mean == pytest.approx((40 * 255 + 30 * 100) / 100 / 255)
    assert (exposure.black, exposure.white) == pytest.approx((0.3, 0.4))
    assert (exposure.low, exposure.high) == (0, 1)
    assert exposure_of(image[..., 0]) == exposure


def test_one_clipped_channel_is_clipped_white_and_one_lit_channel_is_not_black():
    red = np.zeros((4, 4, 3), np.uint8)
    red[..., 0] = 255
    assert (exposure_of(red).white, exposure_of(red).black) == (1, 0)


@pytest.mark.parametrize(
    ("gain", "offset", "verdict"),
    [(1, 0, "good"), (0.25, 0, "dark"), (0.3, 175, "bright"), (3, -100, "clipped"), (0.08, 118, "flat")],
)
def test_the_verdict_names_what_is_wrong(gain, offset, verdict):
    spread = np.clip(texture(1).astype(float), 20, 235)
    image = np.clip(spread * gain + offset, 0, 255).astype(np.uint8)
    assert exposure_of(image).verdict == verdict


def test_an_object_on_black_or_on_white_is_exposed_well():
    for ground in (0, 250):
        image = np.full((240, 320, 3), ground, np.uint8)
        image[60:180, 80:240] = texture(1)[60:180, 80:240]
        assert exposure_of(image).verdict == "good"


def copies(image: np.ndarray) -> dict[str, np.ndarray]:
    height, width = image.shape
    jpeg = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 60])[1], cv2.IMREAD_GRAYSCALE)
    return {
        "jpeg": jpeg,
        "small": cv2.resize(image, (width * 2 // 5, height * 2 // 5), interpolation=cv2.INTER_AREA),
        "brighter": np.clip(image * 1.05 + 5, 0, 255).astype(np.uint8),
    }


@pytest.mark.parametrize("seed", range(4))
def test_copies_have_near_fingerprints_and_other_pictures_have_not(seed):
    photo = cv2.resize(texture(seed, (60, 80)), (800, 600), interpolation=cv2.INTER_CUBIC)[..., 0]
    prints = {name: fingerprint(image) for name, image in copies(photo).items()}
    assert {name: int((found != fingerprint(photo)).sum()) <= NEAR for name, found in prints.items()} == dict.fromkeys(
        prints, True
    )
    shifted = np.roll(photo, 60, axis=1)
    other = cv2.resize(texture(seed + 50, (60, 80)), (800, 600), interpolation=cv2.INTER_CUBIC)[..., 0]
    for image in (shifted, other, photo[:, ::-1]):
        assert (fingerprint(np.ascontiguousarray(image)) != fingerprint(photo)).sum() > 3 * NEAR


def test_near_pairs_are_those_of_a_slow_count():
    rng = np.random.default_rng(0)
    prints = rng.random((30, 255)) > 0.5
    prints[7] = prints[3]
    prints[20] = prints[3] ^ (np.arange(255) < NEAR)
    prints[21] = prints[5] ^ (np.arange(255) < NEAR + 1)
    slow = [(i, j) for i in range(30) for j in range(i + 1, 30) if (prints[i] != prints[j]).sum() <= NEAR]
    assert near_pairs(prints) == slow == [(3, 7), (3, 20), (7, 20)]
    assert near_pairs(prints[:1]) == near_pairs(prints[:0]) == []
