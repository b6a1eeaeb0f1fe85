"""Products of tiles in vector registers: the innermost loops of a Cholesky factorisation.

A *tile* is eight by eight doubles, column by column; a *strip* is eight rows of a matrix, column by column too, that
is tile after tile. Both lie in a flat array, and a number says where they begin. X and Y are strips of k columns:

    subtract_strip_product(C, c, A, x, y, k)               C −= X Yᵀ                        one tile
    subtract_two_strip_products(C, c0, c1, A, x0, x1, y, k)  C₀ −= X₀ Yᵀ,  C₁ −= X₁ Yᵀ     two tiles
    solve_tile(A, t, d)                                    T  = T D⁻ᵀ, D lower triangular with 1 / D_jj on its diagonal
    subtract_strip_vector(x, i, A, a, k)                   x_i −= X x_0…k      eight numbers of a vector
    subtract_vector_strip(x, i, A, a, k)                   x_0…k −= Xᵀ x_i
    add_run(C, c, A, a, n)                                 at most eight numbers to others

Numba's own loops would go through memory for each term; here a tile stays in registers until its sum is done. Two
tiles at once fill the registers of AVX-512, four columns of one those of AVX2 and of NEON. The sum of an element runs
over k in order either way, so that both forms give the same bits. The plain forms below run when compilation is off.
"""

from __future__ import annotations

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, overload
from numba.np.arrayobj import make_array

TILE = 8
_FLAGS = ("contract",)
_INDEX, _LANE = ir.IntType(64), ir.IntType(32)
_DOUBLE = ir.DoubleType()
_VECTOR = ir.VectorType(_DOUBLE, TILE)
_WIDE = bool(llvm.get_host_cpu_features().get("avx512f"))
"""Whether a column of a tile is one register, of which there are 32."""


def subtract_strip_product(C, c, A, x, y, k):
    """C −= X Yᵀ for the tile at `c` and the strips at `x` and `y` of `A`, of `k` columns each."""
    X, Y = A[x : x + TILE * k].reshape(k, TILE), A[y : y + TILE * k].reshape(k, TILE)
    C[c : c + TILE * TILE] -= (Y.T @ X).ravel()


def subtract_two_strip_products(C, c0, c1, A, x0, x1, y, k):
    """The same for two tiles and two strips X at once."""
    subtract_strip_product(C, c0, A, x0, y, k)
    subtract_strip_product(C, c1, A, x1, y, k)


def solve_tile(A, t, d):
    """T = T D⁻ᵀ for the tiles of `A` at `t` and `d`; D is lower triangular and has 1 / D_jj for D_jj."""
    T, D = (A[start : start + TILE * TILE].reshape(TILE, TILE) for start in (t, d))
    for j in range(TILE):
        T[j] *= D[j, j]
        T[j + 1 :] -= D[j, j + 1 :, None] * T[j]


def subtract_strip_vector(x, i, A, a, k):
    """x[i : i + 8] −= X x[:k] for the strip at `a` of `k` columns."""
    x[i : i + TILE] -= x[:k] @ A[a : a + TILE * k].reshape(k, TILE)


def subtract_vector_strip(x, i, A, a, k):
    """x[:k] −= Xᵀ x[i : i + 8] for the strip at `a` of `k` columns."""
    x[:k] -= A[a : a + TILE * k].reshape(k, TILE) @ x[i : i + TILE]


def add_run(C, c, A, a, n):
    """C[c : c + n] += A[a : a + n] for n ≤ 8."""
    C[c : c + n] += A[a : a + n]


def _at(builder, pointer, offset):
    return builder.gep(pointer, [offset])


def _vector_at(builder, pointer, offset):
    return builder.bitcast(_at(builder, pointer, offset), _VECTOR.as_pointer())


def _load(builder, pointer):
    value = builder.load(pointer)
    value.align = 8
    return value


def _repeated(builder, scalar):
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_LANE, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_LANE, TILE), [0] * TILE))


def _number(value):
    return ir.Constant(_INDEX, value)


def _emit(builder, C, tiles, A, strips, y, k, columns):
    """Subtracts from `columns` of each tile the product of its strip and these rows of Y."""
    places = [_vector_at(builder, C, builder.add(c, _number(TILE * j))) for c in tiles for j in columns]
    sums = [cgutils.alloca_once_value(builder, _load(builder, place)) for place in places]
    with cgutils.for_range(builder, k) as loop:
        at = builder.mul(loop.index, _number(TILE))
        rows = [_load(builder, _vector_at(builder, A, builder.add(x, at))) for x in strips]
        row = builder.add(y, at)
        factors = [_repeated(builder, _load(builder, _at(builder, A, builder.add(row, _number(j))))) for j in columns]
        for n, total in enumerate(sums):
            strip, column = divmod(n, len(factors))
            product = builder.fmul(rows[strip], factors[column], flags=_FLAGS)
            builder.store(builder.fsub(builder.load(total), product, flags=_FLAGS), total)
    for place, total in zip(places, sums, strict=True):
        builder.store(builder.load(total), place).align = 8


def _code(tiles):
    """Generates code for arguments (C, tiles, A, strips, y, k)."""

    def codegen(context, builder, signature, args):
        kinds = signature.args
        C, A = (make_array(kinds[n])(context, builder, args[n]).data for n in (0, 1 + tiles))
        places, strips, (y, k) = args[1 : 1 + tiles], args[2 + tiles : 2 + 2 * tiles], args[2 + 2 * tiles :]
        if _WIDE:
            _emit(builder, C, places, A, strips, y, k, range(TILE))
        else:
            for place, strip in zip(places, strips, strict=True):
                for first in (0, TILE // 2):
                    _emit(builder, C, [place], A, [strip], y, k, range(first, first + TILE // 2))
        return context.get_dummy_value()

    return codegen


@intrinsic
def _one(typing_context, C, c, A, x, y, k):
    at = types.int64
    return types.void(C, at, A, at, at, at), _code(1)


@intrinsic
def _two(typing_context, C, c0, c1, A, x0, x1, y, k):
    at = types.int64
    return types.void(C, at, at, A, at, at, at, at), _code(2)


@intrinsic
def _solve(typing_context, A, t, d):
    def codegen(context, builder, signature, args):
        _, t, d = args
        a = make_array(signature.args[0])(context, builder, args[0]).data
        places = [_vector_at(builder, a, builder.add(t, _number(TILE * j))) for j in range(TILE)]
        columns = [_load(builder, place) for place in places]
        for j in range(TILE):
            below = [_load(builder, _at(builder, a, builder.add(d, _number(TILE * j + i)))) for i in range(j, TILE)]
            columns[j] = builder.fmul(columns[j], _repeated(builder, below[0]))
            for i in range(j + 1, TILE):
                product = builder.fmul(columns[j], _repeated(builder, below[i - j]), flags=_FLAGS)
                columns[i] = builder.fsub(columns[i], product, flags=_FLAGS)
        for place, column in zip(places, columns, strict=True):
            builder.store(column, place).align = 8
        return context.get_dummy_value()

    return types.void(A, types.int64, types.int64), codegen


def _data(context, builder, signature, args, *which):
    return [make_array(signature.args[n])(context, builder, args[n]).data for n in which]


@intrinsic
def _strip_vector(typing_context, x, i, A, a, k):
    def codegen(context, builder, signature, args):
        data, numbers = _data(context, builder, signature, args, 0, 2)
        place = _vector_at(builder, data, args[1])
        total = cgutils.alloca_once_value(builder, _load(builder, place))
        with cgutils.for_range(builder, args[4]) as loop:
            column = builder.add(args[3], builder.mul(loop.index, _number(TILE)))
            factor = _repeated(builder, _load(builder, _at(builder, data, loop.index)))
            product = builder.fmul(_load(builder, _vector_at(builder, numbers, column)), factor, flags=_FLAGS)
            builder.store(builder.fsub(builder.load(total), product, flags=_FLAGS), total)
        builder.store(builder.load(total), place).align = 8
        return context.get_dummy_value()

    return types.void(x, types.int64, A, types.int64, types.int64), codegen


@intrinsic
def _vector_strip(typing_context, x, i, A, a, k):
    def codegen(context, builder, signature, args):
        data, numbers = _data(context, builder, signature, args, 0, 2)
        factors = _load(builder, _vector_at(builder, data, args[1]))
        with cgutils.for_range(builder, args[4]) as loop:
            column = builder.add(args[3], builder.mul(loop.index, _number(TILE)))
            parts = builder.fmul(_load(builder, _vector_at(builder, numbers, column)), factors)
            for half in (4, 2, 1):
                low, high = ([ir.Constant(_LANE, n) for n in range(f, f + half)] for f in (0, half))
                kind = ir.VectorType(_LANE, half)
                low, high = (builder.shuffle_vector(parts, parts, ir.Constant(kind, lanes)) for lanes in (low, high))
                parts = builder.fadd(low, high)
            place = _at(builder, data, loop.index)
            builder.store(builder.fsub(_load(builder, place), builder.extract_element(parts, _LANE(0))), place)
        return context.get_dummy_value()

    return types.void(x, types.int64, A, types.int64, types.int64), codegen


@intrinsic
def _run(typing_context, C, c, A, a, n):
    def codegen(context, builder, signature, args):
        to, of = _data(context, builder, signature, args, 0, 2)
        kind, mask = _VECTOR, ir.VectorType(ir.IntType(1), TILE)
        lanes = ir.VectorType(_LANE, TILE)
        count = builder.trunc(args[4], _LANE)
        first = builder.insert_element(ir.Constant(lanes, ir.Undefined), count, _LANE(0))
        counts = builder.shuffle_vector(first, first, ir.Constant(lanes, [0] * TILE))
        inside = builder.icmp_signed("<", ir.Constant(lanes, list(range(TILE))), counts)
        module, pointer = builder.module, kind.as_pointer()
        load = cgutils.get_or_insert_function(
            module, ir.FunctionType(kind, [pointer, _LANE, mask, kind]), "llvm.masked.load.v8f64.p0v8f64"
        )
        store = cgutils.get_or_insert_function(
            module, ir.FunctionType(ir.VoidType(), [kind, pointer, _LANE, mask]), "llvm.masked.store.v8f64.p0v8f64"
        )
        zeros, place = ir.Constant(kind, [0.0] * TILE), _vector_at(builder, to, args[1])
        added = builder.call(load, [_vector_at(builder, of, args[3]), _LANE(8), inside, zeros])
        total = builder.fadd(builder.call(load, [place, _LANE(8), inside, zeros]), added)
        builder.call(store, [total, place, _LANE(8), inside])
        return context.get_dummy_value()

    return types.void(C, types.int64, A, types.int64, types.int64), codegen


@overload(subtract_strip_product)
def _compiled_one(C, c, A, x, y, k):
    return lambda C, c, A, x, y, k: _one(C, c, A, x, y, k)  # pyright: ignore[reportCallIssue]


@overload(subtract_two_strip_products)
def _compiled_two(C, c0, c1, A, x0, x1, y, k):
    return lambda C, c0, c1, A, x0, x1, y, k: _two(C, c0, c1, A, x0, x1, y, k)  # pyright: ignore[reportCallIssue]


@overload(solve_tile)
def _compiled_solve(A, t, d):
    return lambda A, t, d: _solve(A, t, d)  # pyright: ignore[reportCallIssue]


@overload(subtract_strip_vector)
def _compiled_strip_vector(x, i, A, a, k):
    return lambda x, i, A, a, k: _strip_vector(x, i, A, a, k)  # pyright: ignore[reportCallIssue]


@overload(subtract_vector_strip)
def _compiled_vector_strip(x, i, A, a, k):
    return lambda x, i, A, a, k: _vector_strip(x, i, A, a, k)  # pyright: ignore[reportCallIssue]


@overload(add_run)
def _compiled_run(C, c, A, a, n):
    return lambda C, c, A, a, n: _run(C, c, A, a, n)  # pyright: ignore[reportCallIssue]
