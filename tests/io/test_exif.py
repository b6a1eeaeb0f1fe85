from __future__ import annotations

from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sfm.core.errors import ImageError
from sfm.io.exif import ImageInfo, prior_focal_px, read_image_info

MAKE, MODEL, ORIENTATION = 271, 272, 274
FOCAL, FOCAL_35, PLANE_X, PLANE_UNIT, WIDTH, HEIGHT, TIME, ZONE = 37386, 41989, 41486, 41488, 40962, 40963, 36867, 36881
BASE = (MAKE, MODEL, ORIENTATION)


def photo(path: Path, size: tuple[int, int] = (640, 480), tags: dict[int, Any] | None = None, gps: Any = None) -> Path:
    image = Image.new("RGB", size, (10, 200, 30))
    exif = image.getexif()
    directory = exif.get_ifd(0x8769)
    for tag, value in (tags or {}).items():
        (exif if tag in BASE else directory)[tag] = rational(value) if isinstance(value, float) else value
    if gps:
        exif.get_ifd(0x8825).update(gps)
    image.save(path, exif=exif)
    return path


def rational(value: float) -> IFDRational:
    return IFDRational(round(value * 10000), 10000)


def test_a_photo_without_exif_has_a_size_and_no_prior(tmp_path: Path) -> None:
    for name in ("x.png", "x.jpg", "x.webp", "x.tif"):
        Image.new("L", (64, 48)).save(tmp_path / name)
        assert read_image_info(tmp_path / name) == ImageInfo(64, 48)
    assert prior_focal_px(ImageInfo(64, 48)) is None


def test_all_facts_are_read(tmp_path: Path) -> None:
    tags = {
        MAKE: "Maker\0", MODEL: " Model 7 ", ORIENTATION: 6, FOCAL: 6.1, FOCAL_35: 28, PLANE_X: 3000.0, PLANE_UNIT: 3,
        WIDTH: 1280, HEIGHT: 960, TIME: "2024:02:29 23:59:58", ZONE: "+02:00", 33434: 0.005, 33437: 2.8, 34855: 400,
    }  # fmt: skip
    gps = {
        1: "S", 2: (rational(33.0), rational(30.0), rational(36.0)),
        3: "E", 4: (rational(151.0), rational(12.0), rational(0.0)), 5: b"\1", 6: rational(12.5),
    }  # fmt: skip
    info = read_image_info(photo(tmp_path / "x.jpg", (480, 640), tags, gps))
    assert (info.width, info.height, info.orientation) == (480, 640, 6)
    assert (info.make, info.model) == ("Maker", "Model 7")
    assert (info.focal_mm, info.focal_35mm, info.sensor_px_per_mm, info.exif_size) == (6.1, 28.0, 300.0, (1280, 960))
    assert info.captured == datetime(2024, 2, 29, 23, 59, 58, tzinfo=timezone(timedelta(hours=2)))
    assert (info.exposure_s, info.f_number, info.iso) == (0.005, 2.8, 400.0)
    assert info.gps == pytest.approx((-33.51, 151.2))
    assert info.altitude_m == -12.5


@pytest.mark.parametrize("size", [(640, 480), (480, 640), (1000, 1000)])
@pytest.mark.parametrize("orientation", [1, 6])
@pytest.mark.parametrize(
    "tags",
    [
        {FOCAL_35: 28},
        {FOCAL_35: 28, FOCAL: 6.1, PLANE_X: 100.0, PLANE_UNIT: 4},
        {FOCAL: 24.0, MAKE: "Canon", MODEL: "Canon EOS 5D Mark II"},
        {FOCAL: 24.0, MAKE: "NIKON CORPORATION", MODEL: "NIKON D90"},
        {FOCAL: 24.0, PLANE_X: 2500.0, PLANE_UNIT: 2},
        {FOCAL: 24.0, PLANE_X: 500.0, PLANE_UNIT: 3},
        {FOCAL: 24.0, PLANE_X: 50.0, PLANE_UNIT: 4},
        {FOCAL: 24.0},
        {FOCAL_35: 0},
    ],
)
def test_the_prior_focal_length_is_pycolmaps(tmp_path: Path, tags: dict, orientation: int, size: tuple) -> None:
    path = photo(tmp_path / "x.jpg", size, {**tags, ORIENTATION: orientation})
    ours, theirs = prior_focal_px(read_image_info(path)), pycolmap.Bitmap.read(path, True).exif_focal_length()
    assert (ours is None) == (theirs is None)
    # The two tables of sensors are different tables, and pycolmap rounds the diagonal of 35 mm film to 43.27 mm.
    assert ours is None or ours == pytest.approx(theirs, rel=5e-3 if MODEL in tags else 1e-4)


def test_the_resolution_on_the_sensor_follows_a_resize(tmp_path: Path) -> None:
    tags = {FOCAL: 24.0, PLANE_X: 2500.0, PLANE_UNIT: 2, WIDTH: 5616, HEIGHT: 3744}
    large = prior_focal_px(read_image_info(photo(tmp_path / "a.jpg", (5616, 3744), tags)))
    small = prior_focal_px(read_image_info(photo(tmp_path / "b.jpg", (702, 468), tags)))
    assert large == pytest.approx(24 * 2500 / 25.4)
    assert small == pytest.approx(large / 8)


@pytest.mark.parametrize("tags", [{FOCAL_35: 65535}, {FOCAL: 1e-4, PLANE_X: 3.0}, {FOCAL: 99999.0, PLANE_X: 9e4}])
def test_an_absurd_focal_length_is_no_prior(tmp_path: Path, tags: dict) -> None:
    assert prior_focal_px(read_image_info(photo(tmp_path / "x.jpg", tags=tags))) is None


@pytest.mark.parametrize(
    "tags",
    [
        {ORIENTATION: 0}, {ORIENTATION: 99}, {FOCAL: "long"}, {FOCAL: IFDRational(5, 0)},
        {FOCAL: -3.0}, {TIME: "0000:00:00 00:00:00"}, {TIME: "yesterday"}, {MAKE: b"\xff\xfe"}, {WIDTH: 0, HEIGHT: 0},
        {PLANE_X: 0.0, PLANE_UNIT: 77, FOCAL: 3.0}, {ZONE: "nowhere", TIME: "2024:01:01 00:00:00"},
    ],
)  # fmt: skip
def test_tags_that_make_no_sense_are_left_open(tmp_path: Path, tags: dict) -> None:
    info = read_image_info(photo(tmp_path / "x.jpg", tags=tags))
    assert (info.width, info.height, info.orientation) == (640, 480, 1)
    assert info.focal_mm in (None, 3.0)
    assert prior_focal_px(info) is None


@pytest.mark.parametrize(
    "gps",
    [
        {2: (rational(0.0),) * 3, 4: (rational(0.0),) * 3},
        {2: (rational(91.0),) * 3, 4: (rational(0.0),) * 3},
        {2: (rational(45.0), rational(1.0)), 4: (rational(1.0),) * 3},
        {2: (IFDRational(0, 0),) * 3, 4: (rational(1.0),) * 3},
        {1: "N"},
    ],
)
def test_a_place_that_makes_no_sense_is_none(tmp_path: Path, gps: dict) -> None:
    assert read_image_info(photo(tmp_path / "x.jpg", gps=gps)).gps is None


def test_damaged_exif_never_raises(tmp_path: Path, rng: np.random.Generator) -> None:
    tags = {MAKE: "Maker", FOCAL: 6.1, FOCAL_35: 28, TIME: "2024:02:29 23:59:58"}
    path = photo(tmp_path / "x.jpg", tags=tags, gps={1: "N", 2: (rational(1.0),) * 3})
    whole = path.read_bytes()
    start = whole.index(b"Exif\0\0") + 6
    end = start + int.from_bytes(whole[start - 8 : start - 6], "big") - 8
    for _ in range(150):
        damaged = bytearray(whole)
        for position in rng.integers(start, end, 4):
            damaged[position] = rng.integers(256)
        path.write_bytes(damaged)
        info = read_image_info(path)
        assert (info.width, info.height) == (640, 480)
        focal = prior_focal_px(info)
        assert focal is None or 64 < focal < 64000


def test_a_file_of_a_kind_that_pillow_does_not_know_has_a_size(tmp_path: Path, monkeypatch) -> None:
    ok, data = cv2.imencode(".png", np.zeros((48, 64, 3), np.uint16))
    assert ok
    (tmp_path / "x.png").write_bytes(data.tobytes())

    def refuse(*_: object) -> None:
        raise Image.UnidentifiedImageError

    monkeypatch.setattr(Image, "open", refuse)
    assert read_image_info(tmp_path / "x.png") == ImageInfo(64, 48)


@pytest.mark.parametrize("data", [b"", b"words\n", bytes(99), b"\xff\xd8\xff\xe0", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_image_is_an_image_error(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "x.jpg").write_bytes(data)
    with pytest.raises(ImageError, match=r"x\.jpg"):
        read_image_info(tmp_path / "x.jpg")
    with pytest.raises(ImageError, match="no such file"):
        read_image_info(tmp_path / "missing.jpg")
