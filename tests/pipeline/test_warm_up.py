from __future__ import annotations

import threading

import pytest

from sfm.core.scene import PairKind
from sfm.io.kernel_cache import is_complete, mark_complete
from sfm.pipeline import warm_up
from sfm.pipeline.warm_up import kernels_compiled_ahead


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path


def _compiled_ahead(monkeypatch, steps, observer, block=lambda: None):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "0")
    monkeypatch.setattr(warm_up, "_steps", lambda calibrated: steps)
    with kernels_compiled_ahead(observer, calibrated=True):
        block()


@pytest.mark.parametrize(("calibrated", "kind"), [(True, PairKind.CALIBRATED), (False, PairKind.UNCALIBRATED)])
def test_the_made_up_scene_leads_through_verification_to_a_model_of_all_its_images(calibrated, kind):
    (geometry,) = warm_up._verified(calibrated, pairs=1).pairs.values()
    assert geometry.kind == kind
    models = warm_up._map(calibrated)
    assert [len(model.image_ids) for model in models] == [6]
    assert 200 < len(models[0].points3D) <= 240


def test_the_kernels_are_announced_once_and_marked_complete(cache, monkeypatch):
    told, taken = [], threading.Event()
    _compiled_ahead(monkeypatch, [taken.set], told.append, block=lambda: taken.wait(10))
    assert taken.is_set()
    assert is_complete(cache)
    assert [event.level for event in told] == ["info"]
    _compiled_ahead(monkeypatch, [pytest.fail], told.append)
    assert len(told) == 1


def test_without_a_folder_of_kernels_nothing_is_compiled_ahead(monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    _compiled_ahead(monkeypatch, [pytest.fail], pytest.fail)


def test_the_thread_ends_with_the_block_and_leaves_out_what_it_has_not_begun(cache, monkeypatch):
    begun, over, order = threading.Event(), threading.Event(), []

    def first():
        begun.set()
        over.wait(10)
        order.append("first")

    def block():
        begun.wait(10)
        threading.Timer(0.2, over.set).start()

    _compiled_ahead(monkeypatch, [first, lambda: order.append("second")], lambda event: None, block)
    assert order == ["first"]
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("warm-up")]


def test_a_failure_on_the_thread_is_told_and_harms_nothing(cache, monkeypatch):
    told, failed = [], threading.Event()

    def fail():
        failed.set()
        raise RuntimeError("no memory")

    _compiled_ahead(monkeypatch, [fail], told.append, block=lambda: failed.wait(10))
    assert told[-1].level == "warning"
    assert "no memory" in told[-1].message
    assert not is_complete(cache)


def test_a_run_that_fails_leaves_the_kernels_to_the_next(cache, monkeypatch):
    def block():
        raise ValueError("bad photo")

    with pytest.raises(ValueError, match="bad photo"):
        _compiled_ahead(monkeypatch, [], lambda event: None, block)
    assert not is_complete(cache)
    mark_complete(cache)
    assert is_complete(cache)
