"""Where the compiled kernels live.

numba keeps machine code beside the sources and renews it when *the kernel's own* file changes: an edit of a function
that it calls in another file goes unnoticed. So the folder is named by a hash of all kernel files and of the versions
that shape the code. The choice must be made before numba is imported; this module imports nothing heavy.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = ("sfm", "calib", "stereo")
_COMPLETE = "complete"


def use_kernel_cache() -> Path:
    """Points numba at this version's folder of compiled kernels, and returns it.

    A `NUMBA_CACHE_DIR` that the user set is respected. Where the user's cache folder cannot be written to, a temporary
    folder that outlives the process does.
    """
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen:
        return Path(chosen)
    name = kernel_hash()
    for parent in (user_cache_folder() / "kernels", Path(tempfile.gettempdir()) / f"parallax-{_user()}" / "kernels"):
        folder = parent / name
        if _is_writable(folder):
            os.environ["NUMBA_CACHE_DIR"] = str(folder)
            return folder
    return Path(__file__).parent  # nothing can be written anywhere: numba's own default


def kernel_hash() -> str:
    """A short name for all kernel sources and their place, with the versions of Python, numba and llvmlite."""
    digest = hashlib.blake2b(digest_size=8)
    digest.update(" ".join([sys.version, *(_version(name) for name in ("numba", "llvmlite", "numpy"))]).encode())
    for package in _PACKAGES:
        spec = importlib.util.find_spec(package)
        for root in (spec.submodule_search_locations or []) if spec else []:
            # numba finds compiled code by the path of its source: that of another copy is of no use here.
            digest.update(os.path.realpath(root).encode())
            for path in sorted(Path(root).rglob("*_kernels.py")):
                digest.update(path.relative_to(root).as_posix().encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


def user_cache_folder() -> Path:
    """The folder of the user in which Parallax may keep what can be computed again."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "parallax"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "parallax"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "parallax"


def is_complete(folder: Path, part: str = _COMPLETE) -> bool:
    """Whether all kernels of a reconstruction, or of another part, are compiled into `folder`."""
    return (folder / f"{part}-{kernel_hash()}").exists()


def mark_complete(folder: Path, part: str = _COMPLETE) -> None:
    """Notes that all these kernels are in `folder`."""
    if _is_writable(folder):
        (folder / f"{part}-{kernel_hash()}").touch()


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"


def _user() -> str:
    return str(os.getuid()) if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
