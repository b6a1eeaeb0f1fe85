"""Array aliases with shapes, and the base of the immutable values.

Signatures state shapes with the aliases; the test run checks them. Axis names that repeat within one
signature (`N`, `M`) must agree there.
"""

from __future__ import annotations

import dataclasses
from types import EllipsisType, MappingProxyType
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, Integer, UInt8
from numpy.typing import DTypeLike

Points2D: TypeAlias = Float64[np.ndarray, "N 2"]
"""Pixels; the image corner is (0, 0), the centre of the first pixel (0.5, 0.5)."""
Points3D: TypeAlias = Float64[np.ndarray, "N 3"]
"""Points in scene units, in the frame that the name of the variable states."""
Rays: TypeAlias = Float64[np.ndarray, "N 3"]
"""Unit bearing vectors in a camera frame."""
Mask: TypeAlias = Bool[np.ndarray, " N"]
"""True keeps."""
Indices: TypeAlias = Integer[np.ndarray, " M"]
Matrix3: TypeAlias = Float64[np.ndarray, "3 3"]
Vector: TypeAlias = Float64[np.ndarray, " K"]
if TYPE_CHECKING:
    FloatArray: TypeAlias = Float64[np.ndarray, "..."]
else:
    FloatArray: TypeAlias = Float64[np.ndarray, "..."] | np.float64
"""Numbers with any batch shape; NumPy itself hands out the batch of shape () as a scalar."""
BoolArray: TypeAlias = Bool[np.ndarray, "..."]
ImageU8: TypeAlias = UInt8[np.ndarray, "H W"] | UInt8[np.ndarray, "H W 3"]
"""An image at the edge of the program; colour is RGB."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Value:
    """Base of the data types.

    Rebuilding through the constructor keeps arrays read-only across processes: pickle protocols below 5
    return them writable, and a read-only view of a mapping cannot be pickled at all. Equality is identity,
    since `==` of arrays is an array.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        values = [getattr(self, f.name) for f in dataclasses.fields(self)]
        return type(self), tuple(dict(v) if isinstance(v, MappingProxyType) else v for v in values)


def readonly(array: Any, shape: tuple[int | EllipsisType | None, ...], dtype: DTypeLike = np.float64) -> np.ndarray:
    """A read-only view of `array` as `dtype`; copies only where the type or the layout demands it.

    Args:
        shape: what is expected; `None` matches any length, a leading `...` any batch axes.
    Raises:
        ValueError: the shape is another.
    """
    view = np.asarray(array, dtype=dtype, order="C").view()  # ascontiguousarray would make a scalar (1,)
    if shape and shape[0] is ...:
        tail = shape[1:]
        actual = view.shape[view.ndim - len(tail) :] if view.ndim >= len(tail) else None
    else:
        tail, actual = shape, view.shape
    fits = actual is not None and len(actual) == len(tail)
    if not fits or any(want is not None and want != got for want, got in zip(tail, actual or (), strict=True)):
        raise ValueError(f"expected an array of shape {shape}, got {np.shape(array)}")
    view.flags.writeable = False
    return view
