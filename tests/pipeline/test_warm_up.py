from __future__ import annotations

import subprocess
import sys

import pytest

from sfm.core.scene import PairKind, TwoViewGeometry
from sfm.io.kernel_cache import is_complete
from sfm.pipeline import warm_up
from sfm.pipeline.warm_up import compile_kernels


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "0")
    return tmp_path


@pytest.mark.parametrize(("calibrated", "kind"), [(True, PairKind.CALIBRATED), (False, PairKind.UNCALIBRATED)])
def test_the_made_up_pair_is_verified(calibrated, kind):
    geometry = warm_up._verified(calibrated)
    assert isinstance(geometry, TwoViewGeometry)
    assert geometry.kind == kind


def test_the_made_up_scene_becomes_a_model_of_all_its_images():
    models = warm_up._models()
    assert [len(model.image_ids) for model in models] == [6]
    assert 200 < len(models[0].points3D) <= 240


@pytest.mark.parametrize(
    ("threads", "shares"), [(1, [["pair", "models", "features"]]), (2, [["pair"], ["models"], ["features"]])]
)
def test_kernels_are_announced_compiled_and_marked_once(cache, monkeypatch, threads, shares):
    told, taken = [], []
    monkeypatch.setattr(warm_up, "_in_processes", lambda jobs: taken.append(jobs) or [])
    compile_kernels(told.append, threads=threads)
    compile_kernels(pytest.fail, threads=threads)
    assert taken == [shares]
    assert is_complete(cache)
    assert [event.level for event in told] == ["info", "info"]


def test_without_a_folder_of_kernels_nothing_is_compiled_ahead(monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(warm_up, "_in_processes", pytest.fail)
    compile_kernels(pytest.fail, threads=2)


def test_a_part_that_fails_is_told_with_its_last_words_and_the_kernels_stay_unmarked(cache, monkeypatch):
    told = []
    monkeypatch.setattr(warm_up, "_PARTS", {"no such part": None})
    compile_kernels(told.append, threads=2)
    assert told[-1].level == "warning"
    assert "KeyError: 'no such part'" in told[-1].message
    assert not is_complete(cache)


def test_the_processes_import_what_this_one_would(monkeypatch, tmp_path):
    """Not what lies in the folder that the command was called in."""
    (tmp_path / "numpy.py").write_text("raise RuntimeError('a stranger')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(warm_up, "_COMPILE", "import numpy, sfm; sys_path_is_kept = sfm.__version__")
    assert warm_up._in_processes([["pair"]]) == []


def test_an_interruption_ends_the_processes(monkeypatch):
    started = []

    class Interrupted(subprocess.Popen):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            started.append(self)

        def communicate(self, *args, **kwargs):
            raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", Interrupted)
    monkeypatch.setattr(warm_up, "_COMPILE", "import time; time.sleep(600)")
    with pytest.raises(KeyboardInterrupt):
        warm_up._in_processes([["pair"], ["models"]])
    assert sys.platform == "win32" or [worker.returncode for worker in started] == [-9, -9]


def test_a_process_that_cannot_be_started_is_told_as_a_warning(cache, monkeypatch):
    told = []
    monkeypatch.setattr(sys, "executable", str(cache / "no python"))
    compile_kernels(told.append, threads=2)
    assert told[-1].level == "warning"
    assert not is_complete(cache)
