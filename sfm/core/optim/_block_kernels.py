"""Products of tiny matrices in vector registers, for the inner loops of the elimination.

    subtract_product(C, factors, B)    C −= A B       6×8, 6×3, 3×8
    set_product(C, factors, B)         C  = M B       3×8, 3×3 symmetric, 3×8
    add_combination(c, factors, B)     c += fᵀ B      8, 3, 3×8

The left factor is a tuple of its numbers (18 of A by rows, 6 of M: xx, xy, xz, yy, yz, zz), so that they stay in
registers where many products share them.

Rows of six are padded to eight, whole vector registers; what the padding holds means nothing. Numba keeps LLVM from
vectorising straight-line code, and its loop vectoriser has nothing to gain from a loop over eight. So the compiled form
is written out in vectors; the plain form below is what runs when compilation is off, and what the tests compare with.
Arrays must be contiguous; the product is fused with the sum after it where the processor can (`contract`).
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload
from numba.np.arrayobj import make_array

_DOUBLE, _INDEX, _LANE = ir.DoubleType(), ir.IntType(64), ir.IntType(32)
_FLAGS = ("contract",)
WIDTH = 8
"""Numbers in a padded row."""


def subtract_product(C, factors, B):
    """C −= A B for C (6, 8), the 18 `factors` of A (6, 3), B (3, 8)."""
    C -= np.array(factors).reshape(6, 3) @ B


def set_product(C, factors, B):
    """C = M B for C (3, 8), the 6 `factors` of M (3, 3), B (3, 8)."""
    C[:] = np.array(factors)[np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])].reshape(3, 3) @ B


def add_combination(c, factors, B):
    """c += fᵀ B for c (8,), the 3 `factors`, B (3, 8)."""
    c += np.array(factors) @ B


def _element(builder, pointer, offset):
    return builder.gep(pointer, [ir.Constant(_INDEX, offset)])


def _row(builder, pointer, number):
    return builder.bitcast(_element(builder, pointer, WIDTH * number), ir.VectorType(_DOUBLE, WIDTH).as_pointer())


def _load(builder, pointer):
    value = builder.load(pointer)
    value.align = 8
    return value


def _repeated(builder, scalar):
    kind = ir.VectorType(_DOUBLE, WIDTH)
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_LANE, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_LANE, WIDTH), [0] * WIDTH))


def _emit(builder, target, below, factors, sign):
    """The sum of factors × rows, added to (+1) or subtracted from (−1) the target vector, or alone (None)."""
    combine = builder.fsub if sign == -1 else builder.fadd
    for factor, row in zip(factors, below, strict=True):
        product = builder.fmul(_repeated(builder, factor), row, flags=_FLAGS)
        target = product if target is None else combine(target, product, flags=_FLAGS)
    return target


def _intrinsic(rows, numbers, sign):
    """A product into `rows` vectors, whose row r takes the `numbers[r]` of the tuple of factors."""

    @intrinsic
    def emitted(typing_context, C, factors, B):
        def codegen(context, builder, signature, args):
            c, b = (make_array(signature.args[k])(context, builder, args[k]).data for k in (0, 2))
            below = [_load(builder, _row(builder, b, k)) for k in range(3)]
            for r in range(rows):
                place = _row(builder, c, r)
                mine = [builder.extract_value(args[1], k) for k in numbers[r]]
                total = _emit(builder, _load(builder, place) if sign else None, below, mine, sign)
                builder.store(total, place).align = 8
            return context.get_dummy_value()

        return types.void(C, factors, B), codegen

    return emitted


_subtract_product = _intrinsic(6, [(3 * r, 3 * r + 1, 3 * r + 2) for r in range(6)], -1)
_set_product = _intrinsic(3, [(0, 1, 2), (1, 3, 4), (2, 4, 5)], None)
_add_combination = _intrinsic(1, [(0, 1, 2)], 1)


def _is_contiguous(*arrays):
    return all(array.layout == "C" and array.dtype == types.float64 for array in arrays)


@overload(subtract_product)
def _compiled_subtract_product(C, factors, B):
    if _is_contiguous(C, B):
        return lambda C, factors, B: _subtract_product(C, factors, B)  # pyright: ignore[reportCallIssue]
    return None


@overload(set_product)
def _compiled_set_product(C, factors, B):
    if _is_contiguous(C, B):
        return lambda C, factors, B: _set_product(C, factors, B)  # pyright: ignore[reportCallIssue]
    return None


@overload(add_combination)
def _compiled_add_combination(c, factors, B):
    if _is_contiguous(c, B):
        return lambda c, factors, B: _add_combination(c, factors, B)  # pyright: ignore[reportCallIssue]
    return None
