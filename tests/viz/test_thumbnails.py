from __future__ import annotations

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.viz.thumbnails import thumbnail

CAMERAS = {
    "pinhole": Camera("PINHOLE", 800, 600, np.array([700.0, 710, 390, 310])),
    "radial": Camera("SIMPLE_RADIAL", 800, 600, np.array([700.0, 400, 300, -0.12])),
    "fisheye": Camera("OPENCV_FISHEYE", 800, 600, np.array([350.0, 350, 400, 300, 0.02, 0, 0, 0])),
    "panorama": Camera("EQUIRECTANGULAR", 800, 400, np.array([800.0, 400])),
}


@pytest.mark.parametrize("name", sorted(CAMERAS))
def test_a_thumbnail_is_a_pinhole_picture_of_the_same_rays(name: str) -> None:
    # The photo's grey is the x of the ray; so must the thumbnail's be, under its own camera.
    camera = CAMERAS[name]
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays, valid = camera.unproject(np.stack([x.ravel(), y.ravel()], 1))
    grey = np.where(valid, 127.5 + 120 * rays[:, 0], 0)
    photo = np.rint(grey).astype(np.uint8).reshape(camera.height, camera.width)
    picture, target = thumbnail(photo, camera, max_size=200)
    assert max(picture.shape) == 200
    assert target.model == "PINHOLE"
    assert (target.height, target.width) == picture.shape
    rows, columns = np.mgrid[20 : target.height - 20 : 7, 20 : target.width - 20 : 7]
    pixels = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], 1)
    expected = 127.5 + 120 * target.unproject(pixels)[0][:, 0]
    seen = picture[rows.ravel(), columns.ravel()].astype(float)
    inside = seen > 0
    assert inside.mean() > 0.5
    assert np.abs(seen - expected)[inside].max() < 2.5


def test_colour_stays_and_a_small_photo_is_not_enlarged() -> None:
    photo = np.full((60, 80, 3), (10, 200, 30), np.uint8)
    camera = Camera("PINHOLE", 80, 60, np.array([70.0, 70, 40, 30]))
    picture, target = thumbnail(photo, camera, max_size=512)
    assert picture.shape == (60, 80, 3)
    assert (picture == (10, 200, 30)).all()
    np.testing.assert_allclose(target.params, camera.params)


def test_a_photo_of_another_size_than_the_camera_is_fitted_to_it() -> None:
    photo = np.full((300, 400), 77, np.uint8)
    picture, target = thumbnail(photo, CAMERAS["pinhole"], max_size=200)
    assert picture.shape == (150, 200)
    assert (target.width, target.height) == (200, 150)
