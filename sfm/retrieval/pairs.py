"""Which images are compared."""

from __future__ import annotations

import itertools
from collections.abc import Iterable


def exhaustive_pairs(image_ids: Iterable[int]) -> list[tuple[int, int]]:
    """All pairs i < j, sorted."""
    return list(itertools.combinations(sorted(set(image_ids)), 2))
