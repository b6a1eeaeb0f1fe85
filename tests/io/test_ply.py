from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sfm.core.errors import FormatError, InputError
from sfm.io.ply import read_ply, write_ply


def header(kind: str, *lines: str) -> bytes:
    return "\n".join(["ply", f"format {kind} 1.0", *lines, "end_header", ""]).encode()


XYZ = ("property float x", "property float y", "property float z")


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_points_and_colours_read_back(tmp_path: Path, rng: np.random.Generator, count: int) -> None:
    points = rng.normal(size=(count, 3)).astype(np.float32).astype(np.float64)
    colors = rng.integers(0, 256, (count, 3), np.uint8)
    write_ply(tmp_path / "ü.ply", points, colors)
    read, read_colors = read_ply(tmp_path / "ü.ply")
    np.testing.assert_array_equal(read, points)
    np.testing.assert_array_equal(read_colors, colors)
    write_ply(tmp_path / "ü.ply", points)
    read, read_colors = read_ply(tmp_path / "ü.ply")
    np.testing.assert_array_equal(read, points)
    assert read_colors is None


def test_pycolmap_reads_what_we_write_and_we_what_it_writes(tmp_path: Path, rng: np.random.Generator) -> None:
    points, colors = rng.normal(size=(50, 3)), rng.integers(0, 256, (50, 3), np.uint8)
    write_ply(tmp_path / "a.ply", points, colors)
    model = pycolmap.Reconstruction()
    model.import_PLY(tmp_path / "a.ply")
    model.export_PLY(tmp_path / "b.ply")
    read, read_colors = read_ply(tmp_path / "b.ply")
    order = np.argsort(read[:, 0]), np.argsort(points[:, 0])
    np.testing.assert_array_equal(read[order[0]], points.astype(np.float32)[order[1]])
    assert read_colors is not None
    np.testing.assert_array_equal(read_colors[order[0]], colors[order[1]])


@pytest.mark.parametrize("order", ["<", ">"])
def test_other_types_properties_and_elements_are_read(tmp_path: Path, rng: np.random.Generator, order: str) -> None:
    fields = [("red", "u1"), ("y", "f8"), ("nx", "f4"), ("x", "f8"), ("green", "u1"), ("blue", "u1"), ("z", "i2")]
    vertices = np.zeros(7, [(name, order + kind) for name, kind in fields])
    for name, _ in fields:
        vertices[name] = rng.integers(0, 200, 7)
    names = {"u1": "uchar", "f8": "double", "f4": "float32", "i2": "short"}
    data = header(
        "binary_little_endian" if order == "<" else "binary_big_endian",
        "comment made by a test",
        "element camera 2",
        "property uint id",
        "element vertex 7",
        *(f"property {names[kind]} {name}" for name, kind in fields),
        "element face 1",
        "property list uchar int vertex_indices",
    )
    (tmp_path / "a.ply").write_bytes(data + bytes(8) + vertices.tobytes() + b"\3" + bytes(12))
    points, colors = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(points, np.stack([vertices[name] for name in "xyz"], -1).astype(float))
    np.testing.assert_array_equal(colors, np.stack([vertices[name] for name in ("red", "green", "blue")], -1))


def test_ascii_is_read(tmp_path: Path) -> None:
    lines = ("element vertex 2", *XYZ, "property uchar red", "property uchar green", "property uchar blue")
    (tmp_path / "a.ply").write_bytes(header("ascii", *lines) + b"1 2 3 4 5 6\n-1e-3 0.5 7 255 0 9\n")
    points, colors = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(points, np.array([[1, 2, 3], [-1e-3, 0.5, 7]], np.float32))
    assert colors is not None
    assert colors.tolist() == [[4, 5, 6], [255, 0, 9]]


@pytest.mark.parametrize(
    ("data", "cause"),
    [
        (b"", "is no PLY"),
        (b"ply\nformat ascii 1.0\n", "is no PLY"),
        (b"\xff\xd8\xff" * 50, "is no PLY"),
        (header("ascii", "element face 0"), "no vertices"),
        (header("ascii", "element vertex 0", *XYZ[:2]), "no x, y and z"),
        (header("binary_middle_endian", "element vertex 0", *XYZ), "makes no sense"),
        (header("ascii", "element vertex many", *XYZ), "makes no sense"),
        (header("ascii", "element vertex 1", "property quaternion q"), "makes no sense"),
        (header("ascii", *XYZ), "makes no sense"),
        (header("ascii", "element vertex 2", *XYZ) + b"1 2 3\n", "cut short"),
        (header("ascii", "element vertex 1", *XYZ) + b"1 2\n", "cut short"),
        (header("ascii", "element vertex 1", *XYZ) + b"1 2 three\n", "cut short"),
        (header("ascii", "element vertex 1", *XYZ, "property list uchar int a") + b"1 2 3 0\n", "lists"),
        (b"ply\nelement vertex 0\nproperty float x\nend_header\n", "names no format"),
    ],
)
def test_what_is_no_sound_ply_is_a_format_error(tmp_path: Path, data: bytes, cause: str) -> None:
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(FormatError, match=rf"a\.ply: .*{cause}"):
        read_ply(tmp_path / "a.ply")


def test_a_ply_cut_anywhere_is_a_format_error(tmp_path: Path, rng: np.random.Generator) -> None:
    write_ply(tmp_path / "a.ply", rng.normal(size=(9, 3)))
    whole = (tmp_path / "a.ply").read_bytes()
    for cut in range(len(whole)):
        (tmp_path / "a.ply").write_bytes(whole[:cut])
        with pytest.raises(FormatError):
            read_ply(tmp_path / "a.ply")


def test_callers_and_users_mistakes(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="2 points but 3 colours"):
        write_ply(tmp_path / "a.ply", np.zeros((2, 3)), np.zeros((3, 3), np.uint8))
    with pytest.raises(InputError, match="no such file"):
        read_ply(tmp_path / "a.ply")
