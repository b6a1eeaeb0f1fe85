"""Point clouds as PLY (Stanford polygon format): x y z float32 and red green blue uint8, binary little-endian.

Written so because every viewer and trainer reads it. Read are ASCII and both byte orders, any numeric types, and files
with further properties or elements, which are passed over.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from sfm.core.arrays import Points3D
from sfm.core.errors import FormatError
from sfm.io.atomic import os_errors, write_chunks

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_POSITION, _COLOR = ("x", "y", "z"), ("red", "green", "blue")
_MAX_HEADER = 1 << 16


@dataclasses.dataclass(slots=True)
class _Element:
    """An element of the header: how many records of which properties; `has_list` if their length varies."""

    name: str
    count: int
    properties: list[tuple[str, str]]
    has_list: bool = False


def write_ply(path: Path | str, points3D: Points3D, colors: UInt8[np.ndarray, "M 3"] | None = None) -> None:
    """Writes a point cloud; positions are rounded to float32.

    Raises:
        ValueError: points and colours differ in number.
        InputError: the system refuses.
    """
    if colors is not None and len(colors) != len(points3D):
        raise ValueError(f"{len(points3D)} points but {len(colors)} colours")
    fields = [(name, "<f4") for name in _POSITION] + [(name, "u1") for name in _COLOR if colors is not None]
    records = np.empty(len(points3D), fields)
    for k, name in enumerate(_POSITION):
        records[name] = points3D[:, k]
    if colors is not None:
        for k, name in enumerate(_COLOR):
            records[name] = colors[:, k]
    properties = [f"property {'uchar' if kind == 'u1' else 'float'} {name}" for name, kind in fields]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(records)}", *properties, "end_header", ""]
    write_chunks(Path(path), ["\n".join(lines).encode(), records])


def read_ply(path: Path | str) -> tuple[Points3D, UInt8[np.ndarray, "N 3"] | None]:
    """The points of a PLY file, and their colours if it has any.

    Raises:
        InputError: the file cannot be opened.
        FormatError: it is no PLY, is cut short, or has no vertices with x, y and z.
    """
    path = Path(path)
    with os_errors(path):
        data = path.read_bytes()
    order, elements, start = _header(data, path)
    records = _vertices(data, start, order, elements, path)
    names = records.dtype.names or ()
    if not set(_POSITION) <= set(names):
        raise FormatError("its vertices have no x, y and z", path=path)
    points = np.stack([records[name] for name in _POSITION], -1).astype(np.float64)
    if not set(_COLOR) <= set(names):
        return points, None
    return points, np.stack([records[name] for name in _COLOR], -1).astype(np.uint8)


def _header(data: bytes, path: Path) -> tuple[str, list[_Element], int]:
    end = data.find(b"end_header", 0, _MAX_HEADER)
    stop = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or not stop:
        raise FormatError("is no PLY file", path=path)
    order, elements = None, []
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        try:
            match line.split():
                case ["format", kind, _]:
                    order = _ORDERS[kind]
                case ["element", name, count]:
                    elements.append(_Element(name, int(count), []))
                case ["property", "list", *_]:
                    elements[-1].has_list = True
                case ["property", kind, name]:
                    elements[-1].properties.append((name, _TYPES[kind]))
        except (KeyError, ValueError, IndexError):
            raise FormatError(f"has a header line that makes no sense: {line[:60]!r}", path=path) from None
    if order is None:
        raise FormatError("names no format", path=path)
    return order, elements, stop


def _vertices(data: bytes, start: int, order: str, elements: list[_Element], path: Path) -> np.ndarray:
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise FormatError("has no vertices", path=path)
    before, vertex = elements[: names.index("vertex")], elements[names.index("vertex")]
    if vertex.has_list or any(element.has_list for element in before):
        raise FormatError("has lists in or before its vertices, which are not supported", path=path)
    try:
        dtype = np.dtype([(name, order + kind) for name, kind in vertex.properties])
        if order:
            skipped = sum(e.count * np.dtype([(n, k) for n, k in e.properties]).itemsize for e in before)
            return np.frombuffer(data, dtype, vertex.count, start + skipped)
        return _ascii_vertices(data[start:], sum(e.count for e in before), vertex, dtype)
    except (ValueError, TypeError, IndexError) as error:
        raise FormatError(f"is cut short or damaged: {error}", path=path) from error


def _ascii_vertices(body: bytes, skipped: int, vertex: _Element, dtype: np.dtype) -> np.ndarray:
    lines = [line for line in body.decode("latin-1").splitlines() if line.strip()][skipped:][: vertex.count]
    if len(lines) < vertex.count:
        raise ValueError(f"{vertex.count} vertices are announced, {len(lines)} are there")
    values = np.array([line.split() for line in lines], np.float64).reshape(vertex.count, len(vertex.properties))
    records = np.empty(vertex.count, dtype)
    for k, (name, _) in enumerate(vertex.properties):
        records[name] = values[:, k]
    return records
