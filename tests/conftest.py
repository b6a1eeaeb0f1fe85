"""What every test relies on: signatures are checked at run time, chance is seeded, real data may be absent.

Also here: the commands as processes, and what is made once for all worker processes of a run.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import hypothesis
import jaxtyping
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
PRODUCT = ("sfm", "calib", "stereo")


def _checked_modules() -> list[str]:
    """All modules of the product but the kernels, since the hook cannot wrap what `@njit` compiles.

    Packages are left out: the name of one stands for all that is in it, kernels included. The names are read from
    the folders, since `pkgutil.walk_packages` would import the packages before the hook is there.
    """
    files = [file.relative_to(ROOT) for name in PRODUCT for file in (ROOT / name).rglob("*.py")]
    modules = [".".join(file.with_suffix("").parts) for file in files if file.name != "__init__.py"]
    return sorted(name for name in modules if not name.endswith("_kernels"))


# Modules that were imported before cannot be wrapped any more; then the shape checks would be silently absent.
_EARLY = [name for name in sys.modules if name.split(".")[0] in PRODUCT]
assert not _EARLY, f"imported before the shape checks were installed: {_EARLY}"
jaxtyping.install_import_hook(_checked_modules(), "beartype.beartype")

from sfm.io.kernel_cache import use_kernel_cache  # noqa: E402 - after the hook, before numba

# numba's own cache would not notice when a kernel that another calls has changed; and processes share this one.
use_kernel_cache()

hypothesis.settings.register_profile(
    "parallax", derandomize=True, deadline=None, max_examples=40, database=None, print_blob=False
)
hypothesis.settings.load_profile("parallax")


@pytest.fixture
def rng() -> np.random.Generator:
    """The test's own generator, the same in every run."""
    return np.random.default_rng(0)


def _data_folder() -> Path:
    """The folder of real image sets; skips the test that asks where `PARALLAX_DATA` names none."""
    folder = os.environ.get("PARALLAX_DATA")
    if not folder or not Path(folder).is_dir():
        pytest.skip("PARALLAX_DATA names no folder of real image sets")
    return Path(folder)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real image sets."""
    return _data_folder()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skips a test marked `data` where there is none, before its other fixtures are made."""
    if item.get_closest_marker("data"):
        _data_folder()


@pytest.fixture(scope="session")
def environment() -> dict[str, str]:
    """Of the processes that tests start: this checkout, the kernels of this process, wide lines."""
    return os.environ | {"PYTHONPATH": str(ROOT), "COLUMNS": "200"}


Command = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture
def sfm(environment: dict[str, str], tmp_path: Path) -> Command:
    """`sfm("run", "photos")`: a command as a process in the test's folder; warnings are errors there, too."""

    def run(*words: object, module: str = "sfm") -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-W", "error", "-m", module, *map(str, words)],
            capture_output=True,
            text=True,
            env=environment,
            cwd=tmp_path,
            timeout=300,
        )

    return run


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """`made_once(name, make)`: a folder that `make` fills once in a test run, whichever worker comes first."""
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if os.environ.get("PYTEST_XDIST_WORKER") else base) / "made_once"

    def made(name: str, make: Callable[[Path], None]) -> Path:
        folder, done = shared / name, shared / f"{name}.done"
        shared.mkdir(exist_ok=True)
        with _alone(shared / f"{name}.lock"):
            if not done.exists():
                folder.mkdir(exist_ok=True)
                make(folder)
                done.touch()
        return folder

    return made


@contextlib.contextmanager
def _alone(lock: Path) -> Iterator[None]:
    """Waits until no other process holds `lock`; the system lets go of it even if the holder dies."""
    fcntl = pytest.importorskip("fcntl", reason="file locks of POSIX")
    with lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
