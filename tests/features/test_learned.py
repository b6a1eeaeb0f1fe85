from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.core.errors import ConfigError
from sfm.core.scene import DescriptorKind, Features
from sfm.features import FeatureConfig, extract_features
from sfm.features.learned import quantized
from tests.features.onnx_files import constant_network

IMAGE = np.full((100, 150), 90, np.uint8)
POINTS = np.array([[10, 20], [149.4, 40.5], [5, 6], [151, 3], [3, 101]], np.float32)
SCORES = np.array([0.9, 0.5, 0.7, 1.0, 1.0], np.float32)
DESCRIPTORS = np.random.default_rng(0).normal(size=(5, 64)).astype(np.float32)


def network(path: Path, batch: bool = True, **outputs: np.ndarray) -> str:
    path.write_bytes(constant_network({k: v[None] if batch else v for k, v in outputs.items()}))
    return str(path)


def features(model: str, image: np.ndarray = IMAGE, **options) -> Features:
    result = extract_features(image, FeatureConfig(kind="aliked", model=model, **options))
    assert isinstance(result, Features)
    return result


@pytest.mark.parametrize("batch", [True, False])
def test_what_the_network_answers_becomes_features_of_the_image(tmp_path, batch):
    model = network(tmp_path / "m.onnx", batch, keypoints=POINTS, scores=SCORES, descriptors=DESCRIPTORS)
    found = features(model)
    assert found.kind == DescriptorKind.LEARNED
    # What lies in the rim that was added is left out; the first pixel's centre moves from 0 to one half.
    np.testing.assert_allclose(found.points2D, POINTS[[2, 0, 1]] + 0.5, atol=1e-5)
    np.testing.assert_array_equal(found.descriptors, quantized(DESCRIPTORS[[2, 0, 1]].astype(float)))


def test_outputs_are_told_by_their_shapes_where_names_say_nothing(tmp_path):
    model = network(tmp_path / "m.onnx", a=DESCRIPTORS, b=SCORES, c=POINTS)
    np.testing.assert_allclose(features(model).points2D, POINTS[[2, 0, 1]] + 0.5, atol=1e-5)


def test_coordinates_from_corner_to_corner_are_of_the_padded_input(tmp_path):
    points = np.array([[-1, -1], [0, 0], [0.5, -0.5]], np.float32)
    model = network(tmp_path / "m.onnx", keypoints=points, scores=SCORES[:3], descriptors=DESCRIPTORS[:3])
    # 150 × 100 px are filled up to 160 × 128.
    np.testing.assert_allclose(features(model).points2D, [[0, 0], [120, 32], [80, 64]], atol=1e-4)


def test_cap_and_reduction_work_as_with_any_detector(tmp_path):
    model = network(tmp_path / "m.onnx", keypoints=POINTS, scores=SCORES, descriptors=DESCRIPTORS)
    np.testing.assert_allclose(features(model, max_features=1).points2D, [[10.5, 20.5]])
    twice = np.full((200, 300), 90, np.uint8)
    found = features(model, twice, max_image_size=150)
    np.testing.assert_allclose(found.points2D, 2 * (POINTS[[2, 0, 1]] + 0.5), atol=1e-4)


def test_bytes_keep_distances_to_a_hundredth():
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(200, 128))
    unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    stored = quantized(rows).astype(float)
    exact, kept = (np.linalg.norm(x[:100] - x[100:], axis=1) for x in (unit, stored / 256))
    np.testing.assert_allclose(kept, exact, rtol=0.01)


@pytest.mark.parametrize(
    ("content", "cause"),
    [(None, "no such file"), (b"", "no network"), (b"not a network", "no network"), (b"\x08\x08", "no network")],
)
def test_a_missing_or_bad_file_is_a_mistake_in_words(tmp_path, content, cause):
    path = tmp_path / "m.onnx"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=cause) as error:
        features(str(path))
    assert str(path) in str(error.value)


def test_a_truncated_network_is_refused(tmp_path):
    path = tmp_path / "m.onnx"
    network(path, keypoints=POINTS, scores=SCORES, descriptors=DESCRIPTORS)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ConfigError, match="no network"):
        features(str(path))


@pytest.mark.parametrize(
    "outputs",
    [
        {"logits": SCORES},
        {"keypoints": POINTS, "scores": SCORES[:2], "descriptors": DESCRIPTORS},
        {"keypoints": POINTS, "scores": SCORES, "descriptors": np.zeros((5, 256), np.float32)},
    ],
)
def test_a_network_for_something_else_is_refused_with_what_it_answers(tmp_path, outputs):
    model = network(tmp_path / "m.onnx", **outputs)
    with pytest.raises(ConfigError, match="the network answers with"):
        features(model)


def test_a_network_must_be_named():
    with pytest.raises(ConfigError, match="aliked needs the file"):
        extract_features(IMAGE, FeatureConfig(kind="aliked"))
