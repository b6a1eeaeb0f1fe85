"""Focal lengths from fundamental matrices.

With the principal points known, F between images i and j and the true focal lengths give E = Kjᵀ F Ki, whose singular
values are (s, s, 0). Away from them the first two differ, and

    r(fi, fj) = (s₁² − s₂²) / (s₁² + s₂²)        in [0, 1), 0 for an essential matrix

measures by how much. One pair seldom fixes two focal lengths; all pairs of an image together do. The sum over pairs

    Σ w log(1 + (r / c)²)  +  Σ (log f/f₀)² / 2σ²

has many local minima in log f, so each unknown focal length in turn is moved to its best on a grid, until none moves;
from there a quasi-Newton method follows the long valleys that coordinates cannot. A camera that the pairs leave
undetermined stays at its guess f₀, held by the second term; it biases the others by a percent or two, which
adjustment mends.

References:
    Sweeney, Kneip, Höllerer & Turk, Computing similarity transformations from only image correspondences /
    Large scale SfM with the distributed camera model (view-graph calibration), ICCV 2015.
    Fetzer, Reis & Stricker, Stable intrinsic auto-calibration from fundamental matrices, WACV 2020.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.optimize import minimize

from sfm.core.arrays import FloatArray, Matrix3, Points2D
from sfm.core.cameras import Camera
from sfm.core.cameras.priors import DEFAULT_FOCAL_RATIO
from sfm.core.geometry.epipolar import essential_from_fundamental, pose_from_essential
from sfm.core.scene import PairKind, TwoViewGeometry, ViewGraph

_SWEEPS = 20
_STEP = 1e-5
"""Of the central differences, in log f."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class FocalConfig:
    """How unknown focal lengths are estimated."""

    min_factor: float = 0.3
    """Smallest focal length, as a multiple of the guess of 1.2 × the longer side: 150° of view."""
    max_factor: float = 4.0
    """Largest focal length, likewise: 12° of view."""
    residual_scale: float = 0.03
    """Disagreement c of a pair from which it counts less: noise of F on real photos."""
    log_sigma: float = 0.7
    """Trust in the guess: the standard deviation of log f, about a factor of two."""
    full_weight_inliers: int = 100
    """Pairs with fewer inliers count in proportion: their F is less certain."""
    max_uncalibrated_share: float = 0.2
    """Of the matches of a camera's pairs with known cameras, the share in uncalibrated pairs from which its focal
    length is doubted. With the right one it is 0.00 to 0.02 on real sets; with half or twice of it 0.29 to 0.92, but
    0.02 from a car that drives straight on, where E explains everything."""


def calibrate_focal_lengths(
    view_graph: ViewGraph,
    cameras: Mapping[int, Camera],
    image_cameras: Mapping[int, int],
    config: FocalConfig = FocalConfig(),
    *,
    doubt_known: bool = False,
) -> dict[int, Camera]:
    """The cameras, with better focal lengths for those that have none from EXIF or calibration.

    With `doubt_known` known ones are estimated anew, and no longer pass for known, if their pairs contradict them: EXIF
    can be wrong, e.g. in crops or behind a converter.

    Only perspective cameras, and pairs with a fundamental matrix, take part; pairs of two known cameras change
    nothing. The result does not depend on the order of the pairs.
    """
    pairs = [
        (image_cameras[i], image_cameras[j], geometry)
        for (i, j), geometry in view_graph.pairs.items()
        if geometry.kind in (PairKind.UNCALIBRATED, PairKind.CALIBRATED) and geometry.F is not None
    ]
    pairs = [p for p in pairs if not any(cameras[c].model_info.is_fisheye for c in p[:2])]
    if doubt_known:
        doubted = _doubted(view_graph, cameras, image_cameras, config)
        cameras = {c: _guessed(one) if c in doubted else one for c, one in cameras.items()}
    unknown = sorted({c for p in pairs for c in p[:2] if not cameras[c].has_prior_focal_length})
    if not unknown:
        return dict(cameras)
    log_factor = _search(_Terms.build(pairs, cameras, unknown, config), len(unknown), config)
    return dict(cameras) | {c: _scaled_focal(cameras[c], np.exp(x)) for c, x in zip(unknown, log_factor, strict=True)}


def _doubted(
    view_graph: ViewGraph, cameras: Mapping[int, Camera], image_cameras: Mapping[int, int], config: FocalConfig
) -> set[int]:
    """Known cameras whose pairs F explains and E does not; the worst first, as it makes its partners look bad."""
    known = {c for c, one in cameras.items() if one.has_prior_focal_length and not one.model_info.is_fisheye}
    doubted: set[int] = set()
    share = _uncalibrated_share(view_graph, image_cameras, known)
    suspects = {c for c, value in share.items() if value >= config.max_uncalibrated_share}
    while known:
        worst = max(sorted(known), key=lambda c: share.get(c, -1.0))
        if share.get(worst, 0.0) < config.max_uncalibrated_share:
            break
        doubted.add(worst)
        known.remove(worst)
        share = _uncalibrated_share(view_graph, image_cameras, known)
    # Where all are wrong, the last has nobody left to contradict it.
    return doubted | (suspects - share.keys())


def _uncalibrated_share(view_graph: ViewGraph, image_cameras: Mapping[int, int], known: set[int]) -> dict[int, float]:
    """Of the matches of each camera's pairs with known ones, itself included, the share in uncalibrated pairs."""
    matches: dict[int, int] = {}
    uncalibrated: dict[int, int] = {}
    for (i, j), geometry in view_graph.pairs.items():
        owners = {image_cameras[i], image_cameras[j]}
        if owners <= known and geometry.kind in (PairKind.CALIBRATED, PairKind.UNCALIBRATED):
            for c in owners:
                matches[c] = matches.get(c, 0) + len(geometry)
                uncalibrated[c] = uncalibrated.get(c, 0) + len(geometry) * (geometry.kind == PairKind.UNCALIBRATED)
    return {c: uncalibrated[c] / count for c, count in matches.items() if count}


def poses_under(
    view_graph: ViewGraph,
    keypoints: Mapping[int, Points2D],
    cameras: Mapping[int, Camera],
    image_cameras: Mapping[int, int],
) -> ViewGraph:
    """The view graph with the relative poses of uncalibrated pairs taken from F and these cameras.

    Calibrated pairs without a pose, as COLMAP leaves them in its database, get that of E.
    """
    pairs = dict(view_graph.pairs)
    for (i, j), geometry in view_graph.pairs.items():
        camera1, camera2 = cameras[image_cameras[i]], cameras[image_cameras[j]]
        if geometry.kind == PairKind.UNCALIBRATED and geometry.F is not None:
            essential = essential_from_fundamental(geometry.F, camera1.calibration_matrix, camera2.calibration_matrix)
        elif geometry.kind == PairKind.CALIBRATED and geometry.cam2_from_cam1 is None and geometry.E is not None:
            essential = geometry.E
        else:
            continue
        points = keypoints[i][geometry.matches[:, 0]], keypoints[j][geometry.matches[:, 1]]
        pairs[i, j] = _posed(geometry, essential, points, camera1, camera2)
    return ViewGraph(pairs)


def _posed(
    geometry: TwoViewGeometry,
    essential: Matrix3,
    points: tuple[Points2D, Points2D],
    camera1: Camera,
    camera2: Camera,
) -> TwoViewGeometry:
    (rays1, valid1), (rays2, valid2) = camera1.unproject(points[0]), camera2.unproject(points[1])
    valid = valid1 & valid2
    if not valid.any():
        return geometry
    pose, _ = pose_from_essential(essential, rays1[valid], rays2[valid])
    turned = pose.rotation @ rays1[valid]
    sine = np.linalg.norm(np.cross(turned, rays2[valid]), axis=1)
    angles = np.arctan2(sine, np.einsum("ni,ni->n", turned, rays2[valid]))
    return dataclasses.replace(geometry, cam2_from_cam1=pose, tri_angle=float(np.median(angles)))


def _guessed(camera: Camera) -> Camera:
    """The camera as if nothing were known of its focal length."""
    guess = DEFAULT_FOCAL_RATIO * max(camera.width, camera.height)
    return dataclasses.replace(_scaled_focal(camera, guess / camera.mean_focal_length), has_prior_focal_length=False)


def _scaled_focal(camera: Camera, factor: float) -> Camera:
    params = camera.params.copy()
    params[list(camera.model_info.focal_indices)] *= factor
    return dataclasses.replace(camera, params=params)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Terms:
    """Pairs in columns: E at the guessed focal lengths, rows of their unknown focal lengths (−1: known), weights."""

    essential: FloatArray
    first: np.ndarray
    second: np.ndarray
    weight: FloatArray
    config: FocalConfig

    @staticmethod
    def build(
        pairs: list[tuple[int, int, TwoViewGeometry]],
        cameras: Mapping[int, Camera],
        unknown: list[int],
        config: FocalConfig,
    ) -> _Terms:
        row = {camera_id: k for k, camera_id in enumerate(unknown)}
        used = [(c1, c2, g) for c1, c2, g in pairs if c1 in row or c2 in row]
        essential = [
            cameras[c2].calibration_matrix.T @ g.F @ cameras[c1].calibration_matrix
            for c1, c2, g in used
            if g.F is not None
        ]
        return _Terms(
            np.array(essential),
            np.array([row.get(c1, -1) for c1, _, _ in used]),
            np.array([row.get(c2, -1) for _, c2, _ in used]),
            np.array([min(1.0, len(g) / config.full_weight_inliers) for *_, g in used]),
            config,
        )

    def costs(self, rows: np.ndarray, first: FloatArray, second: FloatArray) -> FloatArray:
        """Cost (n, G) of pairs `rows` (n,) at log factors `first` and `second` (n, G); the singular values in closed
        form: s₁² and s₂² are the roots of λ² − aλ + b, a = tr EᵀE, b the second invariant (s₃ = 0)."""
        one, two = np.ones_like(first), np.ones_like(second)
        left = np.stack([np.exp(second), np.exp(second), two], -1)
        right = np.stack([np.exp(first), np.exp(first), one], -1)
        E = left[..., :, None] * self.essential[rows][:, None] * right[..., None, :]
        gram = np.swapaxes(E, -1, -2) @ E
        a = np.trace(gram, axis1=-2, axis2=-1)
        b = 0.5 * (a**2 - np.einsum("...ij,...ij->...", gram, gram))
        squared = np.clip(1 - 4 * b / a**2, 0.0, 1.0)
        return self.weight[rows][:, None] * np.log1p(squared / self.config.residual_scale**2)

    def camera_cost(self, camera: int, tried: FloatArray, log_factor: FloatArray) -> FloatArray:
        """Cost (G,) of all pairs of an unknown camera at log factors `tried` (G,), the others as they are."""
        rows = np.flatnonzero((self.first == camera) | (self.second == camera))
        known = np.append(log_factor, 0.0)  # row −1: a known focal length is not scaled
        first = np.where((self.first[rows] == camera)[:, None], tried, known[self.first[rows]][:, None])
        second = np.where((self.second[rows] == camera)[:, None], tried, known[self.second[rows]][:, None])
        return self.costs(rows, first, second).sum(0) + 0.5 * (tried / self.config.log_sigma) ** 2

    def total_cost(self, log_factor: FloatArray) -> float:
        """Cost of all pairs and guesses."""
        known = np.append(log_factor, 0.0)
        rows = np.arange(len(self.weight))
        pairs = self.costs(rows, known[self.first][:, None], known[self.second][:, None]).sum()
        return float(pairs + 0.5 * np.sum((log_factor / self.config.log_sigma) ** 2))

    def gradient(self, log_factor: FloatArray) -> FloatArray:
        """Of `total_cost`, by central differences: each log factor is in few pairs."""
        return np.array(
            [
                np.diff(self.camera_cost(c, x + _STEP * np.array([-1.0, 1.0]), log_factor))[0] / (2 * _STEP)
                for c, x in enumerate(log_factor)
            ]
        )


def _search(terms: _Terms, count: int, config: FocalConfig) -> FloatArray:
    """Log factors (count,) by coordinate descent on a grid, then by a quasi-Newton method from there."""
    x = np.zeros(count)
    grid = np.linspace(np.log(config.min_factor), np.log(config.max_factor), 61)
    order = np.argsort([-np.sum((terms.first == c) | (terms.second == c)) for c in range(count)], kind="stable")
    for _ in range(_SWEEPS):
        before = x.copy()
        for c in order.tolist():
            x[c] = grid[np.argmin(terms.camera_cost(c, grid, x))]
        if np.array_equal(x, before):
            break
    return minimize(terms.total_cost, x, jac=terms.gradient, method="L-BFGS-B").x
