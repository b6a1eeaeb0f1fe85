"""What every detector must keep, whichever it is."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest

from sfm.core.errors import ConfigError, Rejected
from sfm.core.scene import DescriptorKind, Features
from sfm.features import FeatureConfig, extract, extract_features
from sfm.features.extraction import Extraction
from tests.features.rendering import blob_image, corner_image, errors_at, scattered, texture


def nearest_pairs(points1: np.ndarray, points2: np.ndarray, within: float) -> tuple[np.ndarray, np.ndarray]:
    distances = np.linalg.norm(points1[:, None] - points2[None], axis=2)
    rows = np.flatnonzero(distances.min(axis=1) < within)
    return rows, distances[rows].argmin(axis=1)


class Contract:
    """Subclasses name the detector, and bounds for what is not exact in it."""

    options: ClassVar[dict[str, Any]]
    kind = DescriptorKind.BINARY
    descriptor_bytes = 32
    sees = "corners"
    finds = 0.9
    """Share of the rendered places that it must find."""
    bias_px = 0.02
    turns = True
    """Whether descriptors turn with the image."""

    def features(self, image: np.ndarray, mask: np.ndarray | None = None, **options: Any) -> Features:
        result = extract_features(image, FeatureConfig(**(self.options | options)), mask)
        assert isinstance(result, Features)
        return result

    def test_what_is_rendered_is_found_at_its_place_without_bias(self):
        if self.sees == "spots":
            places = scattered(1)
            image = blob_image(places, 3, (480, 640))
        else:
            image, places = corner_image(1)
        errors = errors_at(self.features(image).points2D, places, within=3)
        assert len(errors) >= self.finds * len(places)
        assert np.abs(errors.mean(axis=0)).max() <= self.bias_px

    @pytest.mark.parametrize("reduced", [0, 300])
    def test_a_photo_turned_by_180_degrees_gives_the_turned_keypoints(self, reduced):
        """A shift of half a pixel on any level of a pyramid, or of a reduction, would show up twice here."""
        image = texture(2, (331, 403))
        first, second = (
            self.features(picture, max_image_size=reduced, max_features=1500)
            for picture in (image, np.ascontiguousarray(image[::-1, ::-1]))
        )
        turned = np.array([403, 331]) - second.points2D
        rows, partners = nearest_pairs(first.points2D, turned, within=2)
        assert len(rows) > 0.7 * len(first)
        shifts = (first.points2D[rows] - turned[partners]) / 2
        assert np.abs(np.median(shifts, axis=0)).max() < 0.02
        if self.turns:
            turn = second.orientations[partners] - first.orientations[rows]
            assert np.median(np.abs(np.angle(np.exp(1j * (turn - np.pi))))) < 0.1

    def test_rows_are_sorted_and_survive_float32(self):
        features = self.features(texture(3), max_image_size=200)
        assert features.kind == self.kind
        assert features.descriptors.shape == (len(features), self.descriptor_bytes)
        assert np.array_equal(features.points2D, features.points2D.astype(np.float32))
        keys = np.column_stack([features.points2D[:, ::-1], features.scales, features.orientations])
        assert [tuple(row) for row in keys] == sorted(tuple(row) for row in keys)
        assert (features.scales > 0).all()
        assert (features.points2D > 0).all()
        assert (features.points2D < [260, 200]).all()

    def test_extraction_twice_gives_the_same_bits(self):
        first, second = self.features(texture(4)), self.features(texture(4))
        for field in dataclasses.fields(Features):
            assert np.asarray(getattr(first, field.name)).tobytes() == np.asarray(getattr(second, field.name)).tobytes()

    def test_the_cap_keeps_some_of_what_is_found_without_it(self):
        many, few = self.features(texture(5)), self.features(texture(5), max_features=40)
        assert len(many) > 60
        assert len(few) == 40
        assert {tuple(p) for p in few.points2D} <= {tuple(p) for p in many.points2D}

    def test_a_mask_takes_away_exactly_what_lies_in_it(self):
        image = texture(6)
        mask = np.ones(image.shape, np.bool_)
        mask[50:120, 90:180] = False
        everything, outside = (self.features(image, m, min_features=0) for m in (None, mask))
        x, y = np.floor(everything.points2D).astype(int).T
        assert 0 < (~mask[y, x]).sum() < len(everything)
        np.testing.assert_array_equal(outside.points2D, everything.points2D[mask[y, x]])
        np.testing.assert_array_equal(outside.descriptors, everything.descriptors[mask[y, x]])

    def test_a_mask_over_everything_is_told_from_an_empty_image(self):
        image = texture(6)
        hidden = extract_features(image, FeatureConfig(**self.options), np.zeros(image.shape, np.bool_))
        assert isinstance(hidden, Rejected)
        assert hidden.reason == "all_masked"

    def test_upright_features_have_no_orientation_and_each_place_and_scale_once(self):
        features = self.features(texture(7), upright=True)
        assert len(features) > 60
        assert not features.orientations.any()
        places = np.column_stack([features.points2D, features.scales])
        assert len(np.unique(places, axis=0)) == len(features)

    @pytest.mark.parametrize(
        ("image", "reason"),
        [
            (np.full((200, 300), 90, np.uint8), "no_features"),
            (np.zeros((8, 300), np.uint8), "image_too_small"),
            (np.zeros((16, 16), np.uint8), "no_features"),
        ],
    )
    def test_a_blank_or_tiny_image_is_rejected_with_a_reason(self, image, reason):
        result = extract_features(image, FeatureConfig(min_features=10, **self.options))
        assert isinstance(result, Rejected)
        assert result.reason == reason

    def test_colour_is_read_as_grey(self):
        grey = texture(8)
        assert np.array_equal(self.features(np.repeat(grey[..., None], 3, 2)).points2D, self.features(grey).points2D)

    def test_a_lower_contrast_finds_more(self):
        flat = (120 + 0.25 * (texture(9).astype(float) - 128)).astype(np.uint8)
        little, much = (len(self.features(flat, contrast_threshold=c, min_features=0)) for c in (0.01, 0.04))
        assert little > much

    def test_descriptors_tell_the_places_of_a_brighter_and_shifted_image(self):
        image = texture(10, (260, 320))
        first = self.features(image[:240, :300])
        second = self.features(np.clip(image[12:252, 8:308] * 0.8 + 30, 0, 255).astype(np.uint8))
        a, b = (
            (np.unpackbits(f.descriptors, axis=1) if self.kind == DescriptorKind.BINARY else f.descriptors).astype(
                float
            )
            for f in (first, second)
        )
        table = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
        mutual = np.flatnonzero(table.argmin(0)[table.argmin(1)] == np.arange(len(a)))
        shift = first.points2D[mutual] - second.points2D[table.argmin(1)[mutual]]
        right = np.linalg.norm(shift - [8, 12], axis=1) < 2
        assert right.sum() > 60
        assert right.mean() > 0.75


class TestSift(Contract):
    options: ClassVar[dict[str, Any]] = {"kind": "sift"}
    kind, descriptor_bytes, sees = DescriptorKind.SIFT, 128, "spots"


class TestOrb(Contract):
    options: ClassVar[dict[str, Any]] = {"kind": "orb"}
    finds, bias_px = 0.7, 0.2  # whole pixels on each level: an error of σ = 1.2 px


class TestAkaze(Contract):
    options: ClassVar[dict[str, Any]] = {"kind": "akaze"}
    descriptor_bytes, sees = 61, "spots"


class TestBrisk(Contract):
    options: ClassVar[dict[str, Any]] = {"kind": "brisk"}
    descriptor_bytes, sees, finds, bias_px = 64, "spots", 0.6, 0.1  # it looks for corners; a spot is hardly one

    def test_upright_features_have_no_orientation_and_each_place_and_scale_once(self):
        with pytest.raises(ConfigError, match="brisk"):
            FeatureConfig(kind="brisk", upright=True)


class TestHarris(Contract):
    options: ClassVar[dict[str, Any]] = {"kind": "harris"}
    turns = False


class TestShiTomasi(Contract):
    options: ClassVar[dict[str, Any]] = {"kind": "shi_tomasi"}
    turns = False


class TestFast(Contract):
    options: ClassVar[dict[str, Any]] = {"kind": "fast"}
    turns = False


class TestFastWithFreak(Contract):
    options: ClassVar[dict[str, Any]] = {"kind": "fast", "corner_descriptor": "freak"}
    descriptor_bytes = 64


class TestSiftSpreadEvenly(Contract):
    options: ClassVar[dict[str, Any]] = {"kind": "sift", "spreading": "even"}
    kind, descriptor_bytes, sees = DescriptorKind.SIFT, 128, "spots"


class TestSiftInTiltedViews(Contract):
    options: ClassVar[dict[str, Any]] = {"kind": "sift", "affine_tilts": 1}
    kind, descriptor_bytes, sees = DescriptorKind.SIFT, 128, "spots"


def patchy(seed: int) -> np.ndarray:
    """Strong texture on the left, and the same at a quarter of its contrast on the right."""
    image = texture(seed, (240, 480)).astype(float) - 128
    image[:, 240:] *= 0.25
    return np.clip(np.rint(128 + image), 0, 255).astype(np.uint8)


def test_even_spreading_gives_weak_parts_of_an_image_their_share():
    def weak_share(spreading: str) -> float:
        features = extract_features(patchy(11), FeatureConfig(max_features=200, spreading=spreading))
        assert len(features) == 200
        return float((features.points2D[:, 0] > 240).mean())

    assert weak_share("strongest") < 0.15
    assert 0.3 < weak_share("even") < 0.65


@pytest.mark.parametrize("kind", ["sift", "orb", "akaze", "shi_tomasi"])
def test_an_image_with_few_features_is_searched_again_with_less_contrast(kind):
    flat = np.clip(np.rint(128 + 0.06 * (texture(12).astype(float) - 128)), 0, 255).astype(np.uint8)
    once = extract_features(flat, FeatureConfig(kind=kind, min_features=0))
    again = extract_features(flat, FeatureConfig(kind=kind, min_features=80))
    assert len(again) > max(60, 1.5 * (len(once) if isinstance(once, Features) else 0))


def test_a_cap_below_the_wanted_number_is_no_lack_of_features():
    found = extract(texture(14), FeatureConfig(max_features=50, min_features=500))
    assert isinstance(found, Extraction)
    assert found.contrast_threshold == FeatureConfig().contrast_threshold


def test_features_of_tilted_views_match_a_wall_seen_from_aside():
    """A wall seen at 73° from its normal: three and a half times shorter."""
    wall = texture(13, (400, 600))
    squeeze = np.array([[1 / 3.5, 0, 0], [0, 1, 0]])
    blurred = cv2.GaussianBlur(wall, (0, 0), 0.8 * np.sqrt(3.5**2 - 1), sigmaY=0.01)
    aside = cv2.warpAffine(blurred, squeeze, (172, 400))

    def right_matches(tilts: int) -> int:
        config = FeatureConfig(affine_tilts=tilts, max_features=6000)
        first, second = (extract_features(picture, config) for picture in (wall, aside))
        a, b = (f.descriptors.astype(np.float32) for f in (first, second))
        table = (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T
        mutual = np.flatnonzero(table.argmin(0)[table.argmin(1)] == np.arange(len(a)))
        there = first.points2D[mutual] * [1 / 3.5, 1]
        return int((np.linalg.norm(there - second.points2D[table.argmin(1)[mutual]], axis=1) < 2).sum())

    plain, tilted = right_matches(0), right_matches(3)
    assert tilted > 3 * plain
    assert tilted > 300


@pytest.mark.parametrize("options", [{"contrast_threshold": 0.0}, {"affine_tilts": 9}, {"min_features": -1}])
def test_settings_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match="must"):
        FeatureConfig(**options)


def test_a_mask_of_another_size_is_a_mistake_of_the_caller():
    with pytest.raises(ValueError, match=r"\(200, 260\)"):
        extract_features(texture(1), FeatureConfig(), np.ones((260, 200), np.bool_))
