"""Products of tiny matrices in vector registers, for the inner loops of the normal equations.

    subtract_product(C, A, B)    C −= A B      6×6, 6×3, 3×6
    add_gram(C, J)               C += Jᵀ J     6×6, 2×6
    set_product(C, A, B)         C  = Aᵀ B     3×6, 2×3, 2×6
    add_combination(c, x, y, J)  c += x J₀ + y J₁   the first six of a row, two numbers, 2×6

Numba keeps LLVM from vectorising straight-line code, and its loop vectoriser has nothing to gain from a loop over
six. So the compiled form of these functions is written out in vectors of four and two doubles; the plain form below
is what runs when compilation is off, and what the tests compare with. On x86-64 with AVX2 the elimination of points
takes less than half of the time with it. Arrays must be contiguous; the product is fused with the sum after it
where the processor can (`contract`).
"""

from __future__ import annotations

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload
from numba.np.arrayobj import make_array

_DOUBLE, _INDEX, _LANE = ir.DoubleType(), ir.IntType(64), ir.IntType(32)
_FLAGS = ("contract",)
_HALVES = ((0, 4), (4, 2))
"""Offset and width of the vectors that make up a row of six."""


def subtract_product(C, A, B):
    """C −= A B for C (6, 6), A (6, 3), B (3, 6)."""
    C -= A @ B


def add_gram(C, J):
    """C += Jᵀ J for C (6, 6), J (2, 6)."""
    C += J.T @ J


def set_product(C, A, B):
    """C = Aᵀ B for C (3, 6), A (2, 3), B (2, 6)."""
    C[:] = A.T @ B


def add_combination(c, x, y, J):
    """c[:6] += x J[0] + y J[1] for J (2, 6)."""
    c[:6] += x * J[0] + y * J[1]


def _element(builder, pointer, offset):
    return builder.gep(pointer, [ir.Constant(_INDEX, offset)])


def _vector_pointer(builder, pointer, offset, width):
    return builder.bitcast(_element(builder, pointer, offset), ir.VectorType(_DOUBLE, width).as_pointer())


def _load(builder, pointer):
    value = builder.load(pointer)
    value.align = 8
    return value


def _store(builder, value, pointer):
    builder.store(value, pointer).align = 8


def _repeated(builder, scalar, width):
    kind = ir.VectorType(_DOUBLE, width)
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_LANE, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_LANE, width), [0] * width))


def _emit(builder, C, B, rows, inner, factor, accumulate, subtract):
    """Row r of C, or zero, plus or minus the sum over k of factor(r, k) × row k of B."""
    loaded = [[_load(builder, _vector_pointer(builder, B, 6 * k + at, n)) for at, n in _HALVES] for k in range(inner)]
    factors = [[factor(r, k) for k in range(inner)] for r in range(rows)]
    combine = builder.fsub if subtract else builder.fadd
    for r in range(rows):
        for half, (at, width) in enumerate(_HALVES):
            pointer = _vector_pointer(builder, C, 6 * r + at, width)
            total = _load(builder, pointer) if accumulate else None
            for k in range(inner):
                product = builder.fmul(_repeated(builder, factors[r][k], width), loaded[k][half], flags=_FLAGS)
                total = product if total is None else combine(total, product, flags=_FLAGS)
            _store(builder, total, pointer)


def _pointers(context, builder, signature, args):
    return [make_array(kind)(context, builder, value).data for kind, value in zip(signature.args, args, strict=True)]


@intrinsic
def _subtract_product(typing_context, C, A, B):
    def codegen(context, builder, signature, args):
        c, a, b = _pointers(context, builder, signature, args)
        _emit(builder, c, b, 6, 3, lambda r, k: _load(builder, _element(builder, a, 3 * r + k)), True, True)
        return context.get_dummy_value()

    return types.void(C, A, B), codegen


@intrinsic
def _add_gram(typing_context, C, J):
    def codegen(context, builder, signature, args):
        c, j = _pointers(context, builder, signature, args)
        _emit(builder, c, j, 6, 2, lambda r, k: _load(builder, _element(builder, j, 6 * k + r)), True, False)
        return context.get_dummy_value()

    return types.void(C, J), codegen


@intrinsic
def _set_product(typing_context, C, A, B):
    def codegen(context, builder, signature, args):
        c, a, b = _pointers(context, builder, signature, args)
        _emit(builder, c, b, 3, 2, lambda r, k: _load(builder, _element(builder, a, 3 * k + r)), False, False)
        return context.get_dummy_value()

    return types.void(C, A, B), codegen


@intrinsic
def _add_combination(typing_context, c, x, y, J):
    def codegen(context, builder, signature, args):
        row, rows = (make_array(signature.args[k])(context, builder, args[k]).data for k in (0, 3))
        _emit(builder, row, rows, 1, 2, lambda _, k: args[1 + k], True, False)
        return context.get_dummy_value()

    return types.void(c, x, y, J), codegen


def _is_contiguous(*arrays):
    return all(array.layout == "C" and array.dtype == types.float64 for array in arrays)


@overload(subtract_product)
def _compiled_subtract_product(C, A, B):
    if _is_contiguous(C, A, B):
        return lambda C, A, B: _subtract_product(C, A, B)  # pyright: ignore[reportCallIssue]
    return None


@overload(add_gram)
def _compiled_add_gram(C, J):
    if _is_contiguous(C, J):
        return lambda C, J: _add_gram(C, J)  # pyright: ignore[reportCallIssue]
    return None


@overload(set_product)
def _compiled_set_product(C, A, B):
    if _is_contiguous(C, A, B):
        return lambda C, A, B: _set_product(C, A, B)  # pyright: ignore[reportCallIssue]
    return None


@overload(add_combination)
def _compiled_add_combination(c, x, y, J):
    if _is_contiguous(c, J) and x == y == types.float64:
        return lambda c, x, y, J: _add_combination(c, x, y, J)  # pyright: ignore[reportCallIssue]
    return None
