from __future__ import annotations

import numpy as np
import pytest

from sfm.core.imaging.resample import remap, resize


def ramp(width: int, height: int) -> np.ndarray:
    """An image whose value at pixel coordinates (x, y) is x + 2 y."""
    y, x = np.mgrid[:height, :width] + 0.5
    return (x + 2 * y).astype(np.float32)


def grid(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    y, x = (np.mgrid[:height, :width] + 0.5).astype(np.float32)
    return x, y


@pytest.mark.parametrize(("width", "height"), [(40, 30), (20, 15), (16, 10)])
def test_shrinking_keeps_the_corners_in_place_and_the_mean(width, height):
    small = resize(ramp(80, 60), width, height)
    x, y = grid(width, height)
    np.testing.assert_allclose(small, x * 80 / width + 2 * y * 60 / height, atol=1e-3)
    assert small.mean() == pytest.approx(ramp(80, 60).mean(), rel=1e-5)


def test_enlarging_keeps_the_corners_in_place():
    large = resize(ramp(40, 30), 80, 60)
    x, y = grid(80, 60)
    np.testing.assert_allclose(large[1:-1, 1:-1], (x / 2 + y)[1:-1, 1:-1], atol=1e-3)


def test_shrinking_does_not_alias():
    stripes = np.tile(np.array([0, 255], np.uint8), (60, 40))
    assert np.ptp(resize(stripes, 40, 30)) == 0
    np.testing.assert_allclose(resize(stripes, 23, 17).astype(float), 127.5, atol=20)


def test_an_image_of_the_right_size_is_returned():
    image = ramp(8, 6)
    assert resize(image, 8, 6) is image
    with pytest.raises(ValueError, match="size"):
        resize(image, 0, 6)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_colour_and_type_are_kept(dtype):
    image = np.zeros((20, 30, 3), dtype)
    image.flags.writeable = False
    assert resize(image, 15, 10).shape == (10, 15, 3)
    assert resize(image, 15, 10).dtype == dtype
    assert remap(image, *grid(15, 10)).shape == (10, 15, 3)
    assert remap(image, *grid(15, 10)).dtype == dtype


def test_the_identical_grid_gives_the_image():
    image = ramp(30, 20)
    np.testing.assert_array_equal(remap(image, *grid(30, 20)), image)
    np.testing.assert_array_equal(remap(image, *grid(30, 20), nearest=True), image)


def test_values_between_pixels_are_linear():
    x, y = grid(30, 20)
    result = remap(ramp(40, 30), x + np.float32(3.3), y + np.float32(4.8))
    np.testing.assert_allclose(result, x + 3.3 + 2 * (y + 4.8), atol=0.06)  # OpenCV rounds weights to 1/32


def test_half_a_pixel_within_the_border_repeats_and_outside_is_filled():
    x = np.array([[-0.01, 0.0, 0.25, 0.5, 29.5, 29.9, 30.0, 30.01, np.nan]], np.float32)
    y = np.full_like(x, 0.5)
    result = remap(ramp(30, 20), x, y, fill=-7.0)
    np.testing.assert_allclose(result[0], [-7, 1.5, 1.5, 1.5, 30.5, 30.5, 30.5, -7, -7], atol=1e-5)


def test_labels_are_never_mixed():
    labels = np.random.default_rng(0).integers(0, 2, (20, 30)).astype(np.uint8) * 200
    x, y = grid(28, 18)
    shifted = remap(labels, x + np.float32(0.4), y + np.float32(1.3), nearest=True)
    np.testing.assert_array_equal(shifted, labels[1:19, 0:28])
