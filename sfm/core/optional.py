"""Optional dependencies: the one place that knows how to import Open3D and CHOLMOD."""

from __future__ import annotations

import ctypes
import importlib
import sys
import warnings
from types import ModuleType

from sfm.core.errors import MissingDependencyError

_LIBUSB = "libusb-1.0.so.0"


def import_open3d() -> ModuleType:
    """The module `open3d`, with its shared libraries in place.

    On Linux its wheel is linked against libusb, which a bare system lacks; the package `libusb-package` carries a
    copy that serves once it is loaded into the global symbol table. Warnings that the import itself raises belong
    to Open3D's dependencies and are dropped; filters are as before when this returns.

    Raises:
        MissingDependencyError: Open3D is not installed, or one of its libraries is missing.
    """
    if "open3d" in sys.modules:
        return sys.modules["open3d"]
    try:
        if sys.platform.startswith("linux"):
            _load_libusb()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import open3d
    except (ImportError, OSError) as error:
        raise MissingDependencyError(
            f"Open3D cannot be imported ({error})", remedy="pip install 'parallax[dense]'"
        ) from error
    return open3d


def import_cholmod() -> ModuleType:
    """The module `sksparse.cholmod` of scikit-sparse 0.4; that of 0.5 has another interface.

    Raises:
        MissingDependencyError: it is not installed, or one of its libraries is missing.
    """
    try:
        cholmod = importlib.import_module("sksparse.cholmod")
    except ImportError as error:
        raise MissingDependencyError(
            f"CHOLMOD cannot be imported ({error})", remedy="pip install 'scikit-sparse<0.5', which needs SuiteSparse"
        ) from error
    if not hasattr(cholmod, "analyze"):
        raise MissingDependencyError(
            "the scikit-sparse that is installed has another interface to CHOLMOD than that of 0.4",
            remedy="pip install 'scikit-sparse<0.5'",
        )
    return cholmod


def _load_libusb() -> None:
    """Makes libusb's symbols available, from the system where it has them."""
    try:
        ctypes.CDLL(_LIBUSB, mode=ctypes.RTLD_GLOBAL)
    except OSError:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
