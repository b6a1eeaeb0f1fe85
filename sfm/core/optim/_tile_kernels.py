"""Products of tiles in vector registers: the innermost loops of a Cholesky factorisation.

A *tile* is eight by eight doubles, column by column; a *strip* is eight rows of a matrix, column by column too, that
is tile after tile. Both lie in a flat array, and a number says where they begin. X and Y are strips of k columns:

    subtract_strip_product(C, c, A, x, y, k)               C −= X Yᵀ                        one tile
    subtract_two_strip_products(C, c0, c1, A, x0, x1, y, k)  C₀ −= X₀ Yᵀ,  C₁ −= X₁ Yᵀ     two tiles
    solve_tile(A, t, d)                                    T  = T D⁻ᵀ, D lower triangular with 1 / D_jj on its diagonal

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


@overload(subtract_strip_product)
def _compiled_one(C, c, A, x, y, k):
    return lambda C, c, A, x, y, k: _one(C, c, A, x, y, k)  # pyright: ignore[reportCallIssue]


@overload(subtract_two_strip_products)
def _compiled_two(C, c0, c1, A, x0, x1, y, k):
    return lambda C, c0, c1, A, x0, x1, y, k: _two(C, c0, c1, A, x0, x1, y, k)  # pyright: ignore[reportCallIssue]


@overload(solve_tile)
def _compiled_solve(A, t, d):
    return lambda A, t, d: _solve(A, t, d)  # pyright: ignore[reportCallIssue]
