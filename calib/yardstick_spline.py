"""A lens that follows any smooth one: a spline over the image on top of a calibrated camera, with poses and board.

A point that the camera sees at q is seen at

    q + Σ_k B_k(q) c_k

with B_k bicubic B-splines on a regular grid of knots over the image, and c_k in px. What the camera's own coefficients
could do the spline does as well, so that they are held. With whitened residuals r the problem is

    least   Σ |r|² + (Σ |Δ²c|² + Σ |c|² / 9) / κ²      over c, all poses and the shape of the board

for r in units of a corner's standard deviation: neighbouring knots may depart from a straight line by about κ of these.
Where no board was shown that alone decides, and the spline goes on straight. Poses are eliminated as in
`refine_system`; all other derivatives are sparse, 16 knots and one point of the board for each corner.

Reference:
    Kogan, mrcal, Splined stereographic lens model (documentation): the idea; it has no camera below the spline.
    Eilers & Marx, Flexible smoothing with B-splines and penalties, 1996: differences of coefficients as penalty.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from jaxtyping import Float64
from scipy import sparse

from calib.refine_board import BoardShape
from calib.refine_system import Estimate
from calib.refine_views import Observations
from sfm.core.arrays import BoolArray, FloatArray, Points2D, Points3D, Value, Vector, readonly
from sfm.core.cameras import Camera
from sfm.core.geometry.rotation import Rotation3, skew
from sfm.core.optim.levenberg_marquardt import Trial

_LOOSE = 8.0
"""κ: half of it halves what is followed of lenses that are off by 0.1 to 0.3 px, twice of it costs more."""
_FAR = 3.0
"""Root of the weight of bends over that of displacements themselves."""
_BEYOND = 0.05
"""Of the image's size that the grid goes beyond it on each side; a projection may lie a little outside."""


@dataclasses.dataclass(frozen=True, slots=True)
class Knots:
    """A regular grid over an image: so many cells across and down, and three knots more each way."""

    width: int
    height: int
    across: int = 7
    down: int = 5

    @property
    def count(self) -> int:
        """Of knots."""
        return (self.across + 3) * (self.down + 3)

    def weights(self, points2D: Points2D) -> tuple[np.ndarray, FloatArray, FloatArray, FloatArray]:
        """(n, 16) numbers of knots, their weights at these points, and derivatives of the weights by x and y, 1/px."""
        i, wx, dx = _cubic(points2D[:, 0] / self.width, self.across)
        j, wy, dy = _cubic(points2D[:, 1] / self.height, self.down)
        four = np.arange(4)
        at = (j[:, None, None] + four[:, None]) * (self.across + 3) + i[:, None, None] + four
        products = ((wy, wx), (wy, dx / self.width), (dy / self.height, wx))
        w, by_x, by_y = ((v[:, :, None] * u[:, None, :]).reshape(-1, 16) for v, u in products)
        return at.reshape(-1, 16), w, by_x, by_y

    def penalty(self) -> FloatArray:
        """(m, m) the quadratic form of the penalty, for one coordinate of the coefficients and κ = 1."""
        total = np.eye(self.count) / _FAR**2
        for k in range(3):
            down, across = (np.diff(np.eye(n + 3), k_, axis=0) for n, k_ in ((self.down, k), (self.across, 2 - k)))
            part = np.kron(down, across)
            total += math.comb(2, k) * part.T @ part
        return total


def _cubic(x: Vector, cells: int) -> tuple[np.ndarray, FloatArray, FloatArray]:
    """Of x, from 0 to 1 over the image: (n,) the first knot, (n, 4) weights, (n, 4) their derivatives by x."""
    scale = cells / (1 + 2 * _BEYOND)
    u = np.nan_to_num((x + _BEYOND) * scale)
    i = np.clip(np.floor(u), 0, cells - 1).astype(np.int64)
    inside = (u >= 0) & (u <= cells)
    f = np.clip(u - i, 0.0, 1.0)
    g = 1 - f
    w = np.stack([g**3, 3 * f**3 - 6 * f**2 + 4, 3 * g**3 - 6 * g**2 + 4, f**3], 1) / 6
    d = np.stack([-(g**2), 3 * f**2 - 4 * f, 4 * g - 3 * g**2, f**2], 1) / 2
    return i, w, d * (scale * inside)[:, None]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class SplinedLens(Value):
    """A camera and what is added to its pixels: coefficients (m, 2) px at the knots."""

    camera: Camera
    knots: Knots
    coefficients: Float64[np.ndarray, "m 2"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "coefficients", readonly(self.coefficients, (self.knots.count, 2)))

    @staticmethod
    def of(camera: Camera, across: int = 7, down: int = 5) -> SplinedLens:
        """The camera as it is."""
        knots = Knots(camera.width, camera.height, across, down)
        return SplinedLens(camera, knots, np.zeros((knots.count, 2)))

    def project(self, points3D: Points3D) -> tuple[Points2D, Float64[np.ndarray, "n 2 3"], BoolArray]:
        """Pixels of points of the camera frame, derivatives of these by the points, and which are seen."""
        points2D, by_point, _, seen = self.camera.project_with_jacobians(points3D)
        at, w, by_x, by_y = self.knots.weights(points2D)
        c = self.coefficients[at]
        bend = np.eye(2) + np.stack([_summed(by_x, c), _summed(by_y, c)], 2)
        return points2D + _summed(w, c), bend @ by_point, seen


def _summed(weights: FloatArray, values: FloatArray) -> FloatArray:
    return np.einsum("nk,nkd->nd", weights, values)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """What is estimated, and its cost and (n, 2) residuals, px."""

    lens: SplinedLens
    rotations: FloatArray
    translations: FloatArray
    shape: BoardShape
    cost: float
    residuals: FloatArray


class SplinedSystem:
    """A `sfm.core.optim.levenberg_marquardt.System`: the spline, all poses, and the board where its shape is free.

    Args:
        estimate: start of poses and board; its camera is that of `lens`, and held.
        sigma_px: of one coordinate of a corner.
        poses_only: holds spline and board.
    """

    def __init__(
        self, observations: Observations, lens: SplinedLens, estimate: Estimate, sigma_px: float, *,
        poses_only: bool = False,
    ) -> None:  # fmt: skip
        self.observations = observations
        self._knots, self._poses_only = (0 if poses_only else lens.knots.count), poses_only
        self._penalty = lens.knots.penalty() / _LOOSE**2
        self._sigma = sigma_px
        basis = estimate.shape.basis[:, :, : 0 if poses_only else None]
        self._basis = basis.reshape(3 * len(basis), basis.shape[2])
        a, b, c = observations.roots.T / sigma_px
        rows = np.arange(2 * len(a)).reshape(-1, 2)
        entries = (np.concatenate([a, b, c]), (rows.T[[0, 0, 1]].ravel(), rows.T[[0, 1, 1]].ravel()))
        self._whitening = sparse.csr_array(entries, shape=(rows.size, rows.size))
        self._now = self._at(lens, np.array(estimate.rotations), np.array(estimate.translations), estimate.shape)
        self._trial = self._now

    @property
    def lens(self) -> SplinedLens:
        """At the current parameters."""
        return self._now.lens

    @property
    def shape(self) -> BoardShape:
        """Of the board, at the current parameters."""
        return self._now.shape

    @property
    def residuals(self) -> FloatArray:
        """(n, 2) projected − observed, px."""
        return self._now.residuals

    @property
    def cost(self) -> float:
        """Half of what is to be least; inf where a corner is not seen."""
        return self._now.cost

    def linearize(self) -> tuple[float, float]:
        """Cost and largest entry of the gradient."""
        views, now = len(self.observations), self._now
        by_pose, by_shared = (self._whitening @ J for J in self._derivatives())
        r = self._whitening @ now.residuals.ravel()
        H = _product(by_pose, by_pose).reshape(views, 6, views, 6)
        self._H = H[np.arange(views), :, np.arange(views)]
        self._W = self._reduced(_product(by_pose, by_shared)).reshape(views, 6, -1)
        self._g = (by_pose.T @ r).reshape(views, 6)
        self._A = self._reduced(self._reduced(_product(by_shared, by_shared)).T)
        self._b = self._reduced((by_shared.T @ r)[None])[0]
        m = self._knots
        for k in range(2 if m else 0):
            part = slice(k * m, (k + 1) * m)
            self._A[part, part] += self._penalty
            self._b[part] += self._penalty @ (now.lens.coefficients[:, k] / self._sigma)
        return now.cost, float(max(np.abs(self._g).max(initial=0.0), np.abs(self._b).max(initial=0.0)))

    def try_step(self, damping: float) -> Trial | None:
        """Solves the damped normal equations with the poses eliminated, and evaluates there."""
        now, views = self._now, len(self.observations)
        by_view, by_shared = np.einsum("vii->vi", self._H), np.diag(self._A)
        try:
            damped = self._H + damping * by_view[:, :, None] * np.eye(6)
            Y = np.linalg.solve(damped, np.concatenate([self._W, self._g[:, :, None]], 2))
            W, Y = self._W.reshape(6 * views, -1), Y.reshape(6 * views, -1)
            L = np.linalg.cholesky(self._A + np.diag(damping * by_shared) - W.T @ Y[:, :-1])
            x = -np.linalg.solve(L.T, np.linalg.solve(L, self._b - W.T @ Y[:, -1]))
        except np.linalg.LinAlgError:
            return None
        steps = -(Y[:, -1] + Y[:, :-1] @ x).reshape(views, 6)
        if not (np.all(np.isfinite(steps)) and np.all(np.isfinite(x))):
            return None
        self._trial = self._moved(x, steps)
        slope = float(self._b @ x + np.sum(self._g * steps))
        square = damping * float(by_shared @ x**2 + np.sum(by_view * steps**2))
        norm = math.sqrt(float(x @ x + np.sum(steps**2)))
        size = math.sqrt(float(np.sum(now.translations**2)) + 3 * views)
        return Trial(self._trial.cost, 0.5 * (square - slope), norm, size)

    def accept(self) -> None:
        """Makes the last trial current."""
        self._now = self._trial

    def _reduced(self, columns: FloatArray) -> FloatArray:
        """Columns by (2 m + 3 P), of knots and points of the board, to those of what is estimated."""
        m = 2 * self._knots
        return np.concatenate([columns[:, :m] * self._sigma, columns[:, m:] @ self._basis], 1)

    def _moved(self, x: Vector, steps: FloatArray) -> _Point:
        now, m = self._now, 2 * self._knots
        turns = Rotation3.exp(steps[:, :3]).matrix
        lens, shape = now.lens, now.shape
        if not self._poses_only:
            moved = lens.coefficients + self._sigma * x[:m].reshape(2, -1).T
            lens = dataclasses.replace(lens, coefficients=moved)
            shape = dataclasses.replace(shape, coefficients=shape.coefficients + x[m:])
        translations = np.einsum("vij,vj->vi", turns, now.translations) + steps[:, 3:]
        return self._at(lens, turns @ now.rotations, translations, shape)

    def _in_camera(self, R: FloatArray, t: FloatArray, shape: BoardShape) -> FloatArray:
        o, view = self.observations, self.observations.view_of
        return np.einsum("nij,nj->ni", R[view], shape.points3D[o.rows]) + t[view]

    def _at(self, lens: SplinedLens, R: FloatArray, t: FloatArray, shape: BoardShape) -> _Point:
        points2D, _, seen = lens.project(self._in_camera(R, t, shape))
        residuals = points2D - self.observations.points2D
        whitened = self._whitening @ residuals.ravel()
        c = lens.coefficients / self._sigma
        penalty = 0.0 if self._poses_only else float(np.sum(c * (self._penalty @ c)))
        cost = 0.5 * (float(whitened @ whitened) + penalty)
        return _Point(lens, R, t, shape, cost if np.all(seen) and math.isfinite(cost) else math.inf, residuals)

    def _derivatives(self) -> tuple[sparse.csr_array, sparse.csr_array]:
        """Of residuals, row by row x and y, by poses (6 V) and by knots and points of the board (2 m + 3 P)."""
        o, now, m = self.observations, self._now, self._knots
        n, view = len(o.rows), self.observations.view_of
        points = self._in_camera(now.rotations, now.translations, now.shape)
        _, by_point, _ = now.lens.project(points)
        by_pose = np.concatenate([-by_point @ skew(points), by_point], 2)
        poses = _scattered(by_pose, 6 * view, 6 * len(o))
        parts = []
        if m:
            at, w, _, _ = now.lens.knots.weights(now.lens.camera.project(points)[0])
            rows = np.repeat(2 * np.arange(n), 16)
            parts += [sparse.csr_array((w.ravel(), (rows + k, at.ravel())), shape=(2 * n, m)) for k in range(2)]
        parts.append(_scattered(by_point @ now.rotations[view], 3 * o.rows, len(self._basis)))
        return poses, sparse.csr_array(sparse.hstack(parts))


def _product(left: sparse.csr_array, right: sparse.csr_array) -> FloatArray:
    """leftᵀ right."""
    return sparse.csr_array(left.T @ right).toarray()


def _scattered(blocks: FloatArray, first: np.ndarray, width: int) -> sparse.csr_array:
    """Blocks (n, 2, k), one below the other, each from its own first column on."""
    n, _, k = blocks.shape
    columns = np.repeat(first[:, None] + np.arange(k), 2, axis=0).ravel()
    return sparse.csr_array((blocks.ravel(), columns, np.arange(0, 2 * n * k + 1, k)), shape=(2 * n, width))
