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
from sfm.matching import distinct_features, match_features
from sfm.pipeline.config import PipelineConfig
from sfm.pipeline.single_stages import run_features, run_verification
from sfm.verification import VerificationConfig, verify_pair
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
ALONG_A_ROW = seen_from((-0.6, 0, 0)), seen_from((0.6, 0, 0))
HALF_A_UNIT = seen_from((-0.25, 0, 0)), seen_from((0.25, 0, 0))
SOLID = {KNOWN: PairKind.CALIBRATED, GUESSED: PairKind.UNCALIBRATED}


@lru_cache(64)
def features_of(pixels: bytes, shape: tuple[int, ...]) -> Features | Rejected:
    return extract_features(np.frombuffer(pixels, np.uint8).reshape(shape), FeatureConfig())


@lru_cache(64)
def distinct_of(pixels: bytes, shape: tuple[int, ...]) -> np.ndarray | None:
    features = features_of(pixels, shape)
    return None if isinstance(features, Rejected) else distinct_features(features, shape[1], shape[0])


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
    distinct1, distinct2 = (distinct_of(image.tobytes(), image.shape) for image in (image1, image2))
    both, rng = (points1, points2, matches, camera1, camera2 or camera1), np.random.default_rng(0)
    return verify_pair(*both, distinct1=distinct1, distinct2=distinct2, rng=rng)


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


def tiled(size: int) -> np.ndarray:
    """Equal tiles of `size` px, which are a 240th of the wall's depth each."""
    return np.tile(texture(6, (size, size)), (960 // size, 1680 // size, 1))


def bricks() -> np.ndarray:
    """Equal bricks in running bond: each course is moved by half a brick."""
    brick = texture(11, (40, 100))
    brick[:4] = brick[:, :4] = 205
    courses = [np.roll(np.tile(brick, (1, 17, 1)), 50 * (k % 2), axis=1) for k in range(24)]
    return np.concatenate(courses)


def windows(uneven: float = 0.0) -> np.ndarray:
    """A front of equal windows.

    Args:
        uneven: standard deviation of the stains all over it in grey values.
    """
    bay = np.full((160, 130, 3), 170, np.uint8)
    bay[28:132, 26:104] = 60
    bay[32:128, 30:100] = texture(21, (96, 70)) // 2 + 40
    bay[32:128, 63:66] = 230
    front = np.tile(bay, (6, 13, 1)).astype(float)
    stains = np.random.default_rng(5).normal(size=(48, 104))
    front += uneven * cv2.resize(stains, front.shape[1::-1], interpolation=cv2.INTER_CUBIC)[..., None]
    return np.clip(front, 0, 255).astype(np.uint8)


def wall_of(picture: np.ndarray) -> list:
    return [facing(picture, (0, 0, 4), 7 * picture.shape[1] / 1680)]


def misses_px(
    found: TwoViewGeometry, images: tuple[np.ndarray, np.ndarray], pose1: Rigid3, pose2: Rigid3
) -> np.ndarray:
    """How far from the truth each match is, for a wall at depth 4 in the world."""
    points = [features_of(image.tobytes(), image.shape).points2D for image in images]
    inverse = pose1.inverse()
    rays = inverse.rotation @ KNOWN.unproject(points[0][found.matches[:, 0]])[0]
    center = inverse.translation
    on_wall = center + rays * ((4 - center[2]) / rays[:, 2])[:, None]
    return np.linalg.norm(KNOWN.project(pose2 @ on_wall)[0] - points[1][found.matches[:, 1]], axis=1)


REGULAR = {
    "tiles of 60 px": tiled(60), "tiles of 120 px": tiled(120), "tiles of 200 px": tiled(200),
    "bricks": bricks(), "windows": windows(),
}  # fmt: skip
VIEWS = {
    "near": (LEFT, RIGHT), "far": (FAR_LEFT, FAR_RIGHT), "along a row": ALONG_A_ROW, "half a unit": HALF_A_UNIT,
}  # fmt: skip
DECEIVING = [
    *((f"tiles of {size} px", views) for size in (60, 120, 200) for views in ("near", "far")),
    ("tiles of 120 px", "along a row"), ("tiles of 120 px", "half a unit"), ("tiles of 200 px", "half a unit"),
    ("bricks", "near"), ("bricks", "along a row"), ("windows", "near"), ("windows", "along a row"),
]  # fmt: skip


@cameras
@pytest.mark.parametrize(("wall", "views"), DECEIVING)
def test_a_wall_of_equal_things_is_rejected(camera, wall, views):
    """Every shift by a tile is as good as the truth; a geometry that picks some would be wrong.

    Half a unit is one tile of 120 px exactly, so that the photos hardly differ.
    """
    found = verified(*pair(wall_of(REGULAR[wall]), *VIEWS[views]), camera)
    assert isinstance(found, Rejected)
    assert found.reason == "repeated_texture"


@cameras
@pytest.mark.parametrize("wall", ["tiles of 120 px", "windows"])
def test_a_wall_of_equal_things_is_rejected_in_poor_light_too(camera, wall):
    """Noise makes look-alikes differ, and the ratio test pass."""
    images = [photo_of(wall_of(REGULAR[wall]), KNOWN, pose, noise=8, seed=k) for k, pose in enumerate((LEFT, RIGHT))]
    found = verified(*images, camera)
    assert isinstance(found, Rejected)
    assert found.reason == "repeated_texture"


@cameras
@pytest.mark.parametrize("views", ["near", "far", "along a row"])
def test_a_front_of_equal_windows_with_a_door_and_signs_keeps_its_geometry(camera, views):
    front = windows()
    for k, (x, y) in enumerate([(330, 150), (1150, 120), (700, 420), (300, 650), (1200, 640)]):
        front[y : y + 130, x : x + 100] = texture(50 + k, (130, 100))
    images, poses = pair(wall_of(front), *VIEWS[views]), VIEWS[views]
    found = verified(*images, camera)
    assert found.kind == PairKind.PLANAR
    assert len(found) > 250
    assert np.mean(misses_px(found, images, *poses) > 5) < 0.02
    if camera is KNOWN:
        assert max(errors_deg(found, *poses)) < 0.5


@cameras
def test_windows_that_stains_tell_apart_keep_their_geometry(camera):
    """Nearly all of them look alike, but one homography explains their matches."""
    images = pair(wall_of(windows(uneven=6)), LEFT, RIGHT)
    found = verified(*images, camera)
    assert distinct_of(images[0].tobytes(), images[0].shape) is not None
    assert found.kind == PairKind.PLANAR
    assert np.mean(misses_px(found, images, LEFT, RIGHT) > 5) < 0.02


def test_the_stages_reject_a_wall_of_tiles_and_say_why(tmp_path):
    for k, image in enumerate(pair(wall_of(REGULAR["tiles of 200 px"]), LEFT, RIGHT)):
        (tmp_path / "photos").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "photos" / f"{k}.png"), image)
    run_features(tmp_path / "photos", tmp_path / "ws", threads=1)
    reports = [run_verification(tmp_path / "ws", threads=threads) for threads in (1, 2)]
    for report in reports:
        assert [found.reason for found in report.pairs] == ["repeated_texture"]
    off = PipelineConfig(verification=VerificationConfig(detect_repetition=False))
    assert run_verification(tmp_path / "ws", off, threads=1).pairs[0].inliers > 30


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
