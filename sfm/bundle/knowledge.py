"""What priors add to the normal equations of a problem, in its rows; see `prior_terms` for their residuals.

Camera parameters that are expected to be θ₀ with standard deviation σ add ½ ((θ − θ₀) / σ)².
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np

from sfm.bundle.gauge import frame_centers
from sfm.bundle.layout import Layout
from sfm.bundle.mounted_terms import by_sensors, on_frames
from sfm.bundle.own_blocks import RowTerms
from sfm.bundle.prior_terms import (
    PriorTerms,
    bias_count,
    linearize_point_priors,
    linearize_priors,
    point_prior_cost,
    prior_cost,
)
from sfm.bundle.priors import DistancePrior, GravityPrior, whitening
from sfm.bundle.problem import BundleProblem
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
        self._rows = self._rows_of(self._terms_at(problem))
        self._pieces = [np.flatnonzero(rows >= 0) for rows in self._rows]
        self._pairs = [
            (a, b, np.flatnonzero((self._rows[a] >= 0) & (self._rows[b] >= 0)))
            for a, b in itertools.combinations(range(len(self._rows)), 2)
        ]
        own = [self._expected.block_rows] + [rows[mine] for rows, mine in zip(self._rows, self._pieces, strict=True)]
        ends = [(self._rows[a][both], self._rows[b][both]) for a, b, both in self._pairs]
        self.targets = RowTerms(
            np.concatenate(own + [np.maximum(*pair) for pair in ends]),
            np.concatenate(own + [np.minimum(*pair) for pair in ends]),
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
        J = terms.jacobians
        blocks = [self._expected.blocks]
        blocks += [J[a][mine].transpose(0, 2, 1) @ J[a][mine] for a, mine in enumerate(self._pieces)]
        for a, b, both in self._pairs:
            crossed = J[a][both].transpose(0, 2, 1) @ J[b][both]
            mirrored = crossed.transpose(0, 2, 1)
            one, other = self._rows[a][both, None, None], self._rows[b][both, None, None]
            blocks.append(np.where(one > other, crossed, mirrored) + np.where(one == other, crossed, 0.0))
        for a, mine in enumerate(self._pieces):
            pull = np.einsum("kca,kc->ka", J[a][mine], terms.residuals[mine])
            np.add.at(gradient, self._rows[a][mine], pull)
        return cost + of_poses, np.concatenate(blocks), gradient

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
    ) -> tuple[float, _Terms]:
        cost, terms = linearize_priors(self._poses, turns, centers, biases)
        if self._rigs is None:
            return cost, _Terms(terms.residuals, (terms.first, terms.second), _jacobians(terms))
        frames = self._layout.image_frame
        mounted = on_frames(terms, frames, centers - frame_centers[frames], len(self._layout.frame_slot))
        numbers, jacobians = (mounted.first, mounted.second), _jacobians(mounted)
        if np.any(self._rigs.free_sensors):
            images = len(turns)
            mounts = tuple(np.where(n < images, n, -1) for n in (terms.first, terms.second))
            numbers, jacobians = (*numbers, *mounts), (*jacobians, *by_sensors(terms, turns))
        return cost, _Terms(terms.residuals, numbers, jacobians)

    def _terms_at(self, problem: BundleProblem) -> _Terms:
        if not self._poses:
            none = np.zeros((0, 3, 6))
            return _Terms(np.zeros((0, 3)), (np.zeros(0, np.int32),) * 2, (none, none))
        poses, biases = problem.cams_from_world, np.zeros((self._biases, 3))
        return self._terms(poses.rotation.matrix, poses.center, frame_centers(problem), biases)[1]

    def _rows_of(self, terms: _Terms) -> list[np.ndarray]:
        """Rows of the unknowns of terms, −1 for none and for what does not move."""
        layout, frames = self._layout, len(self._layout.frame_slot)
        biases = len(layout.slot_frame) + np.flatnonzero(layout.shared.bias >= 0)
        found = []
        for numbers in terms.numbers[:2]:
            rows = np.full(len(numbers), -1)
            posed = (numbers >= 0) & (numbers < frames)
            rows[posed] = layout.frame_slot[numbers[posed]]
            rows[numbers >= frames] = biases[numbers[numbers >= frames] - frames]
            found.append(rows)
        sensors = layout.image_sensor_row
        return found + [np.where(images >= 0, sensors[images], -1) for images in terms.numbers[2:]]


class _Terms(NamedTuple):
    """Residuals of n terms and their derivatives by two unknowns, or by four.

    Attributes:
        residuals: (n, 3).
        numbers: (n,) each; of two frames or biases as in `prior_terms`, then of the two images whose sensors may move.
        jacobians: (n, 3, 6) each.
    """

    residuals: FloatArray
    numbers: tuple[np.ndarray, ...]
    jacobians: tuple[FloatArray, ...]


def _jacobians(terms: PriorTerms) -> tuple[FloatArray, ...]:
    return terms.jacobian_first, terms.jacobian_second


def motions_seen(problem: BundleProblem, layout: Layout, tangents: FloatArray, shared: FloatArray) -> FloatArray:
    """(n, 7) what priors see of motions of the whole scene: their residuals' derivatives, rows of length 1.

    Args:
        tangents: (F, 6, 7) by which the frames move; a point X moves by  a × X + b + c X.
        shared: (T, 6, 7) by which the shared rows do.
    """
    known = Knowledge(problem, layout)
    terms, sensors = known._terms_at(problem), known._rows[2:]
    frames, poses = len(tangents), len(layout.slot_frame)
    rows = np.zeros((len(terms.residuals), 3, 7))
    for number, jacobian in zip(terms.numbers[:2], terms.jacobians, strict=False):
        posed = (number >= 0) & (number < frames)
        rows[posed] += jacobian[posed] @ tangents[number[posed]]
    for row, jacobian in zip(sensors, terms.jacobians[2:], strict=True):
        rows[row >= 0] += jacobian[row >= 0] @ shared[row[row >= 0] - poses]
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
