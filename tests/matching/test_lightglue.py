from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sfm.core.errors import ConfigError
from sfm.core.scene import DescriptorKind, Features
from sfm.matching import lightglue
from sfm.matching.lightglue import LightGlue
from tests.features.onnx_files import constant_network

INPUTS = {"kpts0": 3, "kpts1": 3, "desc0": 3, "desc1": 3}
SIZE = (640, 480)


def features(count: int, kind: DescriptorKind = DescriptorKind.LEARNED) -> Features:
    rng = np.random.default_rng(count)
    zeros = np.zeros(count, np.float32)
    return Features(rng.uniform(0, 480, (count, 2)), zeros, zeros, rng.integers(0, 255, (count, 64), np.uint8), kind)


def network(path: Path, **outputs: np.ndarray) -> LightGlue:
    path.write_bytes(constant_network(outputs, INPUTS))
    return LightGlue(path)


def test_pairs_of_the_network_become_matches_each_feature_once(tmp_path):
    pairs = np.array([[3, 1], [0, 2], [3, 4], [1, 2], [2, 9], [-1, 0]], np.float32)
    scores = np.array([0.9, 0.5, 0.95, 0.6, 0.9, 0.9], np.float32)
    net = network(tmp_path / "lg.onnx", matches0=pairs, mscores0=scores)
    # (2, 9) and (−1, 0) are no features; of two for one the better score wins.
    assert net.match(features(5), features(6), SIZE, SIZE).indices.tolist() == [[1, 2], [3, 4]]
    assert net.match(features(5), features(6), SIZE, SIZE, 0.7).indices.tolist() == [[3, 4]]
    assert len(net.match(features(0), features(6), SIZE, SIZE)) == 0


def test_the_network_gets_places_from_the_middle_and_unit_descriptors():
    zeros = np.zeros(2, np.float32)
    rows = np.full((2, 4), 128, np.uint8)
    rows[0, 0], rows[1, 3] = 255, 0
    given = Features(np.array([[0.5, 0.5], [320.5, 240.5]]), zeros, zeros, rows, DescriptorKind.LEARNED)
    points, descriptors = lightglue._normalised(given, SIZE)
    np.testing.assert_allclose(points, [[[-1, -0.75], [0, 0]]])
    np.testing.assert_allclose(descriptors[0], [[127 / 256, 0, 0, 0], [0, 0, 0, -0.5]])


@pytest.mark.parametrize("content", [None, b"", b"nonsense"])
def test_a_missing_or_bad_file_is_a_mistake_in_words(tmp_path, content):
    path = tmp_path / "lg.onnx"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"cannot be read|no network") as error:
        LightGlue(path)
    assert str(path) in str(error.value)


def test_a_network_for_something_else_is_refused(tmp_path):
    net = network(tmp_path / "lg.onnx", logits=np.zeros(7, np.float32))
    with pytest.raises(ConfigError, match="the network answers with logits"):
        net.match(features(5), features(6), SIZE, SIZE)
    other = tmp_path / "other.onnx"
    other.write_bytes(constant_network({"logits": np.zeros(7, np.float32)}))
    with pytest.raises(ConfigError, match="does not take these features"):
        LightGlue(other).match(features(5), features(6), SIZE, SIZE)


def test_other_features_are_a_mistake_of_the_caller(tmp_path):
    net = network(tmp_path / "lg.onnx", matches0=np.zeros((1, 2), np.float32), mscores0=np.ones(1, np.float32))
    with pytest.raises(ValueError, match="got SIFT"):
        net.match(features(5), features(6, DescriptorKind.SIFT), SIZE, SIZE)
