"""Which way to solve the reduced system of a problem, chosen before any of its memory is taken.

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

from typing import NamedTuple

import numpy as np

from sfm.bundle import _layout_kernels as kernels
from sfm.bundle.layout import Layout
from sfm.bundle.own_blocks import RowTerms
from sfm.bundle.problem import SolverChoice
from sfm.core.arrays import BoolArray
from sfm.core.execution import machine_bytes
from sfm.core.optim._block_kernels import WIDTH
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optim.preconditioners import clusters_of, restricted_pattern
from sfm.core.optim.solvers import Forecast, forecast_cheapest, forecast_cholmod, forecast_dense, forecast_sparse
from sfm.core.optional import import_cholmod

_FULL_ROWS = 200
"""Up to here the pattern is full without a look at what points couple."""
_PRODUCT_SECONDS_PER_COUPLING, _PRODUCTS_PER_STEP = 1.5e-8, 150
"""Measured on one core, and a guess at how many products a step takes."""
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
