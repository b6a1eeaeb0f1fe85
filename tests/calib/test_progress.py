"""What commands say while they work."""

from __future__ import annotations

import gc

import pytest

from calib.cli.progress import kernels_announced
from sfm.core.events import Event, Note


def fail(collects: list[bool]) -> None:
    collects.append(gc.isenabled())
    raise KeyError


def test_compilation_is_announced_until_a_run_has_come_to_its_end(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    told: list[Event] = []
    collects: list[bool] = []
    with pytest.raises(KeyError), kernels_announced(told.append):
        fail(collects)
    assert [*collects, gc.isenabled()] == [False, True]
    for _ in range(3):
        with kernels_announced(told.append):
            pass
    assert [event.message.startswith("compiling") for event in told if isinstance(event, Note)] == [True, True]
