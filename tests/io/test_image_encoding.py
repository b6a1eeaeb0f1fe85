"""Images as files: what is written is read again, with the EXIF of the photo and nothing of its old pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from sfm.core.errors import ImageError
from sfm.io.image_encoding import PhotoFacts, encoded_image, photo_facts
from sfm.io.images import read_pixels

_ORIENTATION, _EXIF, _GPS = 274, 34665, 34853


def exif() -> Image.Exif:
    made = Image.Exif()
    made[271], made[_ORIENTATION], made[306] = "Maker", 6, "2020:01:02 03:04:05"
    made.get_ifd(_EXIF).update({33434: (1, 100), 37386: 35.0, 40962: 64, 40963: 48})
    made.get_ifd(_GPS).update({1: "N", 2: (1.0, 2.0, 3.0)})
    return made


def noise(shape: tuple[int, ...], dtype: type = np.uint8) -> np.ndarray:
    return np.random.default_rng(3).integers(0, np.iinfo(dtype).max, shape).astype(dtype)


@pytest.mark.parametrize("suffix", ["png", "tif", "tiff", "webp", "bmp", "PPM"])
@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3)])
def test_what_is_written_without_loss_reads_back(tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
    path, image = tmp_path / f"a.{suffix}", noise(shape)
    path.write_bytes(encoded_image(image, path))
    again = read_pixels(path)
    if suffix == "webp" and image.ndim == 2:  # which knows no grey
        again = again[:, :, 0]
    np.testing.assert_array_equal(again, image)


@pytest.mark.parametrize("suffix", ["png", "tif", "ppm"])
@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3)])
def test_16_bits_read_back(tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
    path, image = tmp_path / f"a.{suffix}", noise(shape, np.uint16)
    path.write_bytes(encoded_image(image, path))
    again = read_pixels(path)
    assert again.dtype == np.uint16
    np.testing.assert_array_equal(again, image)


@pytest.mark.parametrize(
    ("suffix", "shape", "dtype"),
    [
        ("jpg", (48, 64, 3), np.uint8), ("png", (48, 64), np.uint8), ("png", (48, 64, 3), np.uint16),
        ("tif", (48, 64, 3), np.uint8), ("tif", (48, 64), np.uint16), ("webp", (48, 64, 3), np.uint8),
    ],
)  # fmt: skip
def test_exif_travels_to_an_image_of_another_size(tmp_path: Path, suffix, shape, dtype) -> None:
    old, new = tmp_path / f"old.{suffix}", tmp_path / f"new.{suffix}"
    source = Image.fromarray(noise((48, 64, 3)))
    source.save(
        old, exif=exif().tobytes(), icc_profile=ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    )
    image = noise(shape, dtype)[:30, :40]
    new.write_bytes(encoded_image(image, new, photo_facts(old, 40, 30, with_exif=True)))
    with Image.open(new) as photo:
        found = photo.getexif()
        assert photo.size == (40, 30)
        assert (found[271], found[306]) == ("Maker", "2020:01:02 03:04:05")
        assert found.get(_ORIENTATION) == (None if suffix == "tif" else 6)
        inner = found.get_ifd(_EXIF)
        assert (inner[37386], inner[40962], inner[40963]) == (35.0, 40, 30)
        assert tuple(found.get_ifd(_GPS)[2]) == (1.0, 2.0, 3.0)
        assert len(photo.info["icc_profile"]) > 400
    assert read_pixels(new).shape[:2] == (30, 40)


def test_without_exif_only_the_profile_of_colours_is_kept(tmp_path: Path) -> None:
    Image.fromarray(noise((48, 64, 3))).save(tmp_path / "a.jpg", exif=exif(), icc_profile=b"colours")
    assert photo_facts(tmp_path / "a.jpg", 64, 48, with_exif=False) == PhotoFacts(b"", b"colours")
    cv2.imwrite(str(tmp_path / "bare.png"), noise((48, 64)))
    assert photo_facts(tmp_path / "bare.png", 64, 48, with_exif=True) == PhotoFacts()


@pytest.mark.parametrize(
    ("name", "dtype", "facts", "cause"),
    [
        ("a.jp2", np.uint8, PhotoFacts(), "'.jp2' are not written"),
        ("a", np.uint8, PhotoFacts(), "'' are not written"),
        ("a.jpg", np.uint16, PhotoFacts(), "has 16 bits, and JPEG 8"),
        ("a.tif", np.uint16, PhotoFacts(b"exif"), "16 bits a colour is not written with EXIF"),
    ],
)
def test_what_has_no_place_is_refused(name: str, dtype: type, facts: PhotoFacts, cause: str) -> None:
    with pytest.raises(ImageError, match=cause):
        encoded_image(noise((20, 30, 3), dtype), Path(name), facts)
