from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from sfm.core.errors import FormatError, InputError
from sfm.io.colmap_model import read_model, write_model
from sfm.io.convert import convert
from sfm.io.ply import read_ply


def test_binary_to_text_and_back_gives_the_same_bytes(tmp_path: Path, rig_model: Path) -> None:
    assert convert(rig_model / "bin", tmp_path / "txt") == "txt"
    assert convert(tmp_path / "txt", tmp_path / "bin") == "bin"
    for name in os.listdir(rig_model / "bin"):
        assert (tmp_path / "bin" / name).read_bytes() == (rig_model / "bin" / name).read_bytes()


def test_the_format_can_be_asked_for(tmp_path: Path, make_reconstruction) -> None:
    write_model(make_reconstruction(), tmp_path / "a")
    assert convert(tmp_path / "a", tmp_path / "b", text=False) == "bin"
    assert convert(tmp_path / "a", tmp_path / "c", text=True) == "txt"


def test_a_model_becomes_a_point_cloud(tmp_path: Path, make_reconstruction) -> None:
    model = make_reconstruction()
    write_model(model, tmp_path / "a")
    assert convert(tmp_path / "a", tmp_path / "deep" / "points.PLY") == "ply"
    points, colors = read_ply(tmp_path / "deep" / "points.PLY")
    np.testing.assert_array_equal(points, model.points3D.astype(np.float32))
    np.testing.assert_array_equal(colors, model.colors)


def test_nothing_is_overwritten_unasked(tmp_path: Path, make_reconstruction, assert_same_model) -> None:
    old, new = make_reconstruction(seed=1), make_reconstruction(seed=2)
    write_model(old, tmp_path / "old")
    write_model(new, tmp_path / "new")
    (tmp_path / "x.ply").touch()
    for target in ("old", "x.ply"):
        with pytest.raises(InputError, match="is there already"):
            convert(tmp_path / "new", tmp_path / target)
    assert_same_model(read_model(tmp_path / "old"), old)
    convert(tmp_path / "new", tmp_path / "old", overwrite=True)
    assert_same_model(read_model(tmp_path / "old"), new)
    assert convert(tmp_path / "new", tmp_path / "x.ply", overwrite=True) == "ply"


def test_what_cannot_be_converted_is_named(tmp_path: Path, make_reconstruction) -> None:
    write_model(make_reconstruction(), tmp_path / "a")
    with pytest.raises(InputError, match="both source and target"):
        convert(tmp_path / "a", tmp_path / "." / "a")
    with pytest.raises(InputError, match="has no cameras"):
        convert(tmp_path / "points.ply", tmp_path / "b")
    with pytest.raises(InputError, match="no COLMAP model"):
        convert(tmp_path / "missing", tmp_path / "b")
    (tmp_path / "a" / "images.bin").write_bytes(b"")
    with pytest.raises(FormatError, match=r"images\.bin"):
        convert(tmp_path / "a", tmp_path / "b")
    assert os.listdir(tmp_path) == ["a"]
