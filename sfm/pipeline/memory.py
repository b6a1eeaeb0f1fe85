"""How much memory there is, and how much a run has taken."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def free_memory_bytes() -> int | None:
    """Memory that programs can still have; None where the system does not say."""
    return _meminfo("MemAvailable")


def total_memory_bytes() -> int | None:
    """All memory of the machine; None where the system does not say."""
    if sys.platform == "darwin":
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return _meminfo("MemTotal")


def peak_memory_bytes() -> int | None:
    """The most memory that this process has held so far; None where the system does not say."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _meminfo(field: str) -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{field}:"))
    except (OSError, StopIteration, ValueError):
        return None
