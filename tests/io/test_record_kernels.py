from __future__ import annotations

import numpy as np
import pytest

from sfm.io import _kernels

HEAD, COUNT_AT, ITEM = 11, 3, 4


def records(counts: list[int], rng: np.random.Generator) -> tuple[bytes, list[bytes], list[bytes]]:
    """The twin: the stream, put together record by record."""
    heads, tails = [], []
    for count in counts:
        head = rng.bytes(COUNT_AT) + int(count).to_bytes(8, "little")
        heads.append(head)
        tails.append(rng.bytes(ITEM * count))
    return b"".join(h + t for h, t in zip(heads, tails, strict=True)), heads, tails


@pytest.mark.parametrize("counts", [[], [0], [3], [0, 0, 2, 0], [5, 1, 0, 300]])
def test_records_are_split_and_joined_as_byte_by_byte(counts: list[int], rng: np.random.Generator) -> None:
    stream, heads, tails = records(counts, rng)
    data = np.frombuffer(stream, np.uint8).copy()
    measured = np.empty(len(counts), np.int64)
    assert _kernels.measure_records(data, HEAD, COUNT_AT, ITEM, measured) == len(stream)
    assert measured.tolist() == counts
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    head_bytes, tail_bytes = np.empty((len(counts), HEAD), np.uint8), np.empty(ITEM * offsets[-1], np.uint8)
    _kernels.split_records(data, offsets, ITEM, head_bytes, tail_bytes)
    assert head_bytes.tobytes() == b"".join(heads)
    assert tail_bytes.tobytes() == b"".join(tails)
    joined = np.empty_like(data)
    _kernels.join_records(head_bytes, offsets, ITEM, tail_bytes, joined)
    assert joined.tobytes() == stream


def test_the_record_that_overruns_is_named(rng: np.random.Generator) -> None:
    stream, heads, tails = records([2, 3, 1], rng)
    ends = np.cumsum([len(h) + len(t) for h, t in zip(heads, tails, strict=True)])
    for cut in range(len(stream)):
        end = _kernels.measure_records(
            np.frombuffer(stream[:cut], np.uint8).copy(), HEAD, COUNT_AT, ITEM, np.empty(3, np.int64)
        )
        assert end == -1 - int(np.searchsorted(ends, cut, side="right"))


@pytest.mark.parametrize("count", [2**62, 2**63, 2**64 - 1, 2**61 + 1])
def test_an_absurd_count_does_not_wrap_around(count: int) -> None:
    data = np.frombuffer(bytes(COUNT_AT) + count.to_bytes(8, "little") + bytes(64), np.uint8).copy()
    assert _kernels.measure_records(data, HEAD, COUNT_AT, ITEM, np.empty(1, np.int64)) == -1
