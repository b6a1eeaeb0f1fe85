"""Robust estimation by locally optimised random sampling.

Minimal samples propose models; a model's score is a robust sum Σ ρ(r²) over all data. Whenever the best minimal model
improves, Levenberg–Marquardt refines it over the same loss (local optimisation). Sampling ends when a sample of m
inliers, all of them drawn without replacement from I inliers among N, would have been missed with probability 1 − p:

    k = c log(1 − p) / log(1 − Π_{i<m} (I − i) / (N − i)),

the exact form of the criterion, where c allows for samples that are clean but too noisy. The winner is refined once
more with Cauchy's loss at a scale taken from its own residuals, which makes the result insensitive to the error bound.

Samples are drawn, solved and scored in batches by compiled kernels that hold no lock, so that threads work on as many
problems at once as there are cores; the loop itself is this page. A single kernel around all of it was no faster and
took twice as long to compile. Its random numbers come from one that is drawn here.

References:
    Lebeda, Matas & Chum, Fixing the locally optimized RANSAC, BMVC 2012.
    Schönberger & Larsson, Fixing the RANSAC stopping criterion, arXiv:2503.07829.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from sfm.core.arrays import FloatArray, Mask, Vector
from sfm.core.errors import ConfigError, Rejected
from sfm.core.robust._absolute_pose_kernels import Resection
from sfm.core.robust._focal_resection_kernels import FocalResection
from sfm.core.robust._focal_views_kernels import FocalViews
from sfm.core.robust._loop_kernels import best_model, improve
from sfm.core.robust._loss_kernels import CAUCHY, MARGINALIZED, TRUNCATED
from sfm.core.robust._problem_kernels import SIZE
from sfm.core.robust._sampling_kernels import draw_progressively, draw_samples
from sfm.core.robust._two_view_kernels import TwoViews

_BATCH = 20
_SCALE = 1.5
_LOCAL_TOLERANCE, _FINAL_TOLERANCE = 1e-4, 1e-6


@dataclasses.dataclass(frozen=True, kw_only=True)
class RansacConfig:
    """How long to sample and what is an inlier."""

    max_error_px: float = 4.0
    """Largest error of an inlier, in px of the full image. 4 is COLMAP's default; 1 suits sharp, well calibrated
    images. The final refinement adapts to the noise, so that the accuracy depends little on it."""
    score: Literal["truncated", "marginalized"] = "truncated"
    """By which models are compared: Σ min(r², ε²), or its mean over all error bounds ε up to the largest, which asks
    no knowledge of the noise."""
    confidence: float = 0.9999
    """Probability with which an all-inlier sample has been drawn when sampling ends."""
    trials_factor: float = 3.0
    """The computed number of samples is multiplied by this: not every clean sample gives a good model."""
    min_iterations: int = 100
    """Samples drawn at least. Local optimisation makes a hundred enough for easy data."""
    max_iterations: int = 10000
    """Samples drawn at most; 10,000 find an essential matrix among 25 % inliers."""
    min_inliers: int = 15
    """Fewer inliers are a rejection, as in COLMAP."""
    min_inlier_ratio: float = 0.0
    """A smaller fraction of inliers is a rejection."""

    def __post_init__(self) -> None:
        if not self.max_error_px > 0:
            raise ConfigError(f"max_error_px must be positive, got {self.max_error_px}")
        if not 0 < self.confidence < 1:
            raise ConfigError(f"confidence must lie between 0 and 1, got {self.confidence}")
        if self.score not in ("truncated", "marginalized"):
            raise ConfigError(f"score must be truncated or marginalized, got {self.score}")


class Solver(NamedTuple):
    """A kernel that fills an array with the models of samples and returns how many they are."""

    kernel: Callable[[FloatArray, np.ndarray, FloatArray], int]
    sample_size: int
    max_solutions: int


class CompiledProblem:
    """Columns of data, their minimal solver, and the largest error of an inlier in the units of the columns.

    A model is a row of SIZE numbers, a matrix or a pose by rows and zeros.
    """

    def __init__(
        self, data: TwoViews | Resection | FocalViews | FocalResection, solver: Solver, max_error: float
    ) -> None:
        self.data, self.solver, self.max_error = data, solver, max_error
        self.sample_size, self.count = solver.sample_size, data.data.shape[1]

    def ordered(self, order: np.ndarray) -> CompiledProblem:
        """The problem with its data in another order."""
        columns = np.ascontiguousarray(self.data.data[:, order])
        return CompiledProblem(self.data._replace(data=columns), self.solver, self.max_error)

    def proposals(self, samples: np.ndarray) -> FloatArray:
        """Models of minimal samples, rows of indices."""
        models = np.zeros((self.solver.max_solutions * len(samples), SIZE))
        return models[: self.solver.kernel(self.data.data, samples, models)]

    def best(self, models: FloatArray, loss: np.int64, bound: float) -> tuple[int, float, int]:
        """Index of the model with the lowest score below `bound` or −1, its score and its number of inliers."""
        return best_model(self.data, models, loss, self.max_error**2, bound, np.empty(self.count))

    def squared_errors(self, model: FloatArray) -> Vector:
        """r² of every datum; infinite or NaN where there is none."""
        squares = np.empty(self.count)
        best_model(self.data, model[None], TRUNCATED, self.max_error**2, np.inf, squares)
        return squares

    def improved(self, model: FloatArray, loss: np.int64, scale: float, tolerance: float) -> FloatArray:
        """The model after Levenberg–Marquardt on Σ ρ(r²), until the sum decreases by less than a share of it.

        A degenerate model, which has no tangent space, is returned as it is.
        """
        model = model.copy()
        improve(self.data, model, loss, scale**2, self.max_error**2, tolerance)
        return model


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """A model with its score, its inliers, and the number of samples drawn."""

    model: FloatArray
    score: float
    inliers: Mask
    iterations: int


def required_iterations(inliers: int, count: int, sample_size: int, config: RansacConfig) -> int:
    """Samples needed to draw one of inliers only with the configured confidence, within the configured limits."""
    if count < sample_size:
        return config.max_iterations
    clean = math.prod(max(inliers - i, 0) / (count - i) for i in range(sample_size))
    if clean >= 1 - 1e-12:
        return config.min_iterations
    if clean <= 1e-12:
        return config.max_iterations
    needed = config.trials_factor * math.log(1 - config.confidence) / math.log1p(-clean)
    return int(min(max(math.ceil(needed), config.min_iterations), config.max_iterations))


def ransac(
    problem: CompiledProblem, config: RansacConfig, rng: np.random.Generator, quality: Vector | None = None
) -> Estimate | Rejected:
    """The model that most data agree with; see the module. `config.max_error_px` is not used: the problem has it.

    Args:
        quality: (N,) larger for data that are more likely right; samples are then drawn from the best ones first.
    """
    needed = max(problem.sample_size, config.min_inliers)
    if problem.count < needed:
        return Rejected("too_few_points", f"{problem.count} of {needed} needed")
    order = None if quality is None else np.argsort(-quality, kind="stable")
    searched = problem if order is None else problem.ordered(order)
    loss = MARGINALIZED if config.score == "marginalized" else TRUNCATED
    generator, growth = rng.integers(1, 2**32, 1), np.zeros(3)
    best = best_minimal = problem.count * problem.max_error**2
    # As long as no model has enough inliers, sampling ends when one would have been found.
    hopeful = dataclasses.replace(config, trials_factor=1.0)
    hopeless = required_iterations(needed, problem.count, problem.sample_size, hopeful)
    drawn, limit, reach = 0, hopeless, problem.count
    model = None
    while drawn < limit:
        samples = np.empty((min(_BATCH, limit - drawn), problem.sample_size), np.int64)
        if order is None:
            draw_samples(generator, problem.count, samples)
        else:
            draw_progressively(generator, drawn, reach, problem.count, float(config.max_iterations), growth, samples)
        drawn += len(samples)
        models = searched.proposals(samples)
        index, score, _ = searched.best(models, loss, best_minimal)
        if index < 0:
            continue
        best_minimal = score
        candidate = searched.improved(models[index], loss, problem.max_error, _LOCAL_TOLERANCE)
        index, score, inliers = searched.best(candidate[None], loss, best)
        if index < 0:
            continue
        best, model = score, candidate
        if inliers < needed:
            limit = hopeless
            continue
        limit = required_iterations(inliers, problem.count, problem.sample_size, config)
        if order is not None:
            squares = searched.squared_errors(model)
            limit, reach = _progressive_limit(squares < problem.max_error**2, problem.sample_size, config)
    if model is None:
        return Rejected("no_model", f"none of {drawn} samples gave one")
    model, squares = polish(problem, model)
    inliers = squares < problem.max_error**2
    rejected = judged(inliers, needed, config)
    return Estimate(model, best, inliers, drawn) if rejected is None else rejected


def _progressive_limit(inliers: Mask, sample_size: int, config: RansacConfig) -> tuple[int, int]:
    """The fewest samples needed among the best n data over all n, and that n; `inliers` are in the order of quality.

    Those n count whose inliers are more than a share of one in ten, with five standard deviations to spare, as chance
    would bring them in.
    """
    limits = [(required_iterations(int(inliers.sum()), len(inliers), sample_size, config), len(inliers))]
    found = np.cumsum(inliers)
    sizes = np.unique(np.geomspace(20, len(inliers), 30).astype(int)).tolist() if len(inliers) > 20 else []
    limits += [
        (required_iterations(int(found[n - 1]), n, sample_size, config), n)
        for n in sizes
        if found[n - 1] > 0.1 * n + 1.5 * math.sqrt(n)
    ]
    return min(limits)


def judged(inliers: Mask, needed: int, config: RansacConfig) -> Rejected | None:
    """The rejection of a model with too few inliers."""
    count = int(inliers.sum())
    if count < needed:
        return Rejected("too_few_inliers", f"{count} of {needed} needed")
    if count < config.min_inlier_ratio * len(inliers):
        return Rejected("low_inlier_ratio", f"{count / len(inliers):.2f} of {config.min_inlier_ratio:.2f} needed")
    return None


def polish(problem: CompiledProblem, model: FloatArray) -> tuple[FloatArray, Vector]:
    """Final refinement with Cauchy's loss, cut off at the error bound, at a scale taken from the inliers; and r²."""
    squares = problem.squared_errors(model)
    inliers = squares[squares < problem.max_error**2]
    if not len(inliers):
        return model, squares
    # 1.5 medians of the |r| of the inliers. On pairs of four real sets the AUC at 1° is flat from 1 to 2 medians; at
    # 3.5, which is 95 % efficient on Gaussian noise, it is lower: the noise of keypoints has tails.
    scale = max(_SCALE * math.sqrt(float(np.median(inliers))), 1e-3 * problem.max_error)
    model = problem.improved(model, CAUCHY, scale, _FINAL_TOLERANCE)
    return model, problem.squared_errors(model)
