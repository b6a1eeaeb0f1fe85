"""Products of tiny matrices in vector registers, for the inner loops of the elimination.

    subtract_product     C −= A B       6×8, 6×3, 3×8
    subtract_upper       the same for the first three rows
    couple_pose, couple_shared          what a point and a row have in common, from few numbers
    set_coupling, copy_coupling         no more of it than later rows need

The left factor is a tuple of its numbers (18 of A by rows, 6 of a symmetric M: xx, xy, xz, yy, yz, zz), so that they
stay in registers where many products share them. Couplings are made in registers, too: what is stored number by number
cannot be loaded as a vector at once, which takes longer than the product. All functions take whole arrays and where in
them to look: a view of a part counts its owners, which takes as long again.

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


def subtract_product(C, c, factors, B, b):
    """C[c] −= A B[b] for C (·, 6, 8), the 18 `factors` of A (6, 3), B (·, 3, 8)."""
    C[c] -= np.array(factors).reshape(6, 3) @ B[b]


def subtract_upper(C, c, factors, B, b):
    """C[c] −= A B[b] for the first three rows of C[c] and the first nine of the 18 `factors`."""
    C[c, :3] -= np.array(factors[:9]).reshape(3, 3) @ B[b]


def set_coupling(W, k, N, e, u):
    """W[k] = N T (3, 8), T = [−[u]×, I], for the 6 numbers N[e] and the 3 of `u`."""
    W[k] = _symmetric(N[e]) @ _moving(u)


def couple_pose(W, k, Y, Z, side, diagonal, row, N, e, u, m, g):
    """W[k] = N[e] T,  Y = M W[k],  Z = Y − T  (3, 8);  side[row] += gᵀ Y,  diagonal[row] += diag(Tᵀ W[k])  (8,)."""
    T = _moving(u)
    W[k] = _symmetric(N[e]) @ T
    Y[:] = _symmetric(m) @ W[k]
    Z[:] = Y - T
    side[row] += np.array(g) @ Y
    diagonal[row] += np.sum(T * W[k], axis=0)


def copy_coupling(W, k, B, e):
    """W[k] (3, 8) = B[e] (3, 6)."""
    W[k, :, :6] = B[e]


def couple_shared(W, k, Y, side, row, B, e, m, g):
    """W[k] = B[e],  Y = M W[k],  side[row] += gᵀ Y."""
    copy_coupling(W, k, B, e)
    Y[:] = _symmetric(m) @ W[k]
    side[row] += np.array(g) @ Y


def _symmetric(numbers):
    return np.array(numbers)[np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])].reshape(3, 3)


def _moving(u):
    """(3, 8) how a point at u from the centre of a pose moves against it by a turn and a shift."""
    x, y, z = u
    return np.array([[0, z, -y, 1, 0, 0, 0, 0], [-z, 0, x, 0, 1, 0, 0, 0], [y, -x, 0, 0, 0, 1, 0, 0]])


# --- compiled ---


def _pointer(context, builder, signature, args, array, place=None):
    """Where item args[place] of the array args[array] begins, or where the array does."""
    made = make_array(signature.args[array])(context, builder, args[array])
    if place is None:
        return made.data
    index = context.cast(builder, args[place], signature.args[place], types.intp)
    step = builder.sdiv(builder.extract_value(made.strides, 0), ir.Constant(_INDEX, 8))
    return builder.gep(made.data, [builder.mul(index, step)])


def _vector(builder, pointer, offset):
    """A pointer to the vector that begins `offset` numbers behind."""
    place = builder.gep(pointer, [ir.Constant(_INDEX, offset)])
    return builder.bitcast(place, ir.VectorType(_DOUBLE, WIDTH).as_pointer())


def _load(builder, pointer, offset):
    value = builder.load(_vector(builder, pointer, offset))
    value.align = 8
    return value


def _load_rows(builder, pointer):
    return [_load(builder, pointer, WIDTH * k) for k in range(3)]


def _store_rows(builder, pointer, rows):
    for r, row in enumerate(rows):
        builder.store(row, _vector(builder, pointer, WIDTH * r)).align = 8


def _add_to(builder, pointer, vector):
    total = builder.fadd(_load(builder, pointer, 0), vector, flags=_FLAGS)
    builder.store(total, _vector(builder, pointer, 0)).align = 8


def _from_tuple(builder, value, count):
    return [builder.extract_value(value, k) for k in range(count)]


def _from_memory(builder, pointer, count):
    return [builder.load(builder.gep(pointer, [ir.Constant(_INDEX, k)])) for k in range(count)]


def _repeated(builder, scalar):
    kind = ir.VectorType(_DOUBLE, WIDTH)
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_LANE, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_LANE, WIDTH), [0] * WIDTH))


def _unit(place):
    return ir.Constant(ir.VectorType(_DOUBLE, WIDTH), [float(k == place) for k in range(WIDTH)])


def _emit(builder, factors, rows, target=None):
    """The sum of factors × rows, or what is left of the target vector when it is taken off."""
    combine = builder.fadd if target is None else builder.fsub
    for factor, row in zip(factors, rows, strict=True):
        product = builder.fmul(_repeated(builder, factor), row, flags=_FLAGS)
        target = product if target is None else combine(target, product, flags=_FLAGS)
    return target


def _emit_symmetric(builder, numbers, rows):
    """The three rows of M × rows, M symmetric."""
    return [_emit(builder, [numbers[k] for k in row], rows) for row in ((0, 1, 2), (1, 3, 4), (2, 4, 5))]


def _emit_moving(builder, u):
    """The three rows of T: row r is e(r + 3) + u(j) e(i) − u(i) e(j) with i and j the next two axes."""
    rows = []
    for r in range(3):
        i, j = (r + 1) % 3, (r + 2) % 3
        ahead = builder.fmul(_repeated(builder, u[j]), _unit(i), flags=_FLAGS)
        behind = builder.fmul(_repeated(builder, u[i]), _unit(j), flags=_FLAGS)
        turn = builder.fsub(ahead, behind, flags=_FLAGS)
        rows.append(builder.fadd(turn, _unit(r + 3), flags=_FLAGS))
    return rows


def _emit_copy(builder, pointer):
    """The three rows of a block of 3×6. The last is taken from two numbers before: nothing lies behind it."""
    first, second, last = (_load(builder, pointer, at) for at in (0, 6, 10))
    forward = ir.Constant(ir.VectorType(_LANE, WIDTH), [2, 3, 4, 5, 6, 7, 7, 7])
    return [first, second, builder.shuffle_vector(last, last, forward)]


def _subtraction(rows):
    """C[c] −= A B[b] for that many rows."""

    @intrinsic
    def emitted(typing_context, C, c, factors, B, b):
        def codegen(context, builder, signature, args):
            target = _pointer(context, builder, signature, args, 0, 1)
            below = _load_rows(builder, _pointer(context, builder, signature, args, 3, 4))
            for r in range(rows):
                mine = [builder.extract_value(args[2], 3 * r + k) for k in range(3)]
                left = _emit(builder, mine, below, _load(builder, target, WIDTH * r))
                builder.store(left, _vector(builder, target, WIDTH * r)).align = 8
            return context.get_dummy_value()

        return types.void(C, c, factors, B, b), codegen

    return emitted


_subtract_product, _subtract_upper = _subtraction(6), _subtraction(3)


@intrinsic
def _set_coupling(typing_context, W, k, N, e, u):
    def codegen(context, builder, signature, args):
        to, n = (_pointer(context, builder, signature, args, *place) for place in ((0, 1), (2, 3)))
        moving = _emit_moving(builder, _from_tuple(builder, args[4], 3))
        _store_rows(builder, to, _emit_symmetric(builder, _from_memory(builder, n, 6), moving))
        return context.get_dummy_value()

    return types.void(W, k, N, e, u), codegen


@intrinsic
def _couple_pose(typing_context, W, k, Y, Z, side, diagonal, row, N, e, u, m, g):
    def codegen(context, builder, signature, args):
        places = ((0, 1), (2,), (3,), (4, 6), (5, 6), (7, 8))
        to, y, z, s, d, n = (_pointer(context, builder, signature, args, *place) for place in places)
        moving = _emit_moving(builder, _from_tuple(builder, args[9], 3))
        coupling = _emit_symmetric(builder, _from_memory(builder, n, 6), moving)
        product = _emit_symmetric(builder, _from_tuple(builder, args[10], 6), coupling)
        _store_rows(builder, to, coupling)
        _store_rows(builder, y, product)
        _store_rows(builder, z, [builder.fsub(a, b) for a, b in zip(product, moving, strict=True)])
        _add_to(builder, s, _emit(builder, _from_tuple(builder, args[11], 3), product))
        squares = [builder.fmul(a, b, flags=_FLAGS) for a, b in zip(moving, coupling, strict=True)]
        two = builder.fadd(squares[0], squares[1], flags=_FLAGS)
        _add_to(builder, d, builder.fadd(two, squares[2], flags=_FLAGS))
        return context.get_dummy_value()

    return types.void(W, k, Y, Z, side, diagonal, row, N, e, u, m, g), codegen


@intrinsic
def _copy_coupling(typing_context, W, k, B, e):
    def codegen(context, builder, signature, args):
        to, block = (_pointer(context, builder, signature, args, *place) for place in ((0, 1), (2, 3)))
        _store_rows(builder, to, _emit_copy(builder, block))
        return context.get_dummy_value()

    return types.void(W, k, B, e), codegen


@intrinsic
def _couple_shared(typing_context, W, k, Y, side, row, B, e, m, g):
    def codegen(context, builder, signature, args):
        places = ((0, 1), (2,), (3, 4), (5, 6))
        to, y, s, block = (_pointer(context, builder, signature, args, *place) for place in places)
        coupling = _emit_copy(builder, block)
        product = _emit_symmetric(builder, _from_tuple(builder, args[7], 6), coupling)
        _store_rows(builder, to, coupling)
        _store_rows(builder, y, product)
        _add_to(builder, s, _emit(builder, _from_tuple(builder, args[8], 3), product))
        return context.get_dummy_value()

    return types.void(W, k, Y, side, row, B, e, m, g), codegen


def _is_contiguous(*arrays):
    return all(array.layout == "C" and array.dtype == types.float64 for array in arrays)


@overload(subtract_product)
def _compiled_subtract_product(C, c, factors, B, b):
    if _is_contiguous(C, B):
        return lambda C, c, factors, B, b: _subtract_product(C, c, factors, B, b)  # pyright: ignore[reportCallIssue]
    return None


@overload(subtract_upper)
def _compiled_subtract_upper(C, c, factors, B, b):
    if _is_contiguous(C, B):
        return lambda C, c, factors, B, b: _subtract_upper(C, c, factors, B, b)  # pyright: ignore[reportCallIssue]
    return None


@overload(set_coupling)
def _compiled_set_coupling(W, k, N, e, u):
    if _is_contiguous(W, N):
        return lambda W, k, N, e, u: _set_coupling(W, k, N, e, u)  # pyright: ignore[reportCallIssue]
    return None


@overload(couple_pose)
def _compiled_couple_pose(W, k, Y, Z, side, diagonal, row, N, e, u, m, g):
    if _is_contiguous(W, Y, Z, side, diagonal, N):
        return lambda W, k, Y, Z, side, diagonal, row, N, e, u, m, g: _couple_pose(  # pyright: ignore[reportCallIssue]
            W, k, Y, Z, side, diagonal, row, N, e, u, m, g
        )
    return None


@overload(copy_coupling)
def _compiled_copy_coupling(W, k, B, e):
    if _is_contiguous(W, B):
        return lambda W, k, B, e: _copy_coupling(W, k, B, e)  # pyright: ignore[reportCallIssue]
    return None


@overload(couple_shared)
def _compiled_couple_shared(W, k, Y, side, row, B, e, m, g):
    if _is_contiguous(W, Y, side, B):
        return lambda W, k, Y, side, row, B, e, m, g: _couple_shared(  # pyright: ignore[reportCallIssue]
            W, k, Y, side, row, B, e, m, g
        )
    return None
