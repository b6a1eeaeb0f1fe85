"""What priors add to the normal equations of a problem, in its rows; see `prior_terms` for their residuals.

Camera parameters that are expected to be θ₀ with standard deviation σ add ½ ((θ − θ₀) / σ)².
"""

from __future__ import annotations

import numpy as np

from sfm.bundle.gauge import frame_centers
from sfm.bundle.layout import SENSOR_COLUMN, Layout
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
from sfm.core.geometry.rigid import Rigid3
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
        self._expected, self._weight = _parameter_priors(problem, layout)
        self._biases = bias_count(self._poses)
        _, terms = self._terms(problem.cams_from_world, frame_centers(problem), np.zeros((self._biases, 3)))
        first, second = self._rows_of(terms.first), self._rows_of(terms.second)
        self._first, self._second = np.flatnonzero(first >= 0), np.flatnonzero(second >= 0)
        self._both = np.flatnonzero((first >= 0) & (second >= 0))
        self._row, self._other = first, second
        shared = len(layout.slot_frame) + np.arange(len(layout.shared))
        rows, columns = first[self._both], second[self._both]
        self.targets = RowTerms(
            np.concatenate([shared, first[self._first], second[self._second], np.maximum(rows, columns)]),
            np.concatenate([shared, first[self._first], second[self._second], np.minimum(rows, columns)]),
        )
        self.count = int(np.sum(self._weight > 0)) + 3 * self._biases + _measured(problem)

    def linearize(
        self, poses: Rigid3, frame_centers: FloatArray, params: FloatArray, biases: FloatArray
    ) -> tuple[float, FloatArray, FloatArray]:
        """Cost, blocks (m, 6, 6) for `targets`, and gradient (rows, 6) of what is about poses and parameters."""
        cost, terms = self._terms(poses, frame_centers, biases)
        J1, J2 = terms.jacobian_first, terms.jacobian_second
        away = self._unexpected(params)
        crossed = np.einsum("kca,kcb->kab", J1[self._both], J2[self._both])
        upper = self._row[self._both] < self._other[self._both]
        crossed[upper] = crossed[upper].transpose(0, 2, 1)
        blocks = np.concatenate([
            self._weight[:, :, None] * np.eye(BLOCK),
            np.einsum("kca,kcb->kab", J1[self._first], J1[self._first]),
            np.einsum("kca,kcb->kab", J2[self._second], J2[self._second]),
            crossed,
        ])  # fmt: skip
        gradient = np.zeros((self._layout.rows, BLOCK))
        gradient[len(self._layout.slot_frame) :] = self._weight * away
        for J, mine, row in ((J1, self._first, self._row), (J2, self._second, self._other)):
            np.add.at(gradient, row[mine], np.einsum("kca,kc->ka", J[mine], terms.residuals[mine]))
        return cost + self._parameter_cost(params), blocks, gradient

    def linearize_points(self, points3D: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Cost, information (P, 6) and gradient (P, 3) of what is about points; zero for points that do not move."""
        cost, V, g = linearize_point_priors(self._points, points3D)
        return cost, np.where(self._seen[:, None], V, 0.0), np.where(self._seen[:, None], g, 0.0)

    def cost(self, poses: Rigid3, params: FloatArray, biases: FloatArray, points3D: FloatArray) -> float:
        """The cost alone."""
        total = self._parameter_cost(params)
        if self._points:
            total += point_prior_cost(self._points, points3D)
        if self._poses:
            total += prior_cost(self._poses, poses.rotation.matrix, poses.center, biases)
        return total

    @property
    def is_about_points(self) -> bool:
        """Whether a prior is about points."""
        return bool(self._points)

    def _terms(self, poses: Rigid3, centers: FloatArray, biases: FloatArray) -> tuple[float, PriorTerms]:
        if not self._poses:
            none = np.zeros(0, np.int32)
            return 0.0, PriorTerms(np.zeros((0, 3)), none, none, np.zeros((0, 3, 6)), np.zeros((0, 3, 6)))
        cost, terms = linearize_priors(self._poses, poses.rotation.matrix, poses.center, biases)
        if self._rigs is not None:
            frames = self._layout.image_frame
            terms = on_frames(terms, frames, poses.center - centers[frames], len(self._layout.frame_slot))
        return cost, terms

    def _rows_of(self, numbers: np.ndarray) -> np.ndarray:
        """Rows of the unknowns of terms, −1 for none and for what does not move."""
        layout, frames = self._layout, len(self._layout.frame_slot)
        rows = np.full(len(numbers), -1)
        posed = (numbers >= 0) & (numbers < frames)
        rows[posed] = layout.frame_slot[numbers[posed]]
        biases = len(layout.slot_frame) + np.flatnonzero(layout.shared.bias >= 0)
        rows[numbers >= frames] = biases[numbers[numbers >= frames] - frames]
        return rows

    def _unexpected(self, params: FloatArray) -> FloatArray:
        """θ − θ₀ (T, 6) of the free camera parameters that have a prior, 0 for the others."""
        return np.where(self._weight > 0, _values(params, self._layout) - self._expected, 0.0)

    def _parameter_cost(self, params: FloatArray) -> float:
        return 0.5 * float(np.sum(self._weight * self._unexpected(params) ** 2))


def motions_seen(problem: BundleProblem, layout: Layout, tangents: FloatArray) -> FloatArray:
    """(n, 7) what priors see of motions of the whole scene: their residuals' derivatives, rows of length 1.

    Args:
        tangents: (F, 6, 7) by which the frames move; a point X moves by  a × X + b + c X.
    """
    known = Knowledge(problem, layout)
    _, terms = known._terms(problem.cams_from_world, frame_centers(problem), np.zeros((known._biases, 3)))
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


def _values(params: FloatArray, layout: Layout) -> FloatArray:
    """(T, 6) the parameters in the places of the shared rows; anything where there is none."""
    columns = np.where(layout.shared.columns < SENSOR_COLUMN, np.maximum(layout.shared.columns, 0), 0)
    return params[np.maximum(layout.shared.camera, 0)[:, None], columns] if len(params) else np.zeros(columns.shape)


def _parameter_priors(problem: BundleProblem, layout: Layout) -> tuple[FloatArray, FloatArray]:
    """Expected values and inverse variances (T, 6) of the free parameters in the shared rows."""
    if problem.prior_params is None or problem.prior_sigmas is None:
        return np.zeros(layout.shared.columns.shape), np.zeros(layout.shared.columns.shape)
    is_param = (layout.shared.columns >= 0) & (layout.shared.camera >= 0)[:, None]
    weight = _values(problem.prior_sigmas, layout) ** -2.0
    return _values(problem.prior_params, layout), np.where(is_param, weight, 0.0)


def _measured(problem: BundleProblem) -> int:
    """Numbers that were measured of poses and points."""
    count = 0
    for prior in problem.priors:
        match prior:
            case GravityPrior():
                count += 2 * len(prior.images)
            case DistancePrior():
                count += len(prior.first)
            case _:
                count += int(np.isfinite(np.einsum("kaa->ka", prior.covariances)).sum())
    return count
