from __future__ import annotations

import builtins
import ctypes
import sys
import warnings

import pytest

from sfm.core import optional
from sfm.core.errors import ExitCode, MissingDependencyError
from sfm.core.optional import import_open3d


def test_open3d_is_imported_once_and_can_cast_rays():
    open3d = import_open3d()
    assert import_open3d() is open3d
    assert hasattr(open3d.t.geometry, "RaycastingScene")


def test_the_import_leaves_the_warning_filters_alone():
    before = list(warnings.filters)
    import_open3d()
    assert warnings.filters == before


def test_a_missing_open3d_is_a_missing_dependency_with_its_remedy(monkeypatch):
    real = builtins.__import__

    def refuse(name, *arguments, **keywords):
        if name == "open3d":
            raise ImportError("No module named 'open3d'")
        return real(name, *arguments, **keywords)

    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingDependencyError) as error:
        import_open3d()
    assert error.value.exit_code == ExitCode.MISSING_DEPENDENCY
    assert error.value.remedy == "pip install 'parallax[dense]'"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the wheels of other systems need no libusb")
def test_libusb_comes_from_its_package_where_the_system_has_none(monkeypatch):
    loaded = []
    real = ctypes.CDLL

    def load(name, *arguments, **keywords):
        if name == "libusb-1.0.so.0":
            raise OSError("cannot open shared object file")
        loaded.append((str(name), keywords.get("mode")))
        return real(name, *arguments, **keywords)

    monkeypatch.setattr(ctypes, "CDLL", load)
    optional._load_libusb()
    ours = [mode for name, mode in loaded if "libusb" in name]
    assert ctypes.RTLD_GLOBAL in ours
