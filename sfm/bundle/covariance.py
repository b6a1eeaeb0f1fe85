"""How uncertain adjusted poses, camera parameters and points are.

At the minimum the inverse of the normal matrix is the covariance of what was estimated, if the residuals divided by
their standard deviations have variance 1. With the points eliminated as in `sfm.core.optim.schur`, the inverse of the
reduced matrix S is the covariance Σ of poses and shared parameters, and that of a point follows from it:

    Σ = S⁻¹        Σ_p = M_p + M_p E_pᵀ Σ E_p M_p

so the whole inverse, points against points, is never formed. What the scene as a whole may do (turn, move, grow) is
not determined by images. `two_cameras` measures everything relative to two images, whose own uncertainty is then
zero where they are held. `free` spreads it: with Q an orthonormal basis of these motions, as they move poses and
parameters, and S⁻ any inverse on what is left,

    Σ = (1 − Q Qᵀ) S⁻ (1 − Q Qᵀ)

is of all these covariances the one with the smallest sum of its diagonal. Motions that constant poses or points forbid
do not count.

References:
    Triggs et al., Bundle adjustment — a modern synthesis, 2000, §9 (gauge freedom).
    Polic, Förstner & Pajdla, Fast and accurate camera covariance computation for large 3D reconstruction, ECCV 2018.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float64
from scipy.linalg import get_lapack_funcs

from sfm.bundle import _covariance_kernels as kernels
from sfm.bundle.adjustment import system_of
from sfm.bundle.layout import Layout
from sfm.bundle.problem import BundleConfig, BundleProblem
from sfm.core.arrays import BoolArray, FloatArray, Value, readonly
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.errors import Rejected
from sfm.core.geometry.rotation import skew

_SINGULAR = 1e-12
"""Least pivot, of a matrix with ones on its diagonal, that is not a rounding error."""
_POINT_CONDITION = 1e10
"""Trace of the information about a point times that of its inverse, beyond which the point is not determined."""
_potrf, _potri = get_lapack_funcs(("potrf", "potri"), dtype=np.float64)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BundleCovariance(Value):
    """Covariances for residuals of the standard deviations that the problem states; 1 px where it states none.

    Attributes:
        poses: (I, 6, 6) of the tangent (ω, υ) of `cams_from_world`, radians and scene units, update on the left; zero
            where a pose is constant or held, NaN where no observation sees it.
        centers: (I, 3, 3) of the camera centres in the world.
        params: (C, 12, 12) of the camera parameters; zero where they are constant.
        points3D: (P, 3, 3); zero where a point is constant, NaN where its views do not determine it.
        variance_factor: twice the cost over the degrees of freedom. Where the stated standard deviations are only
            proportional to the true ones, all covariances times this are right; see `scaled`.
    """

    poses: Float64[np.ndarray, "I 6 6"]
    centers: Float64[np.ndarray, "I 3 3"]
    params: Float64[np.ndarray, "C K K"]
    points3D: Float64[np.ndarray, "P 3 3"]
    variance_factor: float

    def __post_init__(self) -> None:
        for name in ("poses", "centers", "params", "points3D"):
            object.__setattr__(self, name, readonly(getattr(self, name), (None, None, None), np.float64))

    def scaled(self, factor: float | None = None) -> BundleCovariance:
        """All covariances times `factor`, by default the variance factor; its own is then divided by it."""
        by = self.variance_factor if factor is None else factor
        scaled = {name: getattr(self, name) * by for name in ("poses", "centers", "params", "points3D")}
        return dataclasses.replace(self, **scaled, variance_factor=self.variance_factor / by)


def covariance(
    problem: BundleProblem, config: BundleConfig = BundleConfig(), *, threads: int = 1
) -> BundleCovariance | Rejected:
    """Covariances at the parameters of `problem`, which should be a minimum: the `problem` of a `BundleResult`.

    Takes some 32 N² bytes for N free pose and camera parameters.

    Returns:
        `undetermined_pose` or `undetermined_camera`, with the row of what the observations leave open as detail.
    """
    system, _ = system_of(problem, config, threads)
    layout, (cost, _) = system.layout, system.linearize()
    S, eliminated = system.information()
    motions = _motions(problem, layout)[: len(S)] if config.gauge == "free" else np.zeros((len(S), 0))
    sigma = _inverse(S, ~system.held, motions)
    if isinstance(sigma, int):
        return _undetermined(sigma, layout)
    points = np.zeros((len(problem.points3D), 3, 3))
    kernels.point_covariances(
        problem.free_points, layout.offsets, layout.starts, layout.obs_slot, layout.coupling_offsets,
        layout.coupling_slot, eliminated.W, eliminated.B, eliminated.V, eliminated.M, sigma, len(layout.slot_image),
        _POINT_CONDITION, points,
    )  # fmt: skip
    poses = _pose_blocks(problem, layout, sigma)
    R = problem.cams_from_world.rotation.matrix
    freedom = 2 * len(layout.image) + system.prior_count - system.free_count + motions.shape[1]
    return BundleCovariance(
        poses=poses,
        centers=np.einsum("iba,ibc,icd->iad", R, poses[:, 3:, 3:], R),
        params=_camera_blocks(problem, layout, sigma),
        points3D=points,
        variance_factor=2 * cost / freedom if freedom > 0 else float("nan"),
    )


def _inverse(S: FloatArray, free: BoolArray, motions: FloatArray) -> FloatArray | int:
    """Σ with zeros where entries are not `free`, or the entry that S leaves open beside the `motions` (N, m)."""
    rows = np.flatnonzero(free)
    if not len(rows):
        return np.zeros_like(S)
    S, basis = S[np.ix_(rows, rows)], np.linalg.qr(motions[rows])[0]
    diagonal = np.diag(S).copy()
    if not (diagonal > 0).all():
        return int(rows[np.argmin(diagonal > 0)])
    scale = 1 / np.sqrt(diagonal)
    scaled = np.linalg.qr(motions[rows] / scale[:, None])[0]
    full = S * scale * scale[:, None] + scaled @ scaled.T
    factor, failed = _potrf(full, lower=1)
    if failed or (np.diag(factor) ** 2).min() < _SINGULAR:
        return int(rows[np.argmax(np.abs(np.linalg.eigh(full)[1][:, 0]))])
    inverse, _ = _potri(factor, lower=1)
    inverse = (np.tril(inverse) + np.tril(inverse, -1).T) * scale * scale[:, None]
    inverse -= basis @ (basis.T @ inverse)
    inverse -= (inverse @ basis) @ basis.T
    sigma = np.zeros((len(free), len(free)))
    sigma[np.ix_(rows, rows)] = inverse
    return sigma


def _motions(problem: BundleProblem, layout: Layout) -> FloatArray:
    """Columns that span the motions of the whole scene, as the tangents of the moving poses and zeros for cameras.

    A point x of the world moves by  ω × x + τ + σ x , a pose (R, t) by  −R ω  and  (R ω) × t − R τ + σ t .
    """
    poses, points = problem.cams_from_world, problem.points3D
    R, t = poses.rotation.matrix, poses.translation
    tangents = np.zeros((len(t), 6, 7))
    tangents[:, :3, :3] = -R
    tangents[:, 3:, :3] = -skew(t) @ R
    tangents[:, 3:, 3:6] = -R
    tangents[:, 3:, 6] = t
    seen = np.bincount(layout.image, minlength=len(t)) > 0
    constant = np.unique(layout.point[~problem.free_points[layout.point]])
    fixed = np.concatenate([-skew(points[constant]), np.broadcast_to(np.eye(3), (len(constant), 3, 3)),
                            points[constant][:, :, None]], axis=2)  # fmt: skip
    held = np.concatenate([tangents[seen & ~problem.free_poses].reshape(-1, 7), fixed.reshape(-1, 7)])
    _, sizes, directions = np.linalg.svd(np.concatenate([held, np.zeros((7, 7))]))
    allowed = directions[sizes <= 1e-9 * max(float(sizes.max()), 1e-300)].T
    free = tangents[layout.slot_image].reshape(-1, 7) @ allowed
    cameras = len(layout.slot_camera) * layout.columns.shape[1]
    return np.concatenate([free, np.zeros((cameras, allowed.shape[1]))])


def _pose_blocks(problem: BundleProblem, layout: Layout, sigma: FloatArray) -> FloatArray:
    blocks = np.zeros((len(problem.image_cameras), 6, 6))
    blocks[problem.free_poses] = np.nan
    for slot, image in enumerate(layout.slot_image):
        mine = slice(6 * slot, 6 * slot + 6)
        blocks[image] = sigma[mine, mine]
    return blocks


def _camera_blocks(problem: BundleProblem, layout: Layout, sigma: FloatArray) -> FloatArray:
    blocks, width = np.zeros((len(problem.model_ids), MAX_PARAMS, MAX_PARAMS)), layout.columns.shape[1]
    for slot, camera in enumerate(layout.slot_camera):
        columns = layout.columns[camera][layout.columns[camera] >= 0]
        first = 6 * len(layout.slot_image) + width * slot
        mine = slice(first, first + len(columns))
        blocks[camera][np.ix_(columns, columns)] = sigma[mine, mine]
    return blocks


def _undetermined(entry: int, layout: Layout) -> Rejected:
    """Whose parameter an entry of the reduced system is."""
    poses = 6 * len(layout.slot_image)
    if entry < poses:
        return Rejected("undetermined_pose", str(layout.slot_image[entry // 6]))
    return Rejected("undetermined_camera", str(layout.slot_camera[(entry - poses) // layout.columns.shape[1]]))
