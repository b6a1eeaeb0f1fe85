"""How uncertain adjusted poses, camera parameters and points are.

At the minimum the inverse of the normal matrix is the covariance of what was estimated, if the residuals divided by
their standard deviations have variance 1. With the points eliminated as in `sfm.core.optim.schur`, the inverse of the
reduced matrix S is the covariance Σ of poses and shared parameters, and that of a point follows from it:

    Σ = S⁻¹        Σ_p = M_p + M_p E_pᵀ Σ E_p M_p

so the whole inverse, points against points, is never formed. What the scene as a whole may do (turn, move, grow) is
not determined by images. `two_cameras` measures everything relative to two images, `three_points` to three points,
whose own uncertainty is then zero where they are held. `free` spreads it: with Q an orthonormal basis of these motions,
as they move poses and parameters, and S⁻ any inverse on what is left,

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
from sfm.bundle.gauge import frame_centers, held_by_three_points
from sfm.bundle.knowledge import motions_seen
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
        params: (C, K, K) of the camera parameters; zero where they are constant.
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

    Takes some 32 N² bytes for N free entries of poses, cameras and sensors.

    Returns:
        `undetermined_pose`, `undetermined_camera` or `undetermined_sensor`, with the row of what the observations leave
        open as detail.
    """
    system, _ = system_of(problem, dataclasses.replace(config, solver="dense"), threads)
    layout, (cost, _) = system.layout, system.linearize()
    held = held_by_three_points(problem, layout) if config.gauge == "three_points" else None
    known = system.information(held)
    motions = _motions(problem, layout)
    if config.gauge != "free":
        motions = motions[:, :0]
    sigma = _inverse(known.reduced, ~system.held.ravel(), motions)
    if isinstance(sigma, int):
        return _undetermined(sigma, problem, layout)
    points = np.zeros((len(problem.points3D), 3, 3))
    kernels.point_covariances(
        system.free_points, layout.offsets, *known.couplings, known.centers, system.points3D, known.V, known.M, sigma,
        _POINT_CONDITION, points,
    )  # fmt: skip
    freedom = 2 * len(layout.image) + system.prior_count - system.free_count + motions.shape[1]
    freedom += sum(3 - basis.shape[1] for basis in held.bases) if held is not None else 0
    poses, centers = _pose_blocks(problem, layout, sigma)
    return BundleCovariance(
        poses=poses,
        centers=centers,
        params=_camera_blocks(layout, sigma, len(problem.model_ids)),
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
    """Columns (6 rows, m) that span the motions of the whole scene, in the tangents of `sfm.bundle.system`.

    A point X of the world moves by  a × X + b + c X , a frame with centre C turns by  −a  and shifts by
    −(a × C + b + c C); parameters stay, and sensors shift on their rigs by  c t .
    """
    centers, points, poses = frame_centers(problem), problem.points3D, len(layout.slot_frame)
    tangents = np.zeros((len(centers), 6, 7))
    tangents[:, :3, :3] = -np.eye(3)
    tangents[:, 3:, :3] = skew(centers)
    tangents[:, 3:, 3:6] = -np.eye(3)
    tangents[:, 3:, 6] = -centers
    tangents[~np.isfinite(centers).all(axis=1)] = 0
    seen = np.bincount(layout.image_frame[layout.image], minlength=len(centers)) > 0
    constant = np.unique(layout.point[~problem.free_points[layout.point]])
    fixed = np.concatenate([-skew(points[constant]), np.broadcast_to(np.eye(3), (len(constant), 3, 3)),
                            points[constant][:, :, None]], axis=2)  # fmt: skip
    shared = np.zeros((len(layout.shared), 6, 7))
    forbidden = [tangents[seen & (layout.frame_slot < 0)].reshape(-1, 7), fixed.reshape(-1, 7), np.zeros((7, 7))]
    if problem.rigs is not None:
        mounted = layout.shared.sensor >= 0
        lengths = problem.rigs.sensors_from_rig.translation
        shared[mounted, 3:, 6] = lengths[layout.shared.sensor[mounted]]
        unmoved = np.zeros((np.sum(~problem.rigs.free_sensors), 3, 7))
        unmoved[:, :, 6] = lengths[~problem.rigs.free_sensors]
        forbidden.append(unmoved.reshape(-1, 7))
    forbidden += [motions_seen(problem, layout, tangents)]
    _, sizes, directions = np.linalg.svd(np.concatenate(forbidden))
    allowed = directions[sizes <= 1e-9 * max(float(sizes.max()), 1e-300)].T
    free = np.concatenate([tangents[layout.slot_frame], shared])
    return free.reshape(-1, 7)[: 6 * (poses + len(shared))] @ allowed


def _pose_blocks(problem: BundleProblem, layout: Layout, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariances (I, 6, 6) of the poses' tangents on the left, and of the centres (I, 3, 3).

    With the frame's tangent δ in world axes a camera moves by R [I, 0; −[c]×, I] δ, c from the frame's centre to its
    own, plus what its sensor's tangent μ adds.
    """
    poses = problem.cams_from_world
    blocks, centers = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 3, 3))
    blocks[problem.free_poses], centers[problem.free_poses] = np.nan, np.nan
    R, frames = poses.rotation.matrix, frame_centers(problem)
    seen = np.bincount(layout.image, minlength=len(poses)) > 0
    mounts = _sensor_rows(layout)
    for image in np.flatnonzero(seen):
        rows, columns = [], []
        if layout.image_slot[image] >= 0:
            turn = np.zeros((6, 6))
            turn[:3, :3] = turn[3:, 3:] = R[image]
            turn[3:, :3] = -R[image] @ skew(poses[image].center - frames[layout.image_frame[image]])
            rows.append(layout.image_slot[image])
            columns.append(turn)
        for row in layout.image_shared[image]:
            if row in mounts:
                rows.append(row)
                columns.append(np.eye(6))
        if not rows:
            blocks[image], centers[image] = 0.0, 0.0
            continue
        J = np.concatenate(columns, axis=1)
        index = np.concatenate([np.arange(6 * row, 6 * row + 6) for row in rows])
        blocks[image] = J @ sigma[np.ix_(index, index)] @ J.T
        centers[image] = R[image].T @ blocks[image][3:, 3:] @ R[image]
    return blocks, centers


def _sensor_rows(layout: Layout) -> set[int]:
    """Numbers of the rows that are tangents of sensors."""
    return {len(layout.slot_frame) + int(k) for k in np.flatnonzero(layout.shared.sensor >= 0)}


def _camera_blocks(layout: Layout, sigma: FloatArray, cameras: int) -> FloatArray:
    blocks = np.zeros((cameras, MAX_PARAMS, MAX_PARAMS))
    shared, first = layout.shared, len(layout.slot_frame)
    for camera in np.unique(shared.camera[shared.camera >= 0]):
        mine, place = np.nonzero((shared.columns >= 0) & (shared.camera == camera)[:, None])
        columns, entries = shared.columns[mine, place], 6 * (first + mine) + place
        blocks[camera][np.ix_(columns, columns)] = sigma[np.ix_(entries, entries)]
    return blocks


def _undetermined(entry: int, problem: BundleProblem, layout: Layout) -> Rejected:
    """Whose parameter an entry of the reduced system is."""
    row = entry // 6
    if row < len(layout.slot_frame):
        image = np.flatnonzero(layout.image_frame == layout.slot_frame[row])[0]
        return Rejected("undetermined_pose", str(image))
    shared = row - len(layout.slot_frame)
    if layout.shared.camera[shared] >= 0:
        return Rejected("undetermined_camera", str(layout.shared.camera[shared]))
    return Rejected("undetermined_sensor", str(layout.shared.sensor[shared]))
