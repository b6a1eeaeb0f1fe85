"""The problems of two views for the sampling loop: essential, fundamental and homography matrices."""

from __future__ import annotations

import numpy as np
from scipy.linalg import svd

from sfm.core.arrays import FloatArray, Points2D, Rays
from sfm.core.geometry.epipolar import decompose_essential
from sfm.core.geometry.minimal._five_point_kernels import five_point
from sfm.core.geometry.minimal._seven_point_kernels import four_point, seven_point
from sfm.core.robust import _manifold_kernels as manifold
from sfm.core.robust import _two_view_kernels as kernels


class TwoViewProblem:
    """Columns of correspondences and the largest error of an inlier, in the units of the columns."""

    kind: int
    sample_size: int
    dof: int

    def __init__(self, data: FloatArray, max_error: float) -> None:
        self.data, self.max_error, self.count = np.ascontiguousarray(data), max_error, data.shape[1]
        self._squares = np.empty(self.count)

    def best(self, models: FloatArray, score: float) -> tuple[int, float, int]:
        """See `Problem`."""
        return kernels.best_model(self.kind, self.data, models, self.max_error**2, score, self._squares)

    def squared_errors(self, model: FloatArray) -> FloatArray:
        """See `Problem`."""
        out = np.empty(self.count)
        kernels.squared_errors(self.kind, self.data, model, 0, self.count, out)
        return out

    def _epipolar_equations(
        self, model: FloatArray, tangent: FloatArray, loss: int, scale: float
    ) -> tuple[float, FloatArray, FloatArray]:
        hessian, gradient = np.zeros((self.dof, self.dof)), np.zeros(self.dof)
        cost = kernels.epipolar_normal_equations(
            self.kind, self.data, model, tangent, loss, scale**2, hessian, gradient
        )
        return cost, hessian, gradient


class EssentialProblem(TwoViewProblem):
    """x2ᵀ E x1 = 0 on rays, errors in px by the rays' derivatives. States are R, t with E = [t]× R."""

    kind, sample_size, dof = kernels.ESSENTIAL, 5, 5

    @staticmethod
    def from_rays(
        rays1: Rays, rays2: Rays, jacobians1: FloatArray, jacobians2: FloatArray, max_error: float
    ) -> EssentialProblem:
        """From unit rays and their derivatives (N, 3, 2) by the pixel."""
        columns = (rays1, rays2, jacobians1.reshape(-1, 6), jacobians2.reshape(-1, 6))
        return EssentialProblem(np.concatenate(columns, axis=1).T, max_error)

    def propose(self, samples: np.ndarray) -> FloatArray:
        """See `Problem`."""
        models = np.empty((10 * len(samples), 9))
        return models[: five_point(self.data, samples, models)]

    def state(self, model: FloatArray) -> FloatArray:
        """See `Problem`; any of the four decompositions serves, since all have the same E up to sign."""
        pose = decompose_essential(model.reshape(3, 3))[0]
        return np.concatenate([pose.rotation.matrix.ravel(), pose.translation])

    def model(self, state: FloatArray) -> FloatArray:
        """See `Problem`."""
        return manifold.essential_tangent(state)[0]

    def moved(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """See `Problem`."""
        return manifold.moved_essential(state, step)

    def normal_equations(self, state: FloatArray, loss: int, scale: float) -> tuple[float, FloatArray, FloatArray]:
        """See `Problem`."""
        return self._epipolar_equations(*manifold.essential_tangent(state), loss, scale)


class FundamentalProblem(TwoViewProblem):
    """x2ᵀ F x1 = 0 on points. States are U, V, σ with F = U diag(1, σ, 0) Vᵀ."""

    kind, sample_size, dof = kernels.FUNDAMENTAL, 7, 7

    def propose(self, samples: np.ndarray) -> FloatArray:
        """See `Problem`."""
        models = np.empty((3 * len(samples), 9))
        return models[: seven_point(self.data, samples, models)]

    def state(self, model: FloatArray) -> FloatArray:
        """See `Problem`."""
        u, s, vt = svd(model.reshape(3, 3), check_finite=False)
        return np.concatenate([u.ravel(), vt.T.ravel(), [s[1] / s[0]]])

    def model(self, state: FloatArray) -> FloatArray:
        """See `Problem`."""
        return manifold.fundamental_tangent(state)[0]

    def moved(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """See `Problem`."""
        return manifold.moved_fundamental(state, step)

    def normal_equations(self, state: FloatArray, loss: int, scale: float) -> tuple[float, FloatArray, FloatArray]:
        """See `Problem`."""
        return self._epipolar_equations(*manifold.fundamental_tangent(state), loss, scale)


class HomographyProblem(TwoViewProblem):
    """x2 ~ H x1 on points near the origin. States are H with H[2, 2] = 1."""

    kind, sample_size, dof = kernels.HOMOGRAPHY, 4, 8

    def propose(self, samples: np.ndarray) -> FloatArray:
        """See `Problem`."""
        models = np.empty((1 * len(samples), 9))
        return models[: four_point(self.data, samples, models)]

    def state(self, model: FloatArray) -> FloatArray:
        """See `Problem`; H[2, 2] vanishes only if the centre of the data is mapped to infinity."""
        return model / (model[8] if abs(model[8]) > 1e-9 else 1e-9)

    def model(self, state: FloatArray) -> FloatArray:
        """See `Problem`."""
        return state

    def moved(self, state: FloatArray, step: FloatArray) -> FloatArray:
        """See `Problem`."""
        moved = state.copy()
        moved[:8] += step
        return moved

    def normal_equations(self, state: FloatArray, loss: int, scale: float) -> tuple[float, FloatArray, FloatArray]:
        """See `Problem`."""
        hessian, gradient = np.zeros((8, 8)), np.zeros(8)
        cost = kernels.homography_normal_equations(self.data, state, loss, scale**2, hessian, gradient)
        return cost, hessian, gradient


def common_normalisation(points2D_1: Points2D, points2D_2: Points2D) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres both point sets and scales both by one number, so that errors of both images keep one unit.

    Returns:
        Columns (4, N) of normalised points, and the matrices T1, T2 with normalised = T pixel.
    """
    center1, center2 = points2D_1.mean(0), points2D_2.mean(0)
    spread = max(np.abs(points2D_1 - center1).mean(), np.abs(points2D_2 - center2).mean())
    scale = 1 / spread if spread > 0 else 1.0
    columns = np.concatenate([(points2D_1 - center1) * scale, (points2D_2 - center2) * scale], axis=1).T
    matrices = [np.array([[scale, 0, -scale * c[0]], [0, scale, -scale * c[1]], [0, 0, 1]]) for c in (center1, center2)]
    return columns, matrices[0], matrices[1]
