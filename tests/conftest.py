"""What every test relies on: signatures are checked at run time, chance is seeded, real data may be absent."""

from __future__ import annotations

import os
import pkgutil
import sys
from pathlib import Path

import hypothesis
import jaxtyping
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent


def _checked_modules() -> list[str]:
    """All modules of the product; the hook cannot wrap what `@njit` compiles, hence not the kernels."""
    found = [
        module
        for package in ("sfm", "calib", "stereo")
        for module in pkgutil.walk_packages([str(ROOT / package)], f"{package}.")
    ]
    return [module.name for module in found if not module.name.endswith("_kernels")]


# Modules that were imported before cannot be wrapped any more; then the shape checks would be silently absent.
_EARLY = [name for name in sys.modules if name.split(".")[0] in ("sfm", "calib", "stereo")]
assert not _EARLY, f"imported before the shape checks were installed: {_EARLY}"
jaxtyping.install_import_hook(_checked_modules(), "beartype.beartype")

hypothesis.settings.register_profile(
    "parallax", derandomize=True, deadline=None, max_examples=50, database=None, print_blob=False
)
hypothesis.settings.load_profile("parallax")


@pytest.fixture
def rng() -> np.random.Generator:
    """The test's own generator, the same in every run."""
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real image sets; a test that asks for it is skipped where `PARALLAX_DATA` names none."""
    folder = Path(os.environ.get("PARALLAX_DATA", ""))
    if not os.environ.get("PARALLAX_DATA") or not folder.is_dir():
        pytest.skip("PARALLAX_DATA names no folder of real image sets")
    return folder


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skips the tests marked `data` where there are none, whether they ask for the fixture or not."""
    if item.get_closest_marker("data") and not Path(os.environ.get("PARALLAX_DATA") or "/nonexistent").is_dir():
        pytest.skip("PARALLAX_DATA names no folder of real image sets")
