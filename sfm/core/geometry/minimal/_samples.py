"""The form in which kernels take a minimal sample."""

from __future__ import annotations

import numpy as np

from sfm.core.arrays import FloatArray


def sample_of(*parts: tuple[FloatArray, tuple[int, int]]) -> tuple[FloatArray, np.ndarray]:
    """The columns of one sample, from arrays with a row for each datum, and the sample that names them all.

    Args:
        parts: arrays with the shapes that they must have.
    Raises:
        ValueError: a shape is another.
    """
    for array, shape in parts:
        if np.shape(array) != shape:
            raise ValueError(f"expected a minimal sample of shape {shape}, got {np.shape(array)}")
    data = np.ascontiguousarray(np.concatenate([array for array, _ in parts], axis=1, dtype=np.float64).T)
    return data, np.arange(data.shape[1])[None]
