"""The reduced system of a problem: its assembly, and its solution in the way that `solver_plan` chose."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from sfm.bundle.layout import Layout
from sfm.bundle.marginals import Marginals, marginals
from sfm.bundle.own_blocks import ImageSums, OwnBlocks, RowTerms
from sfm.bundle.solver_plan import SolverPlan
from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.execution import Workers
from sfm.core.optim._block_kernels import WIDTH
from sfm.core.optim.block_pattern import BLOCK
from sfm.core.optim.box import Box, step_in_box
from sfm.core.optim.cholmod import CholmodCholesky
from sfm.core.optim.conjugate_gradients import conjugate_gradients
from sfm.core.optim.schur import Couplings, eliminate, multiply
from sfm.core.optim.solvers import make_solver

_FLOOR = 1e-8
"""Part of the largest diagonal entry of its kind below which an entry of D counts as this part."""
_COUPLINGS_PER_THREAD = 8192
"""With fewer, a share of the elimination takes little longer than handing it out."""
_MODEL_TOLERANCE, _RESIDUAL_TOLERANCE, _MAX_GRADIENTS = 0.1, 1e-9, 200


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
        self._own = OwnBlocks(layout, terms, plan.pattern)
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
