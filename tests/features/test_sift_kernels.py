from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import pytest

from sfm.core.scene import Features
from sfm.features import FeatureConfig, extract_features
from sfm.features import _sift_kernels as kernels
from sfm.features.scale_space import blur_of, octaves

BORDER = 5


def noise(seed: int, height: int = 90, width: int = 121) -> np.ndarray:
    """Blobs of many sizes, uint8."""
    rng = np.random.default_rng(seed)
    blobs = [s * cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), s) for s in (1.2, 2.4, 5.0)]
    image = np.sum(blobs, axis=0)
    return (255 * (image - image.min()) / np.ptp(image)).astype(np.uint8)


def stack_of(seed: int) -> np.ndarray:
    return next(octaves(noise(seed), 3, doubled=False))


def extrema_twin(stack: np.ndarray, threshold: float) -> set[tuple[int, int, int]]:
    differences = np.diff(stack, axis=0)
    layers, height, width = differences.shape
    found = set()
    inner = itertools.product(range(1, layers - 1), range(BORDER, height - BORDER), range(BORDER, width - BORDER))
    for k, y, x in inner:
        value, cube = differences[k, y, x], differences[k - 1 : k + 2, y - 1 : y + 2, x - 1 : x + 2]
        if (value > threshold and value == cube.max()) or (value < -threshold and value == cube.min()):
            found.add((k, y, x))
    return found


def found_extrema(stack: np.ndarray, threshold: float = 1.0) -> np.ndarray:
    found = np.empty((5000, 3), np.int32)
    return found[: kernels.find_extrema(stack, np.float32(threshold), BORDER, found)]


def refined_extrema(stack: np.ndarray) -> np.ndarray:
    found = found_extrema(stack)
    columns = np.empty((len(found), 4))
    return columns[: kernels.refine_extrema(stack, found, len(found), 1.0, 10.0, BORDER, columns)]


def test_extrema_are_the_largest_and_smallest_of_their_27():
    stack = stack_of(0)
    found = found_extrema(stack)
    assert len(found) > 30
    assert {tuple(row) for row in found.tolist()} == extrema_twin(stack, 1.0)


def test_extrema_beyond_the_room_are_counted():
    stack, little = stack_of(0), np.empty((3, 3), np.int32)
    assert kernels.find_extrema(stack, np.float32(1), BORDER, little) == len(found_extrema(stack))


def test_refinement_finds_the_vertex_of_a_quadratic():
    vertex, curvature = np.array([2.2, 21.7, 30.4]), np.array([0.5, 0.3, 0.2])  # layer, y, x
    k, y, x = np.meshgrid(np.arange(5), np.arange(44), np.arange(60), indexing="ij")
    cross = 0.05 * (y - vertex[1]) * (x - vertex[2])
    squares = sum(c * (a - v) ** 2 for c, a, v in zip(curvature, (k, y, x), vertex, strict=True))
    stack = np.concatenate([np.zeros((1, 44, 60)), np.cumsum(9 - squares - cross, axis=0)]).astype(np.float64)
    columns = np.empty((1, 4))
    start = np.array([[2, 20, 32]], np.int32)
    assert kernels.refine_extrema(stack, start, 1, 1.0, 10.0, BORDER, columns) == 1
    assert columns[0] == pytest.approx([vertex[2], vertex[1], vertex[0], 9], abs=1e-6)


def test_an_edge_is_no_keypoint():
    y, x = np.mgrid[:44, :60]
    ridge = 9 - 0.5 * (x - 30) ** 2 - 0.001 * (y - 20) ** 2
    stack = np.concatenate([[np.zeros((44, 60))], np.cumsum([ridge - 0.5 * (k - 2) ** 2 for k in range(5)], axis=0)])
    columns = np.empty((1, 4))
    assert kernels.refine_extrema(stack, np.array([[2, 20, 30]], np.int32), 1, 1.0, 10.0, BORDER, columns) == 0


def polar_twin(image: np.ndarray, y: int, x: int) -> tuple[float, float]:
    gx, gy = image[y, x + 1] - image[y, x - 1], image[y + 1, x] - image[y - 1, x]
    return math.hypot(gx, gy), math.atan2(gy, gx)


def orientation_twin(image: np.ndarray, x: float, y: float, sigma: float) -> list[float]:
    histogram, radius = np.zeros(36), round(4.5 * sigma)
    for v in range(round(y) - radius, round(y) + radius + 1):
        for u in range(round(x) - radius, round(x) + radius + 1):
            if 1 <= v < image.shape[0] - 1 and 1 <= u < image.shape[1] - 1:
                size, angle = polar_twin(image, v, u)
                weight = math.exp(-((v - round(y)) ** 2 + (u - round(x)) ** 2) / (2 * (1.5 * sigma) ** 2))
                histogram[round(angle / (2 * math.pi) * 36) % 36] += weight * size
    weighted = [w * np.roll(histogram, shift) for shift, w in zip((-2, -1, 0, 1, 2), (1, 4, 6, 4, 1), strict=True)]
    smooth = np.sum(weighted, axis=0)
    angles = []
    for b in range(36):
        before, here, after = smooth[b - 1], smooth[b], smooth[(b + 1) % 36]
        if here > max(before, after) and here >= 0.8 * smooth.max():
            angles.append((b + 0.5 * (before - after) / (before + after - 2 * here)) * math.tau / 36)
    return angles[:4]


def test_orientations_are_the_peaks_of_the_histogram_of_gradients():
    stack = stack_of(1)
    keypoints = refined_extrema(stack)
    scales, angles = blur_of(keypoints[:, 2], 3), np.empty((len(keypoints), 4))
    kernels.orientations(stack, keypoints, scales, angles)
    same = 0
    for (x, y, layer, _), sigma, row in zip(keypoints, scales, angles, strict=True):
        expected = orientation_twin(stack[round(layer)], x, y, sigma)
        got = row[~np.isnan(row)]
        same += len(got) == len(expected) and np.allclose(got, expected, atol=2e-3)
    assert len(keypoints) > 30
    # A gradient on the border of two bins, or a peak at 0.8 of the highest, may fall to either side.
    assert same > 0.9 * len(keypoints)


def descriptor_twin(image: np.ndarray, x: float, y: float, sigma: float, angle: float) -> np.ndarray:
    """The same sums, sample by sample; y points up in directions, as in OpenCV's layout."""
    table = np.zeros((6, 6, 8))
    places = (np.arange(20) + 0.5) / 4 - 2.5
    for r, c in itertools.product(places, places):
        u = x + 3 * sigma * (c * math.cos(angle) - r * math.sin(angle))
        v = y + 3 * sigma * (c * math.sin(angle) + r * math.cos(angle))
        u = min(max(math.floor(u + 0.5), 1), image.shape[1] - 2)
        v = min(max(math.floor(v + 0.5), 1), image.shape[0] - 2)
        size, direction = polar_twin(image, v, u)
        direction = (angle - direction) % math.tau / math.tau * 8
        size *= math.exp(-(r * r + c * c) / 8)
        cells = r + 2.5, c + 2.5, direction
        for i, j, k in itertools.product((0, 1), repeat=3):
            share = math.prod(f if s else 1 - f for s, f in zip((i, j, k), (p % 1 for p in cells), strict=True))
            table[int(cells[0]) + i, int(cells[1]) + j, (int(direction) + k) % 8] += share * size
    return table[1:5, 1:5].ravel()


def test_descriptors_are_histograms_of_gradients_in_the_frame_of_the_keypoint():
    stack = stack_of(2)
    keypoints = refined_extrema(stack)[:40]
    scales, angles = blur_of(keypoints[:, 2], 3), np.linspace(-7, 7, len(keypoints))
    histograms = np.empty((len(keypoints), 128), np.float32)
    kernels.describe(stack, keypoints, scales, angles, histograms)
    for (x, y, layer, _), sigma, angle, row in zip(keypoints, scales, angles, histograms, strict=True):
        expected = descriptor_twin(stack[round(layer)], x, y, sigma, angle)
        assert np.linalg.norm(row - expected) < 0.02 * np.linalg.norm(expected)


def test_keypoints_and_descriptors_are_those_of_opencv():
    """But for some near the threshold of contrast, which theirs compares in another place."""
    image = noise(3, 480, 640)
    ours = extract_features(image, FeatureConfig())
    assert isinstance(ours, Features)
    detector = cv2.SIFT.create(contrastThreshold=0.02, enable_precise_upscale=True)
    theirs, histograms = detector.detectAndCompute(image, None)
    table = np.array([(k.pt[0] + 0.5, k.pt[1] + 0.5, k.size / 2, math.radians(k.angle)) for k in theirs])
    gaps = np.linalg.norm(ours.points2D[:, None] - table[:, :2], axis=2) + 10 * np.abs(
        np.log(ours.scales[:, None] / table[:, 2])
    )
    turns = np.abs(np.angle(np.exp(1j * (ours.orientations[:, None] - table[:, 3]))))
    same = (gaps < 0.5) & (turns < 0.1)
    coarse = ours.scales > 2.4
    assert coarse.sum() > 300
    assert same[coarse].any(axis=1).mean() > 0.85
    rows = np.flatnonzero(same.any(axis=1))
    a = ours.descriptors[rows].astype(np.float64) ** 2
    b = histograms[same[rows].argmax(axis=1)].astype(np.float64)
    cosines = np.sum(a * b, 1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    assert np.median(cosines) > 0.98


@pytest.mark.parametrize("options", [{}, {"first_octave": "full"}, {"first_octave": "doubled", "max_image_size": 400}])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.25, -0.4), (3.5, 2.75)])
def test_a_shifted_scene_gives_shifted_keypoints_without_bias(options, shift):
    """Both photos are means over the pixels of a scene 8 times finer, so that the shift is exact."""
    rng = np.random.default_rng(4)
    height, width, fine = 400, 500, 8
    size = 540 * fine, 440 * fine
    blobs = [
        s * cv2.resize(rng.normal(size=(440 // s, 540 // s)), size, interpolation=cv2.INTER_CUBIC) for s in (3, 6, 12)
    ]
    scene = np.sum(blobs, axis=0).astype(np.float32)
    scene = 255 * (scene - scene.min()) / np.ptp(scene)

    def photo(x: float, y: float) -> np.ndarray:
        left, top = round((10 + x) * fine), round((10 + y) * fine)
        part = scene[top : top + height * fine, left : left + width * fine]
        return np.rint(part.reshape(height, fine, width, fine).mean((1, 3))).astype(np.uint8)

    exact = tuple(round(s * fine) / fine for s in shift)
    config = FeatureConfig(**options)
    first, second = extract_features(photo(0, 0), config), extract_features(photo(*exact), config)
    assert isinstance(first, Features)
    assert isinstance(second, Features)
    gaps = first.points2D[:, None] - exact - second.points2D[None]
    nearest = np.argmin(np.linalg.norm(gaps, axis=2), axis=1)
    errors = gaps[np.arange(len(first)), nearest]
    errors = errors[np.linalg.norm(errors, axis=1) < 0.5]
    assert len(errors) > 0.7 * len(first)
    assert np.all(np.abs(np.median(errors, axis=0)) < 0.01)
    assert np.all(np.abs(errors.mean(axis=0)) < 0.02)


def test_a_flat_image_gets_a_lower_threshold():
    flat = (100 + 0.1 * noise(5, 300, 400)).astype(np.uint8)
    few = extract_features(flat, FeatureConfig(min_features=0))
    more = extract_features(flat, FeatureConfig())
    assert isinstance(more, Features)
    assert len(more) > 2 * (len(few) if isinstance(few, Features) else 0) + 50
