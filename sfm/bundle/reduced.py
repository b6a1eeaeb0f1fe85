"""The reduced system of a problem: its assembly, and the ways to solve it.

    dense       Cholesky factor of all of S
    sparse      Cholesky factor of the blocks that points couple, in an order that keeps it sparse
    cholmod     the same by CHOLMOD, where it is installed
    iterative   conjugate gradients; S is known by its products alone (`schur.multiply`), and only what the
                preconditioner needs of it is formed: the blocks of pairs of rows within clusters

The factors are exact and for one step about as accurate as the machine; gradients stop once a step gains little
(see `conjugate_gradients`). `auto` takes what is the fastest by a forecast, and gradients where the factor would not
fit into half of the machine's memory.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import NamedTuple

import numpy as np

from sfm.bundle import _layout_kernels as kernels
from sfm.bundle.layout import Layout
from sfm.bundle.marginals import Marginals, marginals
from sfm.bundle.problem import SolverChoice
from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.execution import Workers, machine_bytes
from sfm.core.optim._block_kernels import WIDTH
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optim.box import Box, step_in_box
from sfm.core.optim.cholmod import CholmodCholesky
from sfm.core.optim.conjugate_gradients import conjugate_gradients
from sfm.core.optim.preconditioners import clusters_of, restricted_pattern
from sfm.core.optim.schur import Couplings, eliminate, multiply
from sfm.core.optim.solvers import (
    Forecast,
    forecast_cheapest,
    forecast_cholmod,
    forecast_dense,
    forecast_sparse,
    make_solver,
)
from sfm.core.optional import import_cholmod

_FLOOR = 1e-8
"""Part of the largest diagonal entry of its kind below which an entry of D counts as this part."""
_FULL_ROWS = 200
"""Up to here the pattern is full without a look at what points couple."""
_COUPLINGS_PER_THREAD = 8192
"""With fewer, a share of the elimination takes little longer than handing it out."""
_PRODUCT_SECONDS_PER_COUPLING, _PRODUCTS_PER_STEP = 1.5e-8, 150
"""Measured on one core, and a guess at how many products a step takes."""
_MODEL_TOLERANCE, _RESIDUAL_TOLERANCE, _MAX_GRADIENTS = 0.1, 1e-9, 200
_CLUSTER_ROWS, _PRODUCTS_PER_FACTOR = (60, 250, 1000, 4000, 16000, 64000), 20


class SolverPlan(NamedTuple):
    """What was chosen to solve the reduced system, before any of its memory is taken.

    Attributes:
        kind: dense, sparse, cholmod or iterative.
        pattern: the blocks of S that are formed; forecast: of what factors them.
        bytes: for S and its factor.
    """

    kind: SolverChoice
    pattern: BlockPattern
    forecast: Forecast
    bytes: int


def plan_solver(layout: Layout, held: BoolArray, terms: RowTerms, choice: SolverChoice) -> SolverPlan:
    """Chooses a solver for the rows of `layout`, of whose unknowns (rows, 6) some are `held`."""
    unknowns = held.ravel()
    if layout.rows <= _FULL_ROWS and choice in ("auto", "dense", "exact"):
        return _plan("dense", BlockPattern.full(layout.rows), forecast_dense(unknowns))
    pattern = layout.pattern(terms.rows, terms.columns)
    match choice:
        case "dense":
            return _plan("dense", pattern, forecast_dense(unknowns))
        case "sparse":
            return _plan("sparse", pattern, forecast_sparse(pattern, unknowns))
        case "cholmod":
            import_cholmod()  # fails here rather than after a forecast
            return _plan("cholmod", pattern, forecast_cholmod(pattern, unknowns))
        case "iterative":
            return _iterative(layout, pattern, unknowns)
    forecast = forecast_cheapest(pattern, unknowns)
    plan = _plan(forecast.kind, pattern, forecast)
    if choice == "exact":
        return plan
    too_slow = forecast.seconds > _PRODUCTS_PER_STEP * _product_seconds(layout)
    return _iterative(layout, pattern, unknowns) if too_slow or plan.bytes > machine_bytes() / 2 else plan


def _plan(kind: SolverChoice, pattern: BlockPattern, forecast: Forecast) -> SolverPlan:
    return SolverPlan(kind, pattern, forecast, forecast.bytes + 8 * BLOCK * WIDTH * len(pattern.columns))


def _iterative(layout: Layout, pattern: BlockPattern, unknowns: BoolArray) -> SolverPlan:
    """Gradients with clusters of rows that share many points as preconditioner.

    The larger the clusters, the fewer products; they grow as long as to factor them takes no longer than some products,
    on a street of 10,000 photos up to all of S, while photos that see the same things at random have small ones.
    """
    weights = np.zeros(len(pattern.columns))
    kernels.count_pairs(layout.starts, layout.slot, pattern.offsets, pattern.columns, weights)
    affordable = _PRODUCTS_PER_FACTOR * _product_seconds(layout)
    best = None
    for largest in _CLUSTER_ROWS:
        near, _ = restricted_pattern(pattern, clusters_of(pattern, weights, largest))
        plan = _plan("iterative", near, forecast_sparse(near, unknowns))
        if best is None or plan.forecast.seconds <= affordable:
            best = plan
        if plan.forecast.seconds > affordable or largest >= layout.rows:
            break
    assert best is not None
    return best


def _product_seconds(layout: Layout) -> float:
    """About what a product with S takes on one core."""
    return _PRODUCT_SECONDS_PER_COUPLING * (len(layout.slot) + 3 * len(layout.shared_slot))


class ReducedStep(NamedTuple):
    """A step of poses and shared parameters.

    Attributes:
        delta: (rows, 6).
        sides: (K,) on which side of a box its entries are; see `sfm.core.optim.box`.
        decrease: what the model promises beyond ½ δᵀ (λD δ − g), which holds where a box does not bound the step.
    """

    delta: FloatArray
    sides: np.ndarray
    decrease: float


class ReducedSystem:
    """S, its right-hand side and the solver; lives as long as one adjustment.

    Attributes:
        gradient: (rows, 6) of the problem by its rows, 0 where held.
        scaling: (rows, 6) λD of the last solution.
    """

    def __init__(
        self, layout: Layout, held: BoolArray, couplings: Couplings, terms: RowTerms, plan: SolverPlan, workers: Workers
    ) -> None:
        self.plan, self._layout, self._held, self._couplings, self._workers = plan, layout, held, couplings, workers
        self._blocks = np.zeros((len(plan.pattern.columns), BLOCK, WIDTH))
        self._side, self._diagonal = np.zeros((layout.rows, WIDTH)), np.zeros((layout.rows, WIDTH))
        self._solver = make_solver(plan.pattern, held.ravel(), plan.forecast)
        self._own = _OwnBlocks(layout, terms, plan.pattern)
        self._narrow = layout.is_narrow
        parts = (len(couplings.slot) + len(couplings.shared_slot)) // _COUPLINGS_PER_THREAD
        self._ranges = layout.row_ranges(min(max(parts, 1), workers.threads))
        self.gradient = self.scaling = self._own_gradient = np.zeros((layout.rows, BLOCK))
        self._points = (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 6)))
        self._gradient_of_points = np.zeros((0, 3))

    def take_over(self, images: ImageSums, blocks: FloatArray, gradient: FloatArray) -> None:
        """Takes over a linearisation: the sums of images, and blocks (m, 6, 6) and gradient (rows, 6) of the terms."""
        self._own.set(images.F, images.G, blocks)
        self._own_gradient = self._own.gradient(images.h, images.f) + gradient
        self.gradient = np.where(self._held, 0.0, self._own_gradient)

    def eliminate(self, centers: FloatArray, points3D: FloatArray, M: FloatArray, g: FloatArray) -> None:
        """Fills S, its right-hand side and the diagonal of the normal matrix.

        Args:
            centers: (S, 3) of the frames by row.
            M, g: inverse damped blocks (P, 6) and gradients (P, 3) of the points.
        """
        self._points = (centers, points3D, M)
        self._blocks.fill(0)
        self._own.add(self._blocks)
        self._side[:, :BLOCK] = -self._own_gradient
        self._diagonal[:, :BLOCK] = self._own.diagonal

        self._gradient_of_points = g
        self._workers.map(self._eliminate_rows, self._ranges)

    @property
    def diagonal(self) -> FloatArray:
        """(rows, 6) of the normal matrix, as last eliminated."""
        return self._diagonal[:, :BLOCK]

    def solve(self, damping: float, box: Box | None = None) -> ReducedStep | None:
        """δ (rows, 6) with (S + λD) δ = side, in a box the best; None where S + λD is not positive definite or δ not
        finite."""
        self.scaling = damping * self._marquardt_diagonal()
        if not self._solver.factor(self._blocks[:, :, :BLOCK], self.scaling.ravel(), self._workers.threads):
            return None
        side = np.where(self._held, 0.0, self._side[:, :BLOCK]).ravel()
        # What follows from a rough solution for a box is no minimum of the model in any space.
        delta = self._solved(side, _MODEL_TOLERANCE if box is None else 0.0)
        if not np.isfinite(delta).all():
            return None
        if box is None:
            return ReducedStep(delta.reshape(-1, BLOCK), np.zeros(0, np.int64), 0.0)
        step = step_in_box(delta, self._inverse_column, box)
        if not np.isfinite(step.x).all():
            return None
        decrease = -0.5 * float((step.multipliers * step.x[box.entries]).sum())
        return ReducedStep(step.x.reshape(-1, BLOCK), step.sides, decrease)

    def _solved(self, side: FloatArray, model_tolerance: float) -> FloatArray:
        """(6 rows,) with the factor, or by gradients; NaN where these get nowhere."""
        if self.plan.kind != "iterative":
            return self._solver.solve(side)
        found = conjugate_gradients(
            self._multiplied, side, self._solver.solve, model_tolerance=model_tolerance,
            residual_tolerance=_RESIDUAL_TOLERANCE, max_iterations=_MAX_GRADIENTS,
        )  # fmt: skip
        return found.x if found.iterations or not side.any() else np.full(len(side), np.nan)

    def _inverse_column(self, entry: int) -> FloatArray:
        """That of (S + λD)⁻¹."""
        side = np.zeros(self._held.size)
        side[entry] = 1.0
        return self._solved(side, 0.0)

    def inverse(self, motions: FloatArray) -> Marginals | int:
        """Blocks of S⁻¹ as last eliminated, all of them formed; see `marginals`. Overwrites S."""
        solver = self._solver
        if self.plan.kind == "iterative" or isinstance(solver, CholmodCholesky):
            raise ValueError(f"an inverse needs a dense or a sparse factor of S, not {self.plan.kind}")
        free, blocks = ~self._held.ravel(), self._blocks[:, :, :BLOCK].copy()
        return marginals(self.plan.pattern, blocks, solver, free, motions, self._workers.threads)

    def _eliminate_rows(self, rows: tuple[int, int]) -> None:
        pattern = self.plan.pattern
        eliminate(
            *rows, self._narrow, *self._couplings, *self._points, self._gradient_of_points,
            pattern.offsets, pattern.columns, self._blocks, self._side, self._diagonal,
        )  # fmt: skip

    def _multiplied(self, x: FloatArray) -> FloatArray:
        """(S + λD) x without S; each chunk of points has its own sum, and these are added in order."""
        wide = x.reshape(-1, BLOCK)
        of_chunks = partial(self._multiplied_chunk, wide)
        product = self._own.product(wide) + self.scaling * wide
        for part in self._workers.map(of_chunks, self._layout.point_chunks):
            product += part
        return np.where(self._held, 0.0, product).ravel()

    def _multiplied_chunk(self, x: FloatArray, points: tuple[int, int]) -> FloatArray:
        product = np.zeros_like(x)
        multiply(*points, *self._couplings, *self._points, x, product)
        return product

    def _marquardt_diagonal(self) -> FloatArray:
        """The diagonal of the normal matrix (rows, 6); tiny entries become a part of the largest of their kind."""
        diagonal, poses = self._diagonal[:, :BLOCK], len(self._layout.slot_frame)
        raised = np.empty_like(diagonal)
        cameras = poses + int(np.sum(self._layout.shared.camera >= 0))
        sensors = cameras + int(np.sum(self._layout.shared.sensor >= 0))
        for part in (slice(None, poses), slice(poses, cameras), slice(cameras, sensors), slice(sensors, None)):
            largest = diagonal[part].max(axis=0, initial=0.0)
            np.maximum(diagonal[part], np.where(largest > 0, _FLOOR * largest, 1.0), out=raised[part])
        return raised


@dataclasses.dataclass(slots=True)
class ImageSums:
    """What images contribute to a linearisation; k columns of parameters that they share, m shared rows.

    Attributes:
        h: (I, 6) gradient of the frame; f: (I, k) that of the columns.
        F: (I, 6, k) products of the frame's tangent with the columns.
        G: (I, k, k) products of the columns, lower triangle.
    """

    h: np.ndarray
    F: np.ndarray
    G: np.ndarray
    f: np.ndarray

    @staticmethod
    def allocate(images: int, columns: int) -> ImageSums:
        """For that many images and columns."""
        return ImageSums(
            np.zeros((images, BLOCK)), np.zeros((images, BLOCK, columns)),
            np.zeros((images, columns, columns)), np.zeros((images, columns)),
        )  # fmt: skip

    def clear(self) -> None:
        """Sets everything to zero."""
        for part in (self.h, self.F, self.G, self.f):
            part.fill(0)


class RowTerms(NamedTuple):
    """Which blocks of S priors contribute to: (m,) rows and columns, of the lower triangle."""

    rows: np.ndarray
    columns: np.ndarray


class _OwnBlocks:
    """What images and priors contribute to S and its gradient, whatever becomes of the points.

    But for the blocks of poses themselves, which the elimination adds. Each number of a linearisation has an entry
    among those of the blocks; the numbers of one entry are added in the order of images, then of terms.
    """

    def __init__(self, layout: Layout, terms: RowTerms, pattern: BlockPattern) -> None:
        slots, columns, self._count = layout.image_slot, layout.columns.shape[1], layout.rows
        self._used = np.arange(columns) < layout.column_count[:, None]
        self._moving = slots >= 0
        # The row of each column of an image, and where it stands there.
        row = np.take_along_axis(layout.image_shared, layout.column_place // BLOCK, axis=1).astype(np.int64)
        inner, six = layout.column_place % BLOCK, np.arange(BLOCK)

        i, k = np.nonzero(self._used & self._moving[:, None])
        j, a, b = np.nonzero(self._used[:, :, None] & self._used[:, None, :] & np.tri(columns, dtype=bool))
        rows = np.concatenate([row[i, k], row[j, a], terms.rows])
        columns_of = np.concatenate([slots[i], row[j, b], terms.columns])
        targets, number = np.unique(rows * self._count + columns_of, return_inverse=True)
        self._rows, self._columns = np.divmod(targets, max(self._count, 1))
        numbers = pattern.find(self._rows, self._columns)
        self._formed = np.flatnonzero(numbers >= 0)
        self._numbers = numbers[self._formed]

        begins = BLOCK * BLOCK * number
        of_columns, of_terms = begins[len(i) : len(i) + len(j)], begins[len(i) + len(j) :]
        # On the diagonal of S, of which G has only the lower triangle.
        above = (row[j, a] == row[j, b]) & (a != b)
        lower = (j * columns + a) * columns + b
        self._from_F = (((BLOCK * i)[:, None] + six) * columns + k[:, None]).ravel()
        self._from_G = np.concatenate([lower, lower[above]])
        self._entries = np.concatenate([
            ((begins[: len(i)] + BLOCK * inner[i, k])[:, None] + six).ravel(),
            of_columns + BLOCK * inner[j, a] + inner[j, b],
            (of_columns + BLOCK * inner[j, b] + inner[j, a])[above],
            (of_terms[:, None] + np.arange(BLOCK * BLOCK)).ravel(),
        ])  # fmt: skip
        self._gradient_entries = np.concatenate([
            (BLOCK * slots[self._moving, None] + six).ravel(), (BLOCK * row + inner)[self._used]
        ])  # fmt: skip
        self._blocks, self.diagonal = np.zeros((len(targets), BLOCK, BLOCK)), np.zeros((self._count, BLOCK))
        """(rows, 6) what they have on the diagonal of S."""

    def set(self, F: FloatArray, G: FloatArray, blocks: FloatArray) -> None:
        """Takes over the sums of a linearisation, and the blocks (m, 6, 6) of the terms."""
        values = np.concatenate([F.take(self._from_F), G.take(self._from_G), blocks.ravel()])
        self._blocks = _summed(self._entries, values, self._blocks.size).reshape(-1, BLOCK, BLOCK)
        own = np.flatnonzero(self._rows == self._columns)
        self.diagonal[self._rows[own]] = self._blocks[own].diagonal(axis1=1, axis2=2)

    def add(self, blocks: FloatArray) -> None:
        """Adds them to those blocks of the reduced system that are formed."""
        blocks[self._numbers, :, :BLOCK] += self._blocks[self._formed]

    def gradient(self, h: FloatArray, f: FloatArray) -> FloatArray:
        """(rows, 6) from those of the images' frames (I, 6) and columns (I, k)."""
        values = np.concatenate([h[self._moving].ravel(), f[self._used]])
        return _summed(self._gradient_entries, values, self._count * BLOCK).reshape(-1, BLOCK)

    def product(self, x: FloatArray) -> FloatArray:
        """What they contribute to S x, for x (rows, 6)."""
        out, beside = np.zeros_like(x), self._rows != self._columns
        np.add.at(out, self._rows, np.einsum("kab,kb->ka", self._blocks, x[self._columns]))
        above = np.einsum("kab,ka->kb", self._blocks[beside], x[self._rows[beside]])
        np.add.at(out, self._columns[beside], above)
        return out


def _summed(entries: np.ndarray, values: FloatArray, count: int) -> FloatArray:
    """(count,) sums of the values of each entry, in their order."""
    return np.bincount(entries, values, count).astype(np.float64, copy=False)  # of nothing it makes integers
