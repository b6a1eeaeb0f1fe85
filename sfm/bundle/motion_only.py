"""Poses of least epipolar error: adjustment from the matches of pairs, without points.

A match of images i and j with unit rays r₁, r₂ in their cameras has in the world the rays a = R_iᵀ r₁, b = R_jᵀ r₂ and
the baseline B = C_j − C_i; the three lie in one plane, e = B · (a × b) = 0. By how many pixels the match misses that
is, to first order, the tangent Sampson error

    r = e / √(|n₁|² + |n₂|²)        n₁ = J₁ᵀ R_i (b × B)        n₂ = J₂ᵀ R_j (B × a)

with J the derivatives (3, 2) of a ray by its pixel: right for every camera model. All poses are found at once, those
of F = ½ Σ ρ(r²) → min, with the tangents of `sfm.bundle.prior_terms`: ∂a/∂ω_i = [a]×, ∂b/∂ω_j = [b]×, and B changes by
υ_i − υ_j. With P = J₁ n₁, Q = J₂ n₂ turned into the world, s = 1 / √(…) and u = r s,

    ∂r/∂ω_i = s ((b × B) × (a − u P) − u (Q × B) × a)
    ∂r/∂ω_j = s ((B × a) × (b − u Q) − u (B × P) × b)        ∂r/∂B = s (a × (b − u Q) − u P × b)

so that a pair has nine rows of its own, whatever the number of its matches, and the normal matrix a block for each
pair. A pair fixes only the direction of its baseline; lengths follow from triangles that do not lie on a line.
Where nothing fixes them (a chain of pairs, motion along a line) they stay about as they are. Cheaper than bundle
adjustment with points and a little less exact, for a match of k images counts in k (k − 1) / 2 pairs.

Reference:
    Terekhov & Larsson, Tangent Sampson error, CVPR 2023.
    Rodríguez, López-de-Teruel & Ruiz, Reduced epipolar cost for accelerated incremental SfM, CVPR 2011.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from sfm.bundle import _motion_only_kernels as kernels
from sfm.bundle.limits import check_scale, check_tolerance
from sfm.bundle.motion_problem import MotionProblem, held_by_parts, with_baselines
from sfm.core.arrays import FloatArray, Value
from sfm.core.execution import chunk_bounds, ordered_map
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.optim.block_pattern import BLOCK, BlockPattern
from sfm.core.optim.levenberg_marquardt import Iteration, StopReason, StopRules, Summary, Trial, minimize, steepness
from sfm.core.optim.losses import Loss, evaluate_loss, loss_id
from sfm.core.optim.solvers import forecast_cheapest, make_solver

_LOST_PX = 100.0
_FLOOR = 1e-8
"""Part of the largest diagonal entry of its kind below which an entry of D counts as this part."""
_CHUNKS = 16


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MotionConfig:
    """Settings of a refinement of poses without points."""

    loss: Loss = "cauchy"
    """What an epipolar error costs. Matches are verified pair by pair only, and some are wrong."""
    loss_scale_px: float = 1.0
    """Error in px from which a robust loss grows more slowly."""
    max_iterations: int = 50
    """Steps that are tried at most."""
    relative_cost_tolerance: float = 1e-8
    """Stop where a full step lowers the cost by less than this part."""
    gradient_tolerance: float = 1e-10
    """Stop where no cosine |g| / √(2 F H) of a gradient and a diagonal entry exceeds this; without a unit."""

    def __post_init__(self) -> None:
        loss_id(self.loss)
        check_scale("loss_scale_px", self.loss_scale_px)
        if self.max_iterations < 0:
            raise ValueError(f"max_iterations must not be negative, got {self.max_iterations}")
        check_tolerance("relative_cost_tolerance", self.relative_cost_tolerance)
        check_tolerance("gradient_tolerance", self.gradient_tolerance)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MotionResult(Value):
    """Refined poses and how they came about.

    Attributes:
        cams_from_world: batch (I,); poses without a match, or that may not change, are the same to the last bit.
        initial_cost, final_cost: ½ Σ ρ in px².
        reason: why the iteration ended.
        without_baseline: matches of images at the same place; they say nothing and take no part.
        table: one row for each trial, the start first.
    """

    cams_from_world: Rigid3
    initial_cost: float
    final_cost: float
    reason: StopReason
    without_baseline: int
    table: tuple[Iteration, ...]


def refine_motion(problem: MotionProblem, config: MotionConfig = MotionConfig(), *, threads: int = 1) -> MotionResult:
    """The poses near to these that minimise ½ Σ ρ(r²) of the epipolar errors.

    Of every connected part of the view graph the first pose is held, that with the most matches, and one coordinate of
    a second; constant poses take their place.

    Args:
        threads: the result is the same to the last bit for any number.
    """
    problem, without = with_baselines(problem)
    system = MotionSystem(problem, config, threads)
    if system.free_count:
        rules = StopRules(
            max_iterations=config.max_iterations,
            relative_cost_tolerance=config.relative_cost_tolerance,
            gradient_tolerance=config.gradient_tolerance,
        )
        summary = minimize(system, rules)
    else:
        summary = Summary.at_once("no_free_parameters", *system.linearize())
    return MotionResult(
        cams_from_world=system.cams_from_world,
        initial_cost=summary.initial_cost,
        final_cost=summary.final_cost,
        reason=summary.reason,
        without_baseline=without,
        table=summary.iterations,
    )


class MotionSystem:
    """Current and tried poses with the normal equations of all pairs; meets `sfm.core.optim.System`."""

    def __init__(self, problem: MotionProblem, config: MotionConfig, threads: int) -> None:
        self._problem, self._threads = problem, threads
        seen = np.zeros(len(problem.free_poses), bool)
        seen[problem.first] = seen[problem.second] = True
        self._rows = np.flatnonzero(seen & problem.free_poses)
        slot = np.full(len(seen), -1, np.int32)
        slot[self._rows] = np.arange(len(self._rows))
        self._slots = slot[problem.first], slot[problem.second]
        both = (self._slots[0] >= 0) & (self._slots[1] >= 0)
        self._pattern = BlockPattern.of_pairs(len(self._rows), self._slots[0][both], self._slots[1][both])
        self.held = held_by_parts(problem)[self._rows].ravel()
        self._solver = make_solver(self._pattern, self.held, forecast_cheapest(self._pattern, self.held))

        poses = problem.cams_from_world
        self._now = _Poses(poses.rotation.wxyz.copy(), poses.rotation.matrix, poses.center.copy())
        self._trial = self._now
        self._moved = np.zeros(len(seen), bool)
        pairs = len(problem.first)
        self._cost, self._H, self._g = np.zeros(pairs), np.zeros((pairs, 9, 9)), np.zeros((pairs, 9))
        self._unused = np.zeros((pairs, 9, 9)), np.zeros((pairs, 9))
        self._jobs = _jobs(problem.offsets)
        lost = evaluate_loss(config.loss, np.array(_LOST_PX**2), config.loss_scale_px)[0]
        self._loss = loss_id(config.loss), float(config.loss_scale_px), 0.5 * float(lost)

    @property
    def free_count(self) -> int:
        """Number of scalars that may change."""
        return int(np.sum(~self.held))

    @property
    def cams_from_world(self) -> Rigid3:
        """Current poses, a batch (I,)."""
        given, moved = self._problem.cams_from_world, self._moved[:, None]
        translations = -np.einsum("iab,ib->ia", self._now.rotations, self._now.centers)
        return Rigid3(Rotation3(self._now.wxyz), np.where(moved, translations, given.translation))

    def linearize(self) -> tuple[float, float]:
        """Cost and largest entry of the gradient at the current poses."""
        cost = self._evaluate(self._now, True)
        self._blocks, gradient = self._assemble()
        self._gradient = np.where(self.held, 0.0, gradient.ravel())
        diagonal = np.einsum("iaa->ia", self._blocks[self._pattern.diagonal])
        largest = diagonal.max(axis=0, initial=0.0)
        self._diagonal = np.maximum(diagonal, np.where(largest > 0, _FLOOR * largest, 1.0)).ravel()
        self._steepness = steepness(self._gradient, diagonal.ravel(), cost)
        return cost, float(np.abs(self._gradient).max(initial=0.0))

    def try_step(self, damping: float) -> Trial | None:
        """Solves the damped normal equations, moves the poses by the solution and evaluates the cost there."""
        if not self._solver.factor(self._blocks, damping * self._diagonal, self._threads):
            return None
        delta = self._solver.solve(-self._gradient)
        if not np.all(np.isfinite(delta)):
            return None
        self._trial = self._now.moved(self._rows, delta.reshape(-1, BLOCK))
        cost = self._evaluate(self._trial, False)
        decrease = 0.5 * float(damping * self._diagonal @ delta**2 - self._gradient @ delta)
        norm = np.sqrt(np.sum(self._now.centers**2) + len(self._now.wxyz))
        return Trial(cost, decrease, float(np.linalg.norm(delta)), float(norm), self._steepness)

    def accept(self) -> None:
        """Makes the last trial current."""
        self._now = self._trial
        self._moved[self._rows] = True

    def _evaluate(self, poses: _Poses, derivatives: bool) -> float:
        """The cost; with derivatives also H and g of all pairs."""
        p = self._problem
        H, g = (self._H, self._g) if derivatives else self._unused

        def chunk(bounds: tuple[int, int]) -> None:
            kernels.evaluate_pairs(
                *bounds, p.offsets, p.first, p.second, p.rays1, p.rays2, p.tangents1, p.tangents2,
                poses.rotations, poses.centers, *self._loss, derivatives, self._cost, H, g,
            )  # fmt: skip

        for _ in ordered_map(chunk, self._jobs, threads=self._threads):
            pass
        return float(self._cost.sum())

    def _assemble(self) -> tuple[FloatArray, FloatArray]:
        """Blocks of the lower triangle in the order of the pattern, and the gradient (S, 6)."""
        blocks, gradient = np.zeros((len(self._pattern.columns), BLOCK, BLOCK)), np.zeros((len(self._rows), BLOCK))
        H = _BY_TANGENTS.T @ (self._H + np.tril(self._H, -1).swapaxes(1, 2)) @ _BY_TANGENTS
        g = self._g @ _BY_TANGENTS
        for slot, at in zip(self._slots, (slice(0, BLOCK), slice(BLOCK, None)), strict=True):
            moves = slot >= 0
            np.add.at(blocks, self._pattern.diagonal[slot[moves]], H[moves, at, at])
            np.add.at(gradient, slot[moves], g[moves, at])
        one, two = self._slots
        both = np.flatnonzero((one >= 0) & (two >= 0))
        coupling = H[both, BLOCK:, :BLOCK]
        coupling = np.where((two > one)[both, None, None], coupling, coupling.swapaxes(1, 2))
        np.add.at(blocks, self._pattern.find(np.maximum(one, two)[both], np.minimum(one, two)[both]), coupling)
        return blocks, gradient


@dataclasses.dataclass(frozen=True, slots=True)
class _Poses:
    """Poses as the kernel wants them."""

    wxyz: FloatArray
    rotations: FloatArray
    centers: FloatArray

    def moved(self, rows: np.ndarray, tangents: FloatArray) -> _Poses:
        """R exp(ω) and C − exp(−ω) υ for these rows; the others are the same to the last bit."""
        wxyz, rotations, centers = self.wxyz.copy(), self.rotations.copy(), self.centers.copy()
        turns = Rotation3.exp(tangents[:, :3])
        turned = Rotation3(wxyz[rows]) @ turns
        wxyz[rows], rotations[rows] = turned.wxyz, turned.matrix
        centers[rows] -= turns.inverse() @ tangents[:, 3:]
        return _Poses(wxyz, rotations, centers)


def _by_tangents() -> FloatArray:
    """(9, 12) the rows of a pair, ω_i, ω_j and B, by the tangents (ω_i, υ_i, ω_j, υ_j)."""
    out = np.zeros((9, 2 * BLOCK))
    out[:3, :3] = out[3:6, 6:9] = out[6:, 3:6] = np.eye(3)
    out[6:, 9:] = -np.eye(3)
    return out


_BY_TANGENTS = _by_tangents()


def _jobs(offsets: np.ndarray) -> list[tuple[int, int]]:
    """Ranges of pairs with about the same number of matches."""
    edges = np.searchsorted(offsets, [last for _, last in chunk_bounds(int(offsets[-1]), _CHUNKS)])
    return [(int(a), int(b)) for a, b in itertools.pairwise([0, *edges]) if a < b]
