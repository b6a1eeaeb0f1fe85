from __future__ import annotations

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.features import FeatureConfig
from sfm.pipeline.keys import code_digest, file_digest, key_of


def test_equal_inputs_have_equal_keys_and_others_have_others():
    camera = Camera("PINHOLE", 640, 480, np.array([500.0, 500, 320, 240]))
    moved = Camera("PINHOLE", 640, 480, np.array([500.0, 500, 320, 240.0000001]))
    parts = [
        ["a"],
        ["a", "b"],
        [["a", "b"]],
        ["ab"],
        [1],
        ["1"],
        [1.5],
        [None],
        [FeatureConfig()],
        [FeatureConfig(max_features=10)],
        [camera],
        [moved],
        [np.zeros(3)],
        [np.zeros(3, np.float32)],
        [np.zeros((3, 1))],
        [{"a": 1}],
    ]
    keys = [key_of(*part) for part in parts]
    assert len(set(keys)) == len(parts)
    assert keys == [key_of(*part) for part in parts]
    assert key_of({"a": 1, "b": 2}) == key_of({"b": 2, "a": 1})


def test_what_has_no_content_to_hash_is_refused():
    with pytest.raises(TypeError, match="has no key"):
        key_of(object())


def test_the_code_of_a_package_has_a_digest_of_its_own():
    assert code_digest("sfm.features") == code_digest("sfm.features")
    assert len({code_digest("sfm.features"), code_digest("sfm.matching"), code_digest("sfm.core")}) == 3


def test_the_digest_of_a_file_is_that_of_its_content(tmp_path):
    for name, content in (("a", b"x"), ("b", b"x"), ("c", b"y")):
        (tmp_path / name).write_bytes(content)
    assert file_digest(tmp_path / "a") == file_digest(tmp_path / "b") != file_digest(tmp_path / "c")
