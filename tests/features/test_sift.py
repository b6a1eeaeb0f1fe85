from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.core.errors import ConfigError, Rejected
from sfm.core.scene import Features
from sfm.features import FeatureConfig, extract_features
from sfm.features.sift import root_normalized
from tests.features.rendering import blob_image, texture


def extracted(image: np.ndarray, **options) -> Features:
    features = extract_features(image, FeatureConfig(**options))
    assert isinstance(features, Features)
    return features


def nearest_errors(features: Features, centers: np.ndarray) -> np.ndarray:
    gaps = features.points2D[None] - centers[:, None]
    nearest = np.argmin(np.linalg.norm(gaps, axis=2), axis=1)
    return gaps[np.arange(len(centers)), nearest]


def test_a_spot_is_found_at_its_place_without_bias():
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(np.arange(40, 300, 50), np.arange(40, 220, 50)), -1).reshape(-1, 2)
    centers = grid + rng.uniform(-3, 3, grid.shape)
    errors = nearest_errors(extracted(blob_image(centers, 4)), centers)
    assert np.all(np.abs(errors) < 0.1)
    assert np.all(np.abs(errors.mean(axis=0)) < 0.02)


def test_a_spot_of_a_reduced_image_is_found_at_its_place_in_the_full_one():
    centers = np.array([[100.3, 120.9], [333.3, 222.2], [510.7, 408.1], [71.0, 301.5]])
    image = blob_image(centers, 9, (479, 641))
    errors = nearest_errors(extracted(image, max_image_size=320), centers)
    assert np.all(np.abs(errors) < 0.15)


def test_the_scale_of_a_spot_is_that_of_the_full_image():
    center = np.array([[320.5, 240.5]])
    full, reduced = (extracted(blob_image(center, 12, (480, 640)), max_image_size=s) for s in (0, 320))
    largest = [f.scales[np.argmin(np.linalg.norm(f.points2D - center, axis=1))] for f in (full, reduced)]
    assert 8 < largest[0] < 14
    assert largest[1] == pytest.approx(largest[0], rel=0.05)


def test_the_orientation_turns_from_x_to_y_with_the_image():
    image = texture(2, (201, 201))
    turned = np.ascontiguousarray(np.rot90(image, -1))  # a quarter turn from x to y
    first, second = extracted(image), extracted(turned)
    moved = np.stack([201 - first.points2D[:, 1], first.points2D[:, 0]], axis=1)
    distance = np.linalg.norm(moved[:, None] - second.points2D[None], axis=2)
    pairs = np.argwhere(distance < 0.05)
    assert len(pairs) > 100
    turn = second.orientations[pairs[:, 1]] - first.orientations[pairs[:, 0]]
    assert np.median(np.abs(np.angle(np.exp(1j * (turn - np.pi / 2))))) < 0.05


def test_coordinates_survive_float32_and_rows_are_sorted():
    features = extracted(texture(3), max_image_size=150)
    assert np.array_equal(features.points2D, features.points2D.astype(np.float32))
    keys = np.stack([features.points2D[:, 1], features.points2D[:, 0], features.scales, features.orientations], 1)
    assert [tuple(row) for row in keys] == sorted(tuple(row) for row in keys)
    assert len({tuple(row) for row in keys}) == len(keys)


def test_the_strongest_are_kept_when_there_are_too_many():
    many, few = extracted(texture(4)), extracted(texture(4), max_features=50)
    assert len(many) > 200
    assert len(few) == 50
    assert {tuple(p) for p in few.points2D} <= {tuple(p) for p in many.points2D}


def test_a_lower_threshold_finds_more_keypoints():
    low, high = (len(extracted(texture(5), contrast_threshold=c, min_features=0)) for c in (0.01, 0.08))
    assert low > high


def test_descriptors_have_length_512_and_are_square_roots():
    rng = np.random.default_rng(6)
    histograms = rng.integers(0, 120, (40, 128)).astype(np.float32)
    descriptors = root_normalized(histograms)
    assert np.linalg.norm(descriptors.astype(float), axis=1) == pytest.approx(512, rel=0.01)
    assert descriptors[0, 0] == round(512 * np.sqrt(histograms[0, 0] / histograms[0].sum()))
    assert not root_normalized(np.zeros((1, 128), np.float32)).any()


def test_colour_is_read_as_grey():
    grey = texture(7)
    assert np.array_equal(extracted(np.repeat(grey[..., None], 3, 2)).points2D, extracted(grey).points2D)


def test_extraction_twice_gives_the_same_bits():
    first, second = extracted(texture(8)), extracted(texture(8))
    for field in dataclasses.fields(Features):
        assert np.asarray(getattr(first, field.name)).tobytes() == np.asarray(getattr(second, field.name)).tobytes()


@pytest.mark.parametrize(
    ("image", "reason"),
    [(np.zeros((300, 300), np.uint8), "no_features"), (np.zeros((8, 300), np.uint8), "image_too_small")],
)
def test_an_image_without_keypoints_is_rejected_with_a_reason(image, reason):
    result = extract_features(image)
    assert isinstance(result, Rejected)
    assert result.reason == reason


@pytest.mark.parametrize("options", [{"max_image_size": -1}, {"max_image_size": 5}, {"max_features": 0}])
def test_settings_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match="must be"):
        FeatureConfig(**options)
