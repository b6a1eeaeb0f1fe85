"""Robust estimation by locally optimised random sampling.

Minimal samples propose models; a model's score is a robust sum Σ ρ(r²) over all data. Whenever the best minimal model
improves, Levenberg–Marquardt refines it over the same loss (local optimisation). Models that a camera cannot see are
passed over, and the others are given up as soon as the first data, which are in random order, tell that they are not
the best ones. Sampling ends when a sample of m
inliers, all of them drawn without replacement from I inliers among N, would have been missed with probability 1 − p:

    k = c log(1 − p) / log(1 − Π_{i<m} (I − i) / (N − i)),

the exact form of the criterion, where c allows for samples that are clean but too noisy. The winner is refined once
more with Cauchy's loss at a scale taken from its own residuals, which makes the result insensitive to the error bound.

One kernel, which holds no lock, takes many samples up to the next better model, so that threads work on as many
problems at once as there are cores; the loop itself is this page. Its random numbers come from one that is drawn here.

References:
    Lebeda, Matas & Chum, Fixing the locally optimized RANSAC, BMVC 2012.
    Chum, Matas & Kittler, Locally optimized RANSAC, DAGM 2003, for samples of the inliers.
    Chum & Matas, Optimal randomized RANSAC, PAMI 2008, for giving models up early.
    Schönberger & Larsson, Fixing the RANSAC stopping criterion, arXiv:2503.07829.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, NamedTuple

import numpy as np

from sfm.core.arrays import FloatArray, Mask, Vector
from sfm.core.errors import ConfigError, Rejected
from sfm.core.robust import _loop_kernels as kernels
from sfm.core.robust._absolute_pose_kernels import Resection
from sfm.core.robust._focal_resection_kernels import FocalResection
from sfm.core.robust._focal_views_kernels import FocalViews
from sfm.core.robust._loss_kernels import CAUCHY, MARGINALIZED, TRUNCATED
from sfm.core.robust._problem_kernels import SIZE, solve
from sfm.core.robust._two_view_kernels import TwoViews
from sfm.core.robust.sampling import Sampler

_MEDIANS = 2.0
"""Scale of the final refinement, in medians of the |r| of the inliers. On pairs of four real sets the AUC at 1° is flat
from 1.5 to 2; at 3.5, which is 95 % efficient on Gaussian noise, it is lower: the noise of keypoints has tails."""
# Local optimisation looks at no more data than these, since all of them wait for the end.
LOCAL_DATA = 500
_FARTHEST_PX = 8.0
LOCAL_TOLERANCE, _FINAL_TOLERANCE = 1e-2, 1e-5


@dataclasses.dataclass(frozen=True, kw_only=True)
class RansacConfig:
    """How long to sample and what is an inlier."""

    max_error_px: float = 4.0
    """Largest error of an inlier, in px of the full image. 4 is COLMAP's default; 1 suits sharp, well calibrated
    images. The final refinement adapts to the noise, so that the accuracy depends little on it."""
    score: Literal["truncated", "marginalized"] = "marginalized"
    """By which models are compared: Σ min(r², ε²) for the largest error ε of an inlier, or the mean of the like over
    all bounds from 0 up to three or four times ε (to 8 px at most, unless ε is larger). The mean asks for no knowledge
    of the noise: a bound of 1 px, less than the noise of many photos, then costs no models."""
    confidence: float = 0.9999
    """Probability with which an all-inlier sample has been drawn when sampling ends."""
    trials_factor: float = 1.0
    """The computed number of samples is multiplied by this. Not every clean sample gives a good model, but nearly every
    one does when it is refined: twice as many find hardly more."""
    min_iterations: int = 100
    """Samples drawn at least, half as many for P3P and H. Local optimisation makes a hundred enough for easy data."""
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
    """What is to be known of a minimal solver; `_problem_kernels.solve` calls it."""

    sample_size: int
    max_solutions: int
    restarts: int = 0
    """Rounds of sampling among the inliers of the best model, for models whose refinement has many local minima."""
    effort: float = 1.0
    """Share of the smallest number of samples that is needed: less for small samples, whose models are more stable."""
    reach: float = 4.0
    """Up to which multiple of the largest error of an inlier the marginalised score takes its bounds."""

    def moderated(self, config: RansacConfig) -> RansacConfig:
        """The configuration with the smallest number of samples that this solver needs."""
        return dataclasses.replace(config, min_iterations=math.ceil(self.effort * config.min_iterations))


class CompiledProblem:
    """Columns of data, their minimal solver, and the largest error of an inlier in the units of the columns.

    A model is a row of SIZE numbers, a matrix or a pose by rows and zeros.
    """

    def __init__(
        self, data: TwoViews | Resection | FocalViews | FocalResection, solver: Solver, max_error: float
    ) -> None:
        self.data, self.solver, self.max_error, self._some = data, solver, max_error, None
        self.sample_size, self.count = solver.sample_size, data.data.shape[1]

    def ordered(self, order: np.ndarray) -> CompiledProblem:
        """The problem with its data in another order."""
        columns = np.ascontiguousarray(self.data.data[:, order])
        return CompiledProblem(self.data._replace(data=columns), self.solver, self.max_error)

    def within(self, max_error: float) -> CompiledProblem:
        """The problem with another largest error of an inlier."""
        return CompiledProblem(self.data, self.solver, max_error)

    def search(self, samples: np.ndarray, loss: np.int64, bounds: FloatArray, best: FloatArray) -> tuple[int, int]:
        """Looks for a better model among those of minimal samples, rows of indices; see `_loop_kernels`.

        Data must be in random order: models are given up for the first of them, and refined on the first of them.
        """
        models, square = np.zeros((self.solver.max_solutions, SIZE)), self.max_error**2
        return kernels.search(self.data, self.some, samples, models, loss, square, LOCAL_TOLERANCE, bounds, best)

    @property
    def some(self) -> TwoViews | Resection | FocalViews | FocalResection:
        """The data that local optimisation looks at."""
        if self._some is None:
            self._some = self.data._replace(data=np.ascontiguousarray(self.data.data[:, :LOCAL_DATA]))
        return self._some

    def proposals(self, samples: np.ndarray) -> FloatArray:
        """Models of minimal samples, rows of indices."""
        models = np.zeros((self.solver.max_solutions * len(samples), SIZE))
        return models[: solve(self.data, samples, models)]

    def best(self, models: FloatArray, loss: np.int64, bound: float) -> tuple[int, float, int]:
        """Index of the model with the lowest score below `bound` or −1, its score and its number of inliers."""
        return kernels.best_model(self.data, models, loss, self.max_error**2, bound, np.empty(self.count))

    def squared_errors(self, model: FloatArray) -> Vector:
        """r² of every datum; infinite or NaN where there is none."""
        squares = np.empty(self.count)
        kernels.best_model(self.data, model[None], TRUNCATED, self.max_error**2, np.inf, squares)
        return squares

    def improved(self, model: FloatArray, loss: np.int64, scale: float, tolerance: float) -> FloatArray:
        """The model after Levenberg–Marquardt on Σ ρ(r²), until the sum decreases by less than a share of it.

        A degenerate model, which has no tangent space, is returned as it is.
        """
        model = model.copy()
        kernels.improve(self.data, model, loss, scale**2, self.max_error**2, tolerance)
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
    """The model that most data agree with; see the module.

    The largest error of an inlier is the problem's; `config.max_error_px` tells only what a pixel is beside it.

    Args:
        quality: (N,) larger for data that are more likely right; samples are then drawn from the best ones first.
    """
    needed = max(problem.sample_size, config.min_inliers)
    if problem.count < needed:
        return Rejected("too_few_points", f"{problem.count} of {needed} needed")
    config, loss = problem.solver.moderated(config), loss_of(config)
    wide, shuffled = (
        problem.within(problem.max_error * farthest_bound(problem.solver, config)),
        rng.permutation(problem.count),
    )
    searched, ordered = wide.ordered(shuffled), None if quality is None else quality[shuffled]
    sampler = Sampler(problem.count, problem.sample_size, config.max_iterations, rng, ordered)
    model, bounds = np.zeros(SIZE), np.full(2, problem.count * wide.max_error**2)
    # As long as no model has enough inliers, sampling ends when one would have been found.
    hopeful = dataclasses.replace(config, trials_factor=1.0)
    limit = hopeless = required_iterations(needed, problem.count, problem.sample_size, hopeful)
    while sampler.used < limit:
        used, inliers = searched.search(sampler.ahead(limit - sampler.used), loss, bounds, model)
        sampler.use(used)
        if inliers < needed:
            limit = limit if inliers < 0 else hopeless
        elif sampler.order is None:
            limit = required_iterations(inliers, problem.count, problem.sample_size, config)
        else:
            near = searched.squared_errors(model)[sampler.order] < wide.max_error**2
            limit, reach = _progressive_limit(near, problem.sample_size, config)
            sampler.restrict(reach)
    if not model.any():
        return Rejected("no_model", f"none of {sampler.used} samples gave one")
    _search_inliers(searched, problem.max_error, sampler, loss, bounds, model)
    model, squares = polish(wide, model)
    mask = squares < problem.max_error**2
    rejected = judged(mask, needed, config)
    return Estimate(model, float(bounds[1]), mask, sampler.used) if rejected is None else rejected


def _search_inliers(
    problem: CompiledProblem, max_error: float, sampler: Sampler, loss: np.int64, bounds: FloatArray, model: FloatArray
) -> None:
    """Replaces the model by a better one among those of samples of its inliers alone, if there is one.

    Refinement of F ends in one of many local minima; the models of clean samples lie near most of them.
    """
    inliers = np.flatnonzero(problem.squared_errors(model) < max_error**2)
    for _ in range(problem.solver.restarts if len(inliers) > problem.sample_size else 0):
        bounds[0] = problem.count * problem.max_error**2
        problem.search(sampler.among(inliers), loss, bounds, model)


def loss_of(config: RansacConfig) -> np.int64:
    """The loss by which models are compared."""
    return MARGINALIZED if config.score == "marginalized" else TRUNCATED


def farthest_bound(solver: Solver, config: RansacConfig) -> float:
    """The largest error bound over which scores are taken, as a multiple of the largest error of an inlier."""
    if config.score == "truncated":
        return 1.0
    return max(min(solver.reach, _FARTHEST_PX / config.max_error_px), 1.0)


_FEWEST = 20
_SHARES_OF_DATA = np.geomspace(0.005, 1.0, 30)


def _progressive_limit(inliers: Mask, sample_size: int, config: RansacConfig) -> tuple[int, int]:
    """The fewest samples needed among the best n data over all n, and that n; `inliers` are in the order of quality.

    Thirty n are looked at. Those count whose inliers are more than a share of one in ten, with five standard deviations
    to spare, as chance would bring them in.
    """
    found, sizes = np.cumsum(inliers), _SHARES_OF_DATA * len(inliers)
    sizes = np.append(np.unique(sizes[sizes >= _FEWEST].astype(np.int64)), len(inliers))
    among = found[sizes - 1]
    convincing = among > 0.1 * sizes + 1.5 * np.sqrt(sizes)
    convincing[-1] = True
    sizes, among = sizes[convincing], among[convincing]
    clean = np.ones(len(sizes))
    for i in range(sample_size):
        clean *= np.maximum(among - i, 0) / (sizes - i)
    # The likelier a clean sample is, the fewer are needed; among equals, the best data are the fewest.
    k = int(np.argmax(clean))
    return required_iterations(int(among[k]), int(sizes[k]), sample_size, config), int(sizes[k])


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
    median = np.partition(inliers, len(inliers) // 2)[len(inliers) // 2]
    scale = max(_MEDIANS * math.sqrt(float(median)), 1e-3 * problem.max_error)
    model = problem.improved(model, CAUCHY, scale, _FINAL_TOLERANCE)
    return model, problem.squared_errors(model)
