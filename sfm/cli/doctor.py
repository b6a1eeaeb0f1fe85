"""`sfm doctor`: what is installed, what is missing and how to get it."""

from __future__ import annotations

import dataclasses
import importlib
import os
import platform
import shutil
import sys
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from sfm import __version__
from sfm.cli.parsing import parsed
from sfm.core.errors import ExitCode
from sfm.core.execution import available_threads

EXAMPLES = ("sfm doctor",)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DoctorOptions:
    """Versions, cores, memory, compiled kernels, and which optional parts are there.

    Exit code 6 if something is missing that every command needs.
    """


@dataclasses.dataclass(frozen=True, slots=True)
class _Package:
    """A dependency: its module, the distributions that bring it, and what it is good for if it is optional."""

    module: str
    distributions: tuple[str, ...]
    serves: str = ""
    extra: str = ""


_PACKAGES = (
    _Package("numpy", ("numpy",)),
    _Package("scipy", ("scipy",)),
    _Package("numba", ("numba",)),
    _Package("cv2", ("opencv-contrib-python-headless", "opencv-contrib-python", "opencv-python-headless")),
    _Package("pycolmap", ("pycolmap", "pycolmap-cuda12")),
    _Package("PIL", ("pillow",)),
    _Package("tyro", ("tyro",)),
    _Package("rich", ("rich",)),
    _Package("jaxtyping", ("jaxtyping",)),
    _Package("rerun", ("rerun-sdk",), "sfm view", "viz"),
    _Package("open3d", ("open3d-cpu", "open3d"), "dense clouds, meshes, rendered scenes", "dense"),
    _Package("trimesh", ("trimesh",), "meshes", "dense"),
    _Package("dask", ("dask",), "several machines", "cluster"),
)


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    parsed(DoctorOptions, "doctor", words, EXAMPLES)
    states = [(package, *_state(package)) for package in _PACKAGES]
    for line in (*_system_lines(), "", *_package_lines(states)):
        print(line)
    broken = [package.distributions[0] for package, _, fault in states if fault and not package.extra]
    if broken:
        print(f"\nmissing: {', '.join(broken)} — pip install --force-reinstall {' '.join(broken)}", file=sys.stderr)
        return ExitCode.MISSING_DEPENDENCY
    print("\nall that `sfm run` needs is there")
    return ExitCode.OK


def _state(package: _Package) -> tuple[str, str]:
    """The version, and what is wrong: it is absent, or does not start."""
    found = next(filter(None, map(_version, package.distributions)), "")
    if package.extra:  # heavy to import, and not needed to go on
        return found, "" if found else "not installed"
    try:
        importlib.import_module(package.module)
    except ImportError as error:
        return found, f"does not start: {error}" if found else "not installed"
    return found or "?", ""


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return ""


def _system_lines() -> Iterator[str]:
    from sfm.io.kernel_cache import is_complete

    disk = shutil.disk_usage(Path.cwd())
    cache = Path(os.environ.get("NUMBA_CACHE_DIR", ""))
    state = "compiled" if is_complete(cache) else "not compiled yet; the first run takes some 20 s longer"
    yield f"parallax   {__version__}"
    yield f"python     {platform.python_version()}  {sys.executable}"
    yield f"system     {platform.platform()}"
    yield f"cores      {available_threads()}"
    yield f"memory     {_memory_text()}"
    yield f"disk       {disk.free / 1e9:.0f} GB free here"
    yield f"kernels    {state}  {cache}"


def _memory_text() -> str:
    from sfm.pipeline.memory import free_memory_bytes, total_memory_bytes

    total, free = total_memory_bytes(), free_memory_bytes()
    return f"{free / 1e9:.1f} GB free of {total / 1e9:.1f} GB" if total and free else "unknown"


def _package_lines(states: Sequence[tuple[_Package, str, str]]) -> Iterator[str]:
    for package, found, fault in states:
        if package.extra:
            hint = f"pip install 'parallax[{package.extra}]'" if fault else ""
            optional = f"optional, for {package.serves}"
            yield f"{package.distributions[0]:<32}{found or '–':<12}{optional}{'; ' + hint if hint else ''}"
        else:
            yield f"{package.distributions[0]:<32}{found or '–':<12}{fault}".rstrip()
