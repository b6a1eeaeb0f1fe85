"""ONNX files written byte by byte: networks whose answer is known.

A protobuf message is a sequence of fields, each a tag (number × 8 + wire type) and a value: wire type 0 is a variable
length integer of seven bits a byte, 2 a length and so many bytes. The numbers of the fields are those of `onnx.proto`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

_FLOAT = 1
_OPSET, _IR = 13, 8


def constant_network(outputs: Mapping[str, np.ndarray], inputs: Mapping[str, int] | None = None) -> bytes:
    """A network whose outputs are constants, each by a node `Constant`.

    The inputs take part by their means, which are multiplied by zero and added to the outputs: what nothing needs
    would be left out.

    Args:
        inputs: number of axes by name; the first axis has length 1. Without it one `image` (1, 3, H, W).
    """
    axes = inputs or {"image": 4}
    nodes, nothing = [_constant("nought", np.zeros((1,), np.float32))], "nought"
    for name, count in axes.items():
        reduced = [_integers("axes", list(range(1, count))), _integer("keepdims", 0)]
        nodes.append(_node("ReduceMean", [name], [f"{name}_mean"], reduced))
        nodes.append(_node("Mul", [f"{name}_mean", nothing], [f"{name}_nothing"], []))
        nothing = f"{name}_nothing"
    for name, values in outputs.items():
        nodes.append(_constant(f"{name}_values", values))
        nodes.append(_node("Add", [f"{name}_values", nothing], [name], []))
    graph = b"".join(_field(1, node) for node in nodes) + _field(2, b"tiny")
    for name, count in axes.items():
        free: list[int | str] = [1, 3, "H", "W"] if count == 4 else [1, *(f"{name}_{k}" for k in range(1, count))]
        graph += _field(11, _value_info(name, free))
    graph += b"".join(_field(12, _value_info(name, list(outputs[name].shape))) for name in outputs)
    return _number(1, _IR) + _field(7, graph) + _field(8, _field(1, b"") + _number(2, _OPSET))


def _varint(value: int) -> bytes:
    parts = []
    while value > 127:
        parts.append(value & 127 | 128)
        value >>= 7
    return bytes([*parts, value])


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _field(field: int, data: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _tensor(values: np.ndarray) -> bytes:
    dims = b"".join(_number(1, n) for n in values.shape)
    return dims + _number(2, _FLOAT) + _field(9, values.astype("<f4").tobytes())


def _node(kind: str, inputs: Sequence[str], outputs: Sequence[str], attributes: Sequence[bytes]) -> bytes:
    data = b"".join(_field(1, name.encode()) for name in inputs)
    data += b"".join(_field(2, name.encode()) for name in outputs)
    data += _field(3, f"{kind}_{outputs[0]}".encode()) + _field(4, kind.encode())
    return data + b"".join(_field(5, attribute) for attribute in attributes)


def _constant(name: str, values: np.ndarray) -> bytes:
    attribute = _field(1, b"value") + _field(5, _tensor(values)) + _number(20, 4)
    return _node("Constant", [], [name], [attribute])


def _integer(name: str, value: int) -> bytes:
    return _field(1, name.encode()) + _number(3, value) + _number(20, 2)


def _integers(name: str, values: Sequence[int]) -> bytes:
    return _field(1, name.encode()) + b"".join(_number(8, value) for value in values) + _number(20, 7)


def _value_info(name: str, shape: Sequence[int | str]) -> bytes:
    dims = b"".join(_field(1, _number(1, n) if isinstance(n, int) else _field(2, n.encode())) for n in shape)
    kind = _number(1, _FLOAT) + _field(2, dims)
    return _field(1, name.encode()) + _field(2, _field(1, kind))
