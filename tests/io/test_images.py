from __future__ import annotations

import io
import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from sfm.core.errors import ImageError, InputError
from sfm.io.images import list_images, natural_key, read_image

FORMATS = {"a.jpg": "JPEG", "a.png": "PNG", "a.tif": "TIFF", "a.webp": "WEBP", "a.bmp": "BMP", "a.ppm": "PPM"}


def smooth(height: int, width: int, seed: int = 0) -> np.ndarray:
    """A picture that survives JPEG: low frequencies, all colours."""
    rng = np.random.default_rng(seed)
    small = rng.uniform(0, 255, (height // 12 + 2, width // 12 + 2, 3)).astype(np.float32)
    return np.clip(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC), 0, 255).astype(np.uint8)


def encoded(pixels: np.ndarray | Image.Image, kind: str, **options: object) -> bytes:
    buffer = io.BytesIO()
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    image.save(buffer, kind, **options)
    return buffer.getvalue()


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


# Listing


def test_names_are_in_natural_order() -> None:
    names = ["img10.jpg", "img2.jpg", "IMG3.jpg", "img02.jpg", "a/2.jpg", "a/10.jpg", "b.jpg", "1.jpg", "é1.jpg"]
    expected = ["1.jpg", "a/2.jpg", "a/10.jpg", "b.jpg", "img02.jpg", "img2.jpg", "IMG3.jpg", "img10.jpg", "é1.jpg"]
    assert sorted(names, key=natural_key) == expected
    assert sorted(["²1", "1²", "٣", "a"], key=natural_key)  # digits of other scripts are letters here


def test_images_are_found_by_content_in_all_folders(tmp_path: Path) -> None:
    jpeg = encoded(smooth(40, 50), "JPEG")
    for name in ("b.jpg", "sub/deep/photo without suffix", "sub/ö 2.PNG", "sub/10.jpg", "sub/9.jpg"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(jpeg)
    for name in (".hidden.jpg", ".thumbnails/x.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(jpeg)
    (tmp_path / "readme.jpg").write_text("no picture")
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "clip.mp4").write_bytes(b"\0\0\0\x20ftypisom" + bytes(40))
    (tmp_path / "phone.heic").write_bytes(b"\0\0\0\x20ftypheic" + bytes(40))
    (tmp_path / "noise.png").write_bytes(bytes(range(200)))
    listing = list_images(tmp_path)
    assert listing.names == ("b.jpg", "sub/9.jpg", "sub/10.jpg", "sub/deep/photo without suffix", "sub/ö 2.PNG")
    assert dict(listing.skipped) == {
        "readme.jpg": "is a text file, not an image",
        "empty.jpg": "is empty",
        "clip.mp4": "is a video, which cannot be read",
        "phone.heic": "is a HEIF/AVIF picture, which cannot be read",
        "noise.png": "is not an image",
    }


def test_circular_links_are_passed_over(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.png").write_bytes(encoded(smooth(40, 50), "PNG"))
    (photos / "loop").symlink_to(photos, target_is_directory=True)
    (photos / "broken.jpg").symlink_to(tmp_path / "nowhere")
    listing = list_images(photos)
    assert listing.names == ("a.png",)
    assert listing.skipped == (("broken.jpg", "is no regular file"),)


def test_names_that_cannot_be_stored_are_skipped_with_the_reason(tmp_path: Path) -> None:
    png = encoded(smooth(40, 50), "PNG")
    (tmp_path / "a\nb.png").write_bytes(png)
    with open(os.fsencode(tmp_path) + b"/\xff.png", "wb") as file:
        file.write(png)
    listing = list_images(tmp_path)
    assert listing.names == ()
    assert {reason for _, reason in listing.skipped} == {
        "its name is not valid UTF-8; rename it",
        "its name holds a line break or a tab; rename it",
    }


def test_a_folder_that_is_none_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        list_images(tmp_path / "missing")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file"):
        list_images(tmp_path / "file")
    assert list_images(tmp_path).names == ()


# Pixels


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_rgb_and_grey(tmp_path: Path, name: str) -> None:
    pixels = smooth(60, 90)
    path = tmp_path / f"fotö {name}"
    path.write_bytes(encoded(pixels, FORMATS[name]))
    colour, gray = read_image(path), read_image(path, gray=True)
    tolerance = 5 if FORMATS[name] in ("JPEG", "WEBP") else 0
    assert np.abs(colour.astype(int) - pixels).mean() <= tolerance
    assert gray.shape == (60, 90)
    luma = pixels @ np.array([0.299, 0.587, 0.114])
    assert np.abs(gray - luma).max() <= 2 * tolerance + 1.01


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_exif_orientation_is_not_applied(tmp_path: Path, orientation: int) -> None:
    pixels = smooth(48, 64)
    exif = Image.Exif()
    exif[274] = orientation
    for kind in ("JPEG", "PNG"):
        (tmp_path / "x").write_bytes(encoded(pixels, kind, exif=exif))
        assert np.abs(read_image(tmp_path / "x").astype(int) - pixels).mean() <= 5


@pytest.mark.parametrize("mode", ["L", "1", "P", "RGBA", "LA", "CMYK"])
def test_unusual_modes_are_read(tmp_path: Path, mode: str) -> None:
    image = Image.fromarray(smooth(60, 90))
    expected = np.asarray(image.convert(mode).convert("RGB")).astype(int)
    (tmp_path / "x").write_bytes(encoded(image.convert(mode), "TIFF" if mode == "CMYK" else "PNG"))
    colour = read_image(tmp_path / "x")
    assert colour.shape == (60, 90, 3)
    assert np.abs(colour - expected).mean() < 2
    assert read_image(tmp_path / "x", gray=True).shape == (60, 90)


def test_a_cmyk_jpeg_is_read_in_its_colours(tmp_path: Path) -> None:
    image = Image.fromarray(smooth(60, 90)).convert("CMYK")
    (tmp_path / "x").write_bytes(encoded(image, "JPEG", quality=95))
    assert np.abs(read_image(tmp_path / "x").astype(int) - np.asarray(image.convert("RGB"))).mean() < 4


def test_transparency_is_dropped_and_not_mixed_in(tmp_path: Path) -> None:
    pixels = smooth(60, 90)
    (tmp_path / "x").write_bytes(encoded(np.dstack([pixels, np.zeros((60, 90), np.uint8)]), "PNG"))
    np.testing.assert_array_equal(read_image(tmp_path / "x"), pixels)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_more_than_eight_bits_fill_eight(tmp_path: Path, bits: int, suffix: str) -> None:
    pixels = smooth(60, 90)
    pixels[0, 0] = 255
    white = 2**bits - 1
    deep = np.round(pixels / 255.0 * white).astype(np.uint16)
    ok, data = cv2.imencode(suffix, deep[:, :, ::-1])
    assert ok
    (tmp_path / "x").write_bytes(data.tobytes())
    assert np.abs(read_image(tmp_path / "x").astype(int) - pixels).max() <= 1


def test_floats_between_zero_and_one_are_scaled_and_others_refused(tmp_path: Path) -> None:
    pixels = smooth(60, 90)
    for scale in (1.0, 7.0):
        ok, data = cv2.imencode(".tiff", (pixels / 255 * scale).astype(np.float32))
        assert ok
        (tmp_path / "x.tiff").write_bytes(data.tobytes())
        if scale == 1:
            assert np.abs(read_image(tmp_path / "x.tiff")[:, :, ::-1].astype(int) - pixels).max() <= 1
        else:
            with pytest.raises(ImageError, match="float32 pixels beyond"):
                read_image(tmp_path / "x.tiff")


# Files that will not do


@pytest.mark.parametrize("name", FORMATS)
def test_a_truncated_image_is_refused(tmp_path: Path, name: str) -> None:
    data = encoded(smooth(200, 300), FORMATS[name])
    for fraction in (0.02, 0.3, 0.6, 0.9, 0.99):
        (tmp_path / name).write_bytes(data[: int(len(data) * fraction)])
        with pytest.raises(ImageError) as error:
            read_image(tmp_path / name)
        assert name in str(error.value)
        assert error.value.remedy


@pytest.mark.parametrize("progressive", [False, True])
def test_a_truncated_jpeg_is_seen_although_its_thumbnail_is_whole(tmp_path: Path, progressive: bool) -> None:
    exif = Image.Exif()
    thumbnail = encoded(smooth(40, 50), "JPEG")
    data = encoded(smooth(200, 300), "JPEG", progressive=progressive, exif=exif)
    with_thumbnail = data[:2] + b"\xff\xe1" + struct.pack(">H", len(thumbnail) + 2) + thumbnail + data[2:]
    (tmp_path / "x.jpg").write_bytes(with_thumbnail)
    assert read_image(tmp_path / "x.jpg").shape == (200, 300, 3)
    for missing in (2, 3, 100, 1000):
        (tmp_path / "x.jpg").write_bytes(with_thumbnail[:-missing])
        with pytest.raises(ImageError, match=r"x\.jpg: is truncated"):
            read_image(tmp_path / "x.jpg")


def test_data_behind_the_end_of_an_image_do_no_harm(tmp_path: Path) -> None:
    for kind in ("JPEG", "PNG"):
        (tmp_path / "x").write_bytes(encoded(smooth(200, 300), kind) + b"trailer of a camera" * 50)
        assert read_image(tmp_path / "x").shape == (200, 300, 3)


def test_a_png_with_a_flipped_byte_is_refused(tmp_path: Path) -> None:
    data = bytearray(encoded(smooth(200, 300), "PNG"))
    data[len(data) // 2] ^= 0x10
    (tmp_path / "x.png").write_bytes(data)
    with pytest.raises(ImageError):
        read_image(tmp_path / "x.png")


@pytest.mark.parametrize(
    ("data", "cause"),
    [
        (b"", "is empty"),
        (b"just some words\n", "is a text file, not an image"),
        (bytes(1000), "is not an image"),
        (b"\xff\xd8\xff", "is truncated"),
        (b"\xff\xd8\xff\xd9", "is corrupt"),
        (b"\x89PNG\r\n\x1a\n", "is truncated"),
        (b"II*\0" + bytes(100), "is corrupt"),
        (b"GIF89a" + bytes(100), "is a GIF"),
    ],
)
def test_what_is_no_image_is_refused_with_its_cause(tmp_path: Path, data: bytes, cause: str) -> None:
    (tmp_path / "x.jpg").write_bytes(data)
    with pytest.raises(ImageError, match=f"x.jpg: {cause}"):
        read_image(tmp_path / "x.jpg")


def test_images_without_size_or_below_the_least_are_refused(tmp_path: Path) -> None:
    header = struct.pack(">IIBBBBB", 0, 10, 8, 0, 0, 0, 0)
    png = (
        b"\x89PNG\r\n\x1a\n"
        + png_chunk(b"IHDR", header)
        + png_chunk(b"IDAT", zlib.compress(b""))
        + png_chunk(b"IEND", b"")
    )
    (tmp_path / "x.png").write_bytes(png)
    with pytest.raises(ImageError, match="is corrupt"):
        read_image(tmp_path / "x.png")
    (tmp_path / "x.png").write_bytes(encoded(smooth(15, 300), "PNG"))
    with pytest.raises(ImageError, match="300 × 15 px is too small — at least 16"):
        read_image(tmp_path / "x.png")


def test_a_file_that_cannot_be_opened_is_an_image_error(tmp_path: Path) -> None:
    for path in (tmp_path / "missing.jpg", tmp_path):
        with pytest.raises(ImageError):
            read_image(path)


def test_broken_files_print_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name, kind in FORMATS.items():
        data = encoded(smooth(200, 300), kind)
        (tmp_path / name).write_bytes(data[: len(data) // 2])
        with pytest.raises(ImageError):
            read_image(tmp_path / name)
    assert capfd.readouterr() == ("", "")
