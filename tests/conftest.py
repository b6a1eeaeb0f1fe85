"""What every test relies on: signatures are checked at run time, chance is seeded, real data may be absent."""

from __future__ import annotations

import os
import sys
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
