"""What settings may be, so that no square of theirs, or of its inverse, leaves the range of floating-point numbers."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray

LEAST, MOST = 1e-12, 1e12
"""Of standard deviations and scales, in any unit that a person would choose."""


def check_scale(name: str, values: FloatArray | float) -> None:
    """That standard deviations or scales of losses are positive, finite and not absurd.

    Raises:
        ValueError: one is not.
    """
    values = np.atleast_1d(np.asarray(values, np.float64))
    wrong = values[~((values >= LEAST) & (values <= MOST))]
    if len(wrong):
        raise ValueError(f"{name} must be positive and finite, within {LEAST:g}..{MOST:g}, got {wrong[0]:g}")


def check_tolerance(name: str, value: float) -> None:
    """That a tolerance is a part: 0 for none, less than 1.

    Raises:
        ValueError: it is not.
    """
    if not 0 <= value < 1:
        raise ValueError(f"{name} must lie in 0..1, without 1, got {value:g}")
