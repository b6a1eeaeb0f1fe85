"""Pairs of photos that deceive: from pixels through features and matches to the kind of their geometry.

The scenes are posters in space (see `posters`). Known cameras have their true focal length; unknown ones a guess that
is a third too long, so that their poses are off by degrees, but never their kind.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache

import cv2
import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Features, PairKind, TwoViewGeometry
from sfm.features import FeatureConfig, extract_features
from sfm.matching import match_features
from sfm.verification import verify_pair
from tests.end_to_end.posters import facing, photo_of, seen_from
from tests.pictures import texture

WIDTH, HEIGHT = 640, 480
KNOWN = Camera("SIMPLE_PINHOLE", WIDTH, HEIGHT, np.array([560.0, 320, 240]), True)
GUESSED = Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([768.0, 320, 240, 0]))
cameras = pytest.mark.parametrize("camera", [KNOWN, GUESSED], ids=["known", "guessed"])

ROOM = (
    facing(texture(1, (900, 1200)), (0, 0, 7), 10),
    facing(texture(2, (400, 300)), (-1.2, 0.3, 5), 1.8, 0.5),
    facing(texture(3, (400, 300)), (1.3, -0.2, 4.2), 1.6, -0.6),
    facing(texture(4, (300, 400)), (0, 1.0, 3.4), 1.6, 0.2),
)
"""Four posters, one behind the others."""
OTHER_ROOM = (facing(texture(9, (900, 1200)), (0, 0, 5), 7), facing(texture(10, (300, 400)), (0.5, 0, 3.5), 1))
WALL = (facing(texture(5, (1000, 1600)), (0, 0, 4), 7),)
TILES = np.tile(texture(6, (120, 120)), (8, 14, 1))

LEFT = seen_from((-0.4, 0, 0), (0.02, -0.05, 0.01))
RIGHT = seen_from((0.4, 0.1, 0.1), (-0.02, 0.06, 0.05))
FAR_LEFT = seen_from((-0.8, 0.1, 0.2), (0.05, -0.12, 0.02))
FAR_RIGHT = seen_from((0.8, -0.2, -0.1), (-0.03, 0.2, -0.03))
TURNED = seen_from((-0.4, 0, 0), (-0.02, 0.25, 0.05))
SOLID = {KNOWN: PairKind.CALIBRATED, GUESSED: PairKind.UNCALIBRATED}


@lru_cache(64)
def features_of(pixels: bytes, shape: tuple[int, ...]) -> Features | Rejected:
    return extract_features(np.frombuffer(pixels, np.uint8).reshape(shape), FeatureConfig())


def verified(
    image1: np.ndarray, image2: np.ndarray, camera1: Camera, camera2: Camera | None = None
) -> TwoViewGeometry | Rejected:
    """What two photos come to; features that are refused count as no matches."""
    features = [features_of(image.tobytes(), image.shape) for image in (image1, image2)]
    for refused in features:
        if isinstance(refused, Rejected):
            return refused
    points1, points2 = (one.points2D for one in features)
    matches = match_features(*features)
    return verify_pair(points1, points2, matches, camera1, camera2 or camera1, rng=np.random.default_rng(0))


def pair(posters, pose1: Rigid3, pose2: Rigid3) -> tuple[np.ndarray, np.ndarray]:
    return photo_of(posters, KNOWN, pose1, seed=1), photo_of(posters, KNOWN, pose2, seed=2)


def errors_deg(found: TwoViewGeometry, pose1: Rigid3, pose2: Rigid3) -> tuple[float, float]:
    """Of the rotation, and of the direction of the translation."""
    truth, pose = pose2 @ pose1.inverse(), found.cam2_from_cam1
    assert pose is not None
    angle = np.degrees(float((pose.rotation @ truth.rotation.inverse()).angle))
    cosine = pose.translation @ truth.translation / np.linalg.norm(truth.translation)
    return angle, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def half_turned(image: np.ndarray, pose: Rigid3) -> tuple[np.ndarray, Rigid3]:
    turn = Rigid3(Rotation3.exp(np.array([0, 0, np.pi])), np.zeros(3))
    return np.ascontiguousarray(image[::-1, ::-1]), turn @ pose


@pytest.fixture(scope="module")
def room():
    """Two photos of the room."""
    return pair(ROOM, LEFT, RIGHT)


@cameras
def test_a_solid_scene_is_what_the_cameras_allow(room, camera):
    found = verified(*room, camera)
    assert found.kind == SOLID[camera]
    angle, direction = errors_deg(found, LEFT, RIGHT)
    bounds = (0.05, 0.2) if camera is KNOWN else (5, 5)
    assert (angle, direction) < bounds
    assert direction < bounds[1]


@cameras
def test_a_photo_that_lies_on_its_head_changes_nothing(room, camera):
    image, pose = half_turned(room[1], RIGHT)
    found, upright = verified(room[0], image, camera), verified(*room, camera)
    assert found.kind == SOLID[camera]
    assert len(found) > 0.95 * len(upright)
    if camera is KNOWN:
        assert max(errors_deg(found, LEFT, pose)) < 0.2


@cameras
@pytest.mark.parametrize("which", [0, 1], ids=["the first", "the second"])
def test_a_photo_four_times_smaller_is_verified(room, camera, which):
    images, both = list(room), [camera, camera]
    images[which] = cv2.resize(images[which], (WIDTH // 4, HEIGHT // 4), interpolation=cv2.INTER_AREA)
    both[which] = camera.scaled(WIDTH // 4, HEIGHT // 4)
    found = verified(*images, *both)
    assert found.kind == SOLID[camera]
    assert len(found) > 25
    if camera is KNOWN:
        assert max(errors_deg(found, LEFT, RIGHT)) < 1


@cameras
def test_one_channel_is_as_good_as_three(room, camera):
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in room]
    plain = verified(*room, camera)
    for images in (grey, (grey[0], room[1])):
        found = verified(*images, camera)
        assert found.kind == SOLID[camera]
        assert found.matches.tolist() == plain.matches.tolist()


@cameras
def test_turning_on_the_spot_is_panoramic_also_under_a_wrong_focal_length(camera):
    found = verified(*pair(ROOM, LEFT, TURNED), camera)
    assert found.kind == PairKind.PANORAMIC
    assert found.tri_angle == 0
    assert found.cam2_from_cam1 is not None
    truth = TURNED @ LEFT.inverse()
    assert np.degrees(float((found.cam2_from_cam1.rotation @ truth.rotation.inverse()).angle)) < 0.1


@cameras
@pytest.mark.parametrize("poses", [(LEFT, RIGHT), (FAR_LEFT, FAR_RIGHT)], ids=["near", "far"])
def test_a_wall_is_planar_and_no_panorama(camera, poses):
    found = verified(*pair(WALL, *poses), camera)
    assert found.kind == PairKind.PLANAR
    if camera is KNOWN:
        assert max(errors_deg(found, *poses)) < 0.2


@cameras
def test_sliding_along_a_wall_is_planar_and_no_panorama(camera):
    """An image that is only shifted: what a rotation of a very long lens would look like."""
    found = verified(*pair(WALL, seen_from((-0.3, 0, 0)), seen_from((0.3, 0, 0))), camera)
    assert found.kind == PairKind.PLANAR


@cameras
@pytest.mark.parametrize("copy", ["bytes", "moment"])
def test_the_same_photo_twice_and_two_moments_of_one_place_are_panoramic(room, camera, copy):
    again = room[0] if copy == "bytes" else photo_of(ROOM, KNOWN, LEFT, seed=7)
    found = verified(room[0], again, camera)
    assert found.kind == PairKind.PANORAMIC
    assert found.cam2_from_cam1 is not None
    assert np.degrees(float(found.cam2_from_cam1.rotation.angle)) < 0.02
    assert len(found) > 1000


@cameras
@pytest.mark.parametrize("noise", [0.0, 2.0, 6.0])
def test_blank_walls_have_nothing_to_match(camera, noise):
    blank = [facing(np.full((100, 100, 3), 180, np.uint8), (0, 0, 4), 20)]
    images = [photo_of(blank, KNOWN, pose, noise=noise, seed=k) for k, pose in enumerate((LEFT, RIGHT))]
    found = verified(*images, camera)
    assert isinstance(found, Rejected)
    assert found.reason in ("no_features", "too_few_matches")


@cameras
def test_photos_of_two_places_are_rejected(room, camera):
    found = verified(room[0], photo_of(OTHER_ROOM, KNOWN, LEFT, seed=3), camera)
    assert isinstance(found, Rejected)
    assert found.reason in ("too_few_matches", "too_few_inliers", "low_inlier_ratio")


@cameras
def test_a_wall_of_small_equal_tiles_is_rejected(camera):
    """Every shift by a tile is as good as the truth; a geometry that picks some would be wrong.

    It is not always noticed: see docs/reconstruct.md for the walls that are taken for something else.
    """
    tiles = np.tile(texture(6, (60, 60)), (16, 28, 1))
    found = verified(*pair([facing(tiles, (0, 0, 4), 7)], FAR_LEFT, FAR_RIGHT), camera)
    assert isinstance(found, Rejected)


@cameras
def test_a_few_pictures_among_equal_tiles_decide(camera):
    tiles = TILES.copy()
    for k in range(6):
        tiles[100 + 100 * k : 150 + 100 * k, 300 + 170 * k : 380 + 170 * k] = texture(30 + k, (50, 80))
    found = verified(*pair([facing(tiles, (0, 0, 4), 7)], FAR_LEFT, FAR_RIGHT), camera)
    assert found.kind == PairKind.PLANAR
    if camera is KNOWN:
        assert max(errors_deg(found, FAR_LEFT, FAR_RIGHT)) < 1


@cameras
def test_things_before_a_wall_of_equal_tiles_decide(camera):
    found = verified(*pair([facing(TILES, (0, 0, 7), 12), *ROOM[1:]], LEFT, RIGHT), camera)
    assert found.kind == SOLID[camera]
    if camera is KNOWN:
        assert max(errors_deg(found, LEFT, RIGHT)) < 0.2


LOGO = texture(77, (70, 200))
places = pytest.mark.parametrize("place", [(400, 430), (10, 10), (200, 210)], ids=["corner", "other corner", "middle"])


def marked(image: np.ndarray, place: tuple[int, int], logo: np.ndarray = LOGO) -> np.ndarray:
    image = image.copy()
    y, x = place
    image[y : y + logo.shape[0], x : x + logo.shape[1]] = logo
    return image


@cameras
@places
def test_one_logo_on_photos_of_two_places_is_a_watermark(room, camera, place):
    other = photo_of(OTHER_ROOM, KNOWN, LEFT, seed=3)
    found = verified(marked(room[0], place), marked(other, place), camera)
    assert found.kind == PairKind.WATERMARK
    assert found.cam2_from_cam1 is None


@cameras
@places
def test_under_a_logo_on_all_photos_the_scene_is_found(room, camera, place):
    found = verified(*(marked(image, place) for image in room), camera)
    assert found.kind == SOLID[camera]
    if camera is KNOWN:
        assert max(errors_deg(found, LEFT, RIGHT)) < 0.2


@cameras
def test_a_logo_with_more_matches_than_the_scene_does_not_hide_it(room, camera):
    """All but a strip of the second photo is covered by something else."""
    second, other = room[1].copy(), photo_of(OTHER_ROOM, KNOWN, LEFT, seed=3)
    second[:, 110:] = other[:, 110:]
    second[:, :50] = 90
    banner = texture(78, (80, 480))
    first, second, other = (marked(image, (400, 150), banner) for image in (room[0], second, other))
    scene, logo = verified(room[0], second, camera), verified(first, other, camera)
    assert 50 < len(scene) < len(logo)
    assert logo.kind == PairKind.WATERMARK
    assert verified(first, second, camera).kind == scene.kind == SOLID[camera]


@cameras
def test_two_moments_of_one_place_under_a_logo_are_no_watermark(room, camera):
    again = photo_of(ROOM, KNOWN, LEFT, seed=7)
    assert verified(marked(room[0], (200, 210)), marked(again, (200, 210)), camera).kind == PairKind.PANORAMIC


def test_the_kinds_do_not_depend_on_the_order_of_the_photos(room):
    for images in (room, pair(WALL, LEFT, RIGHT), pair(ROOM, LEFT, TURNED)):
        for camera in (KNOWN, GUESSED):
            assert verified(*images, camera).kind == verified(*images[::-1], camera).kind


def test_a_focal_length_known_on_one_side_only_is_enough_for_a_panorama():
    images, half_known = pair(ROOM, LEFT, TURNED), dataclasses.replace(GUESSED, params=np.array([560.0, 320, 240, 0]))
    known = dataclasses.replace(half_known, has_prior_focal_length=True)
    assert verified(*images, known, GUESSED).kind == PairKind.PANORAMIC
    assert verified(*images, GUESSED, known).kind == PairKind.PANORAMIC
