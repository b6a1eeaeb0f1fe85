"""What priors add to the normal equations of a problem, in its rows; see `prior_terms` for their residuals.

Camera parameters that are expected to be θ₀ with standard deviation σ add ½ ((θ − θ₀) / σ)².
"""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.bundle.gauge import frame_centers
from sfm.bundle.layout import Layout
from sfm.bundle.prior_terms import (
    PriorTerms,
    bias_count,
    linearize_point_priors,
    linearize_priors,
    on_frames,
    point_prior_cost,
    prior_cost,
)
from sfm.bundle.priors import DistancePrior, GravityPrior, whitening
from sfm.bundle.problem import BundleProblem
from sfm.bundle.reduced import RowTerms
from sfm.core.arrays import FloatArray
from sfm.core.geometry.rotation import skew
from sfm.core.optim.block_pattern import BLOCK


class Knowledge:
    """The priors of one problem.

    Attributes:
        targets: the blocks of the reduced system that `blocks` has numbers for.
        count: of scalars that are expected to be something.
    """

    def __init__(self, problem: BundleProblem, layout: Layout) -> None:
        self._layout, self._rigs = layout, problem.rigs
        self._poses, self._points = problem.pose_priors, problem.point_priors
        self._seen = (np.diff(layout.offsets) > 0) & problem.free_points
        self._expected = _ExpectedParams.of(problem, layout)
        self._biases = bias_count(self._poses)
        terms = self._terms_at(problem)
        first, second = self._rows_of(terms.first), self._rows_of(terms.second)
        self._first, self._second = np.flatnonzero(first >= 0), np.flatnonzero(second >= 0)
        self._both = np.flatnonzero((first >= 0) & (second >= 0))
        self._row, self._other = first, second
        shared = self._expected.block_rows
        rows, columns = first[self._both], second[self._both]
        self.targets = RowTerms(
            np.concatenate([shared, first[self._first], second[self._second], np.maximum(rows, columns)]),
            np.concatenate([shared, first[self._first], second[self._second], np.minimum(rows, columns)]),
        )
        self.count = len(self._expected.weights) + 3 * self._biases + _measured(problem)

    def linearize(
        self, turns: FloatArray, centers: FloatArray, frame_centers: FloatArray, params: FloatArray, biases: FloatArray
    ) -> tuple[float, FloatArray, FloatArray]:
        """Cost, blocks (m, 6, 6) for `targets`, and gradient (rows, 6) of what is about poses and parameters.

        Args:
            turns, centers: (I, 3, 3) and (I, 3) of the images; frame_centers (F, 3).
        """
        gradient = np.zeros((self._layout.rows, BLOCK))
        cost = self._expected.linearize(params, gradient)
        if not self._poses:
            return cost, self._expected.blocks, gradient
        of_poses, terms = self._terms(turns, centers, frame_centers, biases)
        J1, J2 = terms.jacobian_first, terms.jacobian_second
        crossed = np.einsum("kca,kcb->kab", J1[self._both], J2[self._both])
        upper = self._row[self._both] < self._other[self._both]
        crossed[upper] = crossed[upper].transpose(0, 2, 1)
        blocks = np.concatenate([
            self._expected.blocks,
            np.einsum("kca,kcb->kab", J1[self._first], J1[self._first]),
            np.einsum("kca,kcb->kab", J2[self._second], J2[self._second]),
            crossed,
        ])  # fmt: skip
        for J, mine, row in ((J1, self._first, self._row), (J2, self._second, self._other)):
            np.add.at(gradient, row[mine], np.einsum("kca,kc->ka", J[mine], terms.residuals[mine]))
        return cost + of_poses, blocks, gradient

    def linearize_points(self, points3D: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Cost, information (P, 6) and gradient (P, 3) of what is about points; zero for points that do not move."""
        cost, V, g = linearize_point_priors(self._points, points3D)
        return cost, np.where(self._seen[:, None], V, 0.0), np.where(self._seen[:, None], g, 0.0)

    def cost(
        self, turns: FloatArray, centers: FloatArray, params: FloatArray, biases: FloatArray, points3D: FloatArray
    ) -> float:
        """The cost alone."""
        total = self._expected.cost(params)
        if self._points:
            total += point_prior_cost(self._points, points3D)
        if self._poses:
            total += prior_cost(self._poses, turns, centers, biases)
        return total

    @property
    def is_about_points(self) -> bool:
        """Whether a prior is about points."""
        return bool(self._points)

    def _terms(
        self, turns: FloatArray, centers: FloatArray, frame_centers: FloatArray, biases: FloatArray
    ) -> tuple[float, PriorTerms]:
        cost, terms = linearize_priors(self._poses, turns, centers, biases)
        if self._rigs is not None:
            frames = self._layout.image_frame
            terms = on_frames(terms, frames, centers - frame_centers[frames], len(self._layout.frame_slot))
        return cost, terms

    def _terms_at(self, problem: BundleProblem) -> PriorTerms:
        if not self._poses:
            none = np.zeros(0, np.int32)
            return PriorTerms(np.zeros((0, 3)), none, none, np.zeros((0, 3, 6)), np.zeros((0, 3, 6)))
        poses, biases = problem.cams_from_world, np.zeros((self._biases, 3))
        return self._terms(poses.rotation.matrix, poses.center, frame_centers(problem), biases)[1]

    def _rows_of(self, numbers: np.ndarray) -> np.ndarray:
        """Rows of the unknowns of terms, −1 for none and for what does not move."""
        layout, frames = self._layout, len(self._layout.frame_slot)
        rows = np.full(len(numbers), -1)
        posed = (numbers >= 0) & (numbers < frames)
        rows[posed] = layout.frame_slot[numbers[posed]]
        biases = len(layout.slot_frame) + np.flatnonzero(layout.shared.bias >= 0)
        rows[numbers >= frames] = biases[numbers[numbers >= frames] - frames]
        return rows


def motions_seen(problem: BundleProblem, layout: Layout, tangents: FloatArray) -> FloatArray:
    """(n, 7) what priors see of motions of the whole scene: their residuals' derivatives, rows of length 1.

    Args:
        tangents: (F, 6, 7) by which the frames move; a point X moves by  a × X + b + c X.
    """
    known = Knowledge(problem, layout)
    terms = known._terms_at(problem)
    frames = len(tangents)
    rows = np.zeros((len(terms.first), 3, 7))
    for number, jacobian in ((terms.first, terms.jacobian_first), (terms.second, terms.jacobian_second)):
        posed = (number >= 0) & (number < frames)
        rows[posed] += jacobian[posed] @ tangents[number[posed]]
    seen = [rows.reshape(-1, 7)]
    for prior in problem.point_priors:
        X = problem.points3D[prior.points]
        moved = np.concatenate([-skew(X), np.broadcast_to(np.eye(3), (len(X), 3, 3)), X[:, :, None]], axis=2)
        seen.append((whitening(prior.covariances) @ moved).reshape(-1, 7))
    rows = np.concatenate(seen)
    lengths = np.linalg.norm(rows, axis=1)
    return rows[lengths > 0] / lengths[lengths > 0][:, None]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _ExpectedParams:
    """The free camera parameters that are expected to be something, K of them.

    Attributes:
        cells: camera and column of each; places: its row of six and its place there.
        expected, weights: (K,) θ₀ and 1 / σ².
        block_rows, blocks: (m,) rows with such parameters, and what they add on the diagonal of S, (m, 6, 6).
    """

    cells: tuple[np.ndarray, np.ndarray]
    places: tuple[np.ndarray, np.ndarray]
    expected: FloatArray
    weights: FloatArray
    block_rows: np.ndarray
    blocks: FloatArray

    @staticmethod
    def of(problem: BundleProblem, layout: Layout) -> _ExpectedParams:
        camera, column, row, place = layout.parameters
        expected = weights = np.zeros(0)
        if problem.prior_params is not None and problem.prior_sigmas is not None:
            expected, weights = problem.prior_params[camera, column], problem.prior_sigmas[camera, column] ** -2.0
        known = np.flatnonzero(weights > 0)
        row, place, weights = row[known], place[known], weights[known]
        rows, number = np.unique(row, return_inverse=True)
        blocks = np.zeros((len(rows), BLOCK, BLOCK))
        blocks[number, place, place] = weights
        return _ExpectedParams((camera[known], column[known]), (row, place), expected[known], weights, rows, blocks)

    def linearize(self, params: FloatArray, gradient: FloatArray) -> float:
        """The cost, and its gradient into that of all rows (rows, 6)."""
        away = params[self.cells] - self.expected
        weighted = self.weights * away
        gradient[self.places] = weighted
        return 0.5 * float((weighted * away).sum())

    def cost(self, params: FloatArray) -> float:
        """½ Σ ((θ − θ₀) / σ)²."""
        away = params[self.cells] - self.expected
        return 0.5 * float((self.weights * away * away).sum())


def _measured(problem: BundleProblem) -> int:
    """Numbers that were measured of poses and points."""
    count = 0
    for prior in (*problem.pose_priors, *problem.point_priors):
        match prior:
            case GravityPrior():
                count += 2 * len(prior.images)
            case DistancePrior():
                count += len(prior.first)
            case _:
                count += int(np.isfinite(np.einsum("kaa->ka", prior.covariances)).sum())
    return count
