from __future__ import annotations

import math

import numpy as np
import pycolmap
import pytest

from sfm.core.cameras import COLMAP_MODELS
from sfm.core.cameras.priors import focal_from_35mm, focal_from_sensor, infer_camera
from sfm.core.cameras.sensors import _SENSORS_MM, _TABLE, sensor_width_mm


@pytest.mark.parametrize("info", COLMAP_MODELS, ids=lambda info: info.name)
def test_a_guessed_camera_is_pycolmaps(info):
    ours = infer_camera(info.name, 640, 480, 500.0)
    theirs = pycolmap.Camera.create_from_model_name(0, info.name, 500.0, 640, 480)
    np.testing.assert_array_equal(ours.params, theirs.params)
    assert ours.has_prior_focal_length == (info.name != "EQUIRECTANGULAR")


def test_without_any_knowledge_the_focal_length_follows_the_longer_side():
    camera = infer_camera("SIMPLE_RADIAL", 480, 640)
    assert camera.focal_lengths == (768.0, 768.0)
    assert camera.principal_point == (240.0, 320.0)
    assert not camera.has_prior_focal_length


@pytest.mark.parametrize("focal", [0.0, -5.0, math.nan, math.inf])
def test_a_focal_length_that_cannot_be_is_refused(focal):
    with pytest.raises(ValueError, match="focal"):
        infer_camera("PINHOLE", 640, 480, focal)


def test_the_35_mm_equivalent_keeps_the_field_of_view_across_the_diagonal():
    assert focal_from_35mm(36.0, 3000, 2000) == pytest.approx(3000)
    for width, height in [(3000, 2000), (4000, 3000), (3000, 4000)]:
        focal = focal_from_35mm(28.0, width, height)
        assert math.atan(math.hypot(width, height) / 2 / focal) == pytest.approx(math.atan(math.hypot(36, 24) / 2 / 28))


def test_a_full_frame_sensor_gives_the_same_as_the_35_mm_equivalent():
    assert focal_from_sensor(50.0, 36.0, 6000, 4000) == pytest.approx(focal_from_35mm(50.0, 6000, 4000))
    assert focal_from_sensor(50.0, 36.0, 4000, 6000) == focal_from_sensor(50.0, 36.0, 6000, 4000)
    with pytest.raises(ValueError, match="sensor"):
        focal_from_sensor(50.0, 0.0, 600, 400)


@pytest.mark.parametrize(
    ("make", "model", "width_mm"),
    [
        ("NIKON CORPORATION", "NIKON D90", 23.6),
        ("Canon", "Canon EOS 5D Mark II", 36.0),
        ("CANON", "canon eos-5d  mark ii ", 36.0),
        ("", "Canon EOS 40D", 22.2),
        ("OLYMPUS IMAGING CORP.", "E-P1", 17.3),
        ("RICOH IMAGING COMPANY, LTD.", "PENTAX K-1", 35.9),
        ("RICOH IMAGING COMPANY, LTD.", "RICOH GR III", 23.5),
        ("FUJI PHOTO FILM CO., LTD.", "X100", 23.6),
        ("Hasselblad", "L1D-20c", 13.2),
        ("DJI", "FC6310", 13.2),
        ("SONY", "ILCE-7M3", 35.8),
    ],
)
def test_a_known_camera_has_its_sensor(make, model, width_mm):
    assert sensor_width_mm(make, model) == width_mm


@pytest.mark.parametrize(("make", "model"), [("", ""), ("Canon", ""), ("Acme", "D90"), ("NIKON", "D9")])
def test_an_unknown_camera_has_none(make, model):
    assert sensor_width_mm(make, model) is None


def test_the_table_names_each_camera_once_and_with_a_size_that_exists():
    listed = [m for widths in _SENSORS_MM.values() for models in widths.values() for m in models.split(", ")]
    assert len(_TABLE) == len(listed) >= 80
    assert all(4 < width < 54 for width in _TABLE.values())
