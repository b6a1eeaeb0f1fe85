from __future__ import annotations

import os
from pathlib import Path

import pytest

from sfm.io import kernel_cache
from sfm.io.kernel_cache import is_complete, kernel_hash, mark_complete, use_kernel_cache


@pytest.fixture(autouse=True)
def no_choice(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.setattr(kernel_cache, "user_cache_folder", lambda: tmp_path / "cache")


def test_the_folder_is_named_by_the_hash_of_the_kernels(tmp_path):
    folder = use_kernel_cache()
    assert folder == tmp_path / "cache" / "kernels" / kernel_hash()
    assert os.environ["NUMBA_CACHE_DIR"] == str(folder)


def test_the_choice_of_the_user_is_respected(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "mine"))
    assert use_kernel_cache() == tmp_path / "mine"


def test_a_folder_that_cannot_be_written_to_is_replaced_by_a_temporary_one(monkeypatch, tmp_path):
    (tmp_path / "cache").write_text("a file where the folder should be")
    monkeypatch.setattr(kernel_cache.tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    folder = use_kernel_cache()
    assert folder.is_relative_to(tmp_path / "temporary")
    assert folder.is_dir()


def test_the_hash_changes_with_a_kernel_in_any_file(monkeypatch, tmp_path):
    class Spec:
        submodule_search_locations = (str(tmp_path / "package"),)

    monkeypatch.setattr(kernel_cache.importlib.util, "find_spec", lambda name: Spec)
    kernels = tmp_path / "package" / "deep" / "_some_kernels.py"
    kernels.parent.mkdir(parents=True)
    hashes = [kernel_hash()]
    for content in ("a = 1", "a = 2"):
        kernels.write_text(content)
        hashes.append(kernel_hash())
    (tmp_path / "package" / "other.py").write_text("no kernels")
    assert len(set(hashes)) == 3
    assert kernel_hash() == hashes[-1]


def test_completion_is_noted_for_these_kernels_only(monkeypatch):
    folder = use_kernel_cache()
    assert not is_complete(folder)
    mark_complete(folder)
    assert is_complete(folder)
    monkeypatch.setattr(kernel_cache, "kernel_hash", lambda: "another")
    assert not is_complete(folder)


def test_noting_completion_where_nothing_can_be_written_does_nothing(tmp_path):
    (tmp_path / "file").write_text("")
    mark_complete(tmp_path / "file" / "folder")
    assert not is_complete(Path(tmp_path / "file" / "folder"))
