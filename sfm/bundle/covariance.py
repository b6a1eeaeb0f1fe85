"""How uncertain adjusted poses, camera parameters and points are.

At the minimum the inverse of the normal matrix is the covariance of what was estimated, if the residuals divided by
their standard deviations have variance 1. With the points eliminated as in `sfm.core.optim.schur`, the inverse of the
reduced matrix S is the covariance Σ of poses and shared parameters, and that of a point follows from it:

    Σ = S⁻¹        Σ_p = M_p + M_p E_pᵀ Σ E_p M_p

so the whole inverse, points against points, is never formed; and of Σ only the blocks that these need, see `marginals`.
What the scene as a whole may do (turn, move, grow) is not determined by images. `two_cameras` measures everything
relative to two images, `three_points` to three points, whose own uncertainty is then zero where they are held. `free`
spreads it: with Q an orthonormal basis of these motions, as they move poses and parameters, and S⁻ any inverse on what
is left,

    Σ = (1 − Q Qᵀ) S⁻ (1 − Q Qᵀ)

is of all these covariances the one with the smallest sum of its diagonal. Motions that constant poses or points forbid
do not count. Where a bias of positions is all that holds the scene, see `drift`.

References:
    Triggs et al., Bundle adjustment — a modern synthesis, 2000, §9 (gauge freedom).
    Polic, Förstner & Pajdla, Fast and accurate camera covariance computation for large 3D reconstruction, ECCV 2018.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float64

from sfm.bundle import _covariance_kernels as kernels
from sfm.bundle.adjustment import system_of
from sfm.bundle.drift import drift_of
from sfm.bundle.gauge import frame_centers, held_by_three_points
from sfm.bundle.knowledge import Knowledge, motions_seen
from sfm.bundle.layout import Layout, lay_out
from sfm.bundle.marginals import Marginals
from sfm.bundle.problem import BundleConfig, BundleProblem
from sfm.bundle.solver_plan import plan_solver
from sfm.bundle.system import system_bytes
from sfm.core.arrays import FloatArray, Value, readonly
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.errors import Rejected
from sfm.core.execution import ordered_map
from sfm.core.geometry.rotation import skew
from sfm.core.optim.block_pattern import BLOCK

_POINT_CONDITION = 1e10
"""Trace of the information about a point times that of its inverse, beyond which the point is not determined."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BundleCovariance(Value):
    """Covariances for residuals of the standard deviations that the problem states; 1 px where it states none.

    Attributes:
        poses: (I, 6, 6) of the tangent (ω, υ) of `cams_from_world`, radians and scene units, update on the left; zero
            where a pose is constant or held, NaN where no observation sees it.
        centers: (I, 3, 3) of the camera centres in the world.
        params: (C, K, K) of the camera parameters; zero where they are constant or on a bound, which holds them.
        points3D: (P, 3, 3); zero where a point is constant, NaN where its views do not determine it.
        variance_factor: twice the cost over the degrees of freedom. Where the stated standard deviations are only
            proportional to the true ones, all covariances times this are right; see `scaled`. NaN where nothing is left
            over: no more residuals and priors than parameters.
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
        """All covariances times `factor`, by default the variance factor; its own is then divided by it.

        Right where residuals are all that is weighed: what priors state is not in proportion to them.

        Raises:
            ValueError: the factor is not positive and finite.
        """
        by = self.variance_factor if factor is None else factor
        if not 0 < by < np.inf:
            raise ValueError(f"the factor must be positive and finite, got {by}")
        scaled = {name: getattr(self, name) * by for name in ("poses", "centers", "params", "points3D")}
        return dataclasses.replace(self, **scaled, variance_factor=self.variance_factor / by)


def covariance(
    problem: BundleProblem,
    config: BundleConfig = BundleConfig(),
    *,
    biases: Float64[np.ndarray, "G 3"] | None = None,
    threads: int = 1,
) -> BundleCovariance | Rejected:
    """Covariances at the parameters of `problem`, which should be a minimum: the `problem` of a `BundleResult`.

    Takes a few times the time of a step of the adjustment with a factor, and memory as `covariance_bytes` says.

    Args:
        biases: those of position priors, as in a `BundleResult`; 0 without.

    Returns:
        `undetermined_pose`, `undetermined_camera`, `undetermined_sensor` or `undetermined_bias`, with the row of what
        the observations leave open as detail.
    """
    problem = dataclasses.replace(problem, free_params=problem.free_params & ~problem.at_bounds)
    system, _ = system_of(problem, _with_factor(config), threads)
    motions = _open_motions(problem, system.layout, config)
    drift = None
    if len(system.biases):
        system.biases[:] = 0.0 if biases is None else biases
        drift = drift_of(problem, system) if not motions.shape[1] else None
    if drift is not None:
        problem = drift.problem
        del system  # its memory is that of the next
        system, _ = system_of(problem, _with_factor(config), threads)
        motions = motions[: 6 * system.layout.rows]
    layout, (cost, _) = system.layout, system.linearize()
    held = held_by_three_points(problem, layout) if config.gauge == "three_points" else None
    known = system.information(held)
    sigma = system.inverse(motions)
    if isinstance(sigma, int):
        return _undetermined(sigma, layout)
    points = np.zeros((len(problem.points3D), 3, 3))
    list(ordered_map(
        lambda part: kernels.point_covariances(
            *part, system.free_points, layout.offsets, *known.couplings, known.centers, system.points3D, known.V,
            known.M, sigma.pattern.offsets, sigma.pattern.columns, sigma.blocks, _POINT_CONDITION, points,
        ),
        layout.point_chunks, threads=threads,
    ))  # fmt: skip
    freedom = 2 * len(layout.image) + system.prior_count - system.free_count + motions.shape[1]
    freedom += sum(3 - basis.shape[1] for basis in held.bases) if held is not None else 0
    poses, centers = _pose_blocks(problem, layout, sigma)
    if drift is not None:
        cost += drift.cost
        moving = layout.image_slot >= 0
        poses[moving, 3:, 3:] += drift.variance * np.eye(3)
        centers[moving] += drift.variance * np.eye(3)
        points[problem.free_points] += drift.variance * np.eye(3)
    return BundleCovariance(
        poses=poses,
        centers=centers,
        params=_camera_blocks(layout, sigma, len(problem.model_ids)),
        points3D=points,
        variance_factor=2 * cost / freedom if freedom > 0 else float("nan"),
    )


def covariance_bytes(problem: BundleProblem, config: BundleConfig = BundleConfig()) -> int:
    """About the memory that `covariance` takes, without taking more of it than the layout of the problem."""
    layout = lay_out(problem, np.ones(len(problem.obs_images), bool))
    plan = plan_solver(layout, layout.padding, Knowledge(problem, layout).targets, _with_factor(config).solver)
    system = system_bytes(layout, plan, len(problem.image_cameras), len(problem.points3D))
    blocks = 8 * BLOCK * BLOCK * len(plan.pattern.columns)
    # The factor once more as a square, and its inverse; of a sparse one, those of its widest front and products.
    square = 16 * int(np.sum(~layout.padding)) ** 2
    if plan.forecast.fronts is not None:
        square = 40 * int((plan.forecast.fronts.pivots + plan.forecast.fronts.rests).max(initial=0)) ** 2
    return system + 3 * blocks + square + 72 * len(problem.points3D)


def _with_factor(config: BundleConfig) -> BundleConfig:
    """The same with a solver that has a factor."""
    return config if config.solver in ("dense", "sparse") else dataclasses.replace(config, solver="exact")


def _open_motions(problem: BundleProblem, layout: Layout, config: BundleConfig) -> FloatArray:
    """Columns (6 rows, m) of the motions of the whole scene over which the covariance is spread."""
    return _motions(problem, layout) if config.gauge == "free" else np.zeros((6 * layout.rows, 0))


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
    forbidden += [motions_seen(problem, layout, tangents, shared)]
    # Seven columns, and a row for each coordinate of a constant point: the triangle of a QR decomposition will do.
    _, sizes, directions = np.linalg.svd(np.linalg.qr(np.concatenate(forbidden), mode="r"))
    allowed = directions[sizes <= 1e-9 * max(float(sizes.max()), 1e-300)].T
    free = np.concatenate([tangents[layout.slot_frame], shared])
    return free.reshape(-1, 7)[: 6 * (poses + len(shared))] @ allowed


def _pose_blocks(problem: BundleProblem, layout: Layout, sigma: Marginals) -> tuple[FloatArray, FloatArray]:
    """Covariances (I, 6, 6) of the poses' tangents on the left, and of the centres (I, 3, 3).

    With the frame's tangent δ in world axes a camera moves by J δ + μ,  J = R [I, 0; −[c]×, I], c from the frame's
    centre to its own, and μ its sensor's tangent.
    """
    poses, count = problem.cams_from_world, len(layout.image_slot)
    unseen = np.bincount(layout.image, minlength=count) == 0  # and perhaps not finite
    ends = (poses.center, frame_centers(problem)[layout.image_frame])
    here, frame = (np.where(unseen[:, None], 0.0, place) for place in ends)
    R, arms = poses.rotation.matrix, here - frame
    J = np.zeros((count, 6, 6))
    J[:, :3, :3] = J[:, 3:, 3:] = R
    J[:, 3:, :3] = -R @ skew(arms)
    # The centre straight from the frame's, so that what is held stays exactly zero.
    K, back = np.zeros((count, 3, 6)), np.zeros((count, 3, 6))
    K[:, :, :3], K[:, :, 3:], back[:, :, 3:] = -skew(arms), np.eye(3), R.transpose(0, 2, 1)
    frames, sensors = layout.image_slot.astype(np.int64), layout.image_sensor_row
    both = sigma.between(frames, frames), sigma.between(frames, sensors), sigma.between(sensors, sensors)
    blocks, centers = _of_sum(J, np.broadcast_to(np.eye(6), J.shape), *both), _of_sum(K, back, *both)
    blocks[unseen & problem.free_poses], centers[unseen & problem.free_poses] = np.nan, np.nan
    return blocks, centers


def _of_sum(A: FloatArray, B: FloatArray, xx: FloatArray, xy: FloatArray, yy: FloatArray) -> FloatArray:
    """Covariances of A x + B y from those of x and y."""
    crossed = A @ xy @ B.transpose(0, 2, 1)
    return A @ xx @ A.transpose(0, 2, 1) + crossed + crossed.transpose(0, 2, 1) + B @ yy @ B.transpose(0, 2, 1)


def _camera_blocks(layout: Layout, sigma: Marginals, cameras: int) -> FloatArray:
    """Covariances (C, K, K) of the parameters; a camera has a row for each six of those that are free."""
    blocks = np.zeros((cameras, MAX_PARAMS, MAX_PARAMS))
    camera, columns, first = layout.shared.camera, layout.shared.columns, len(layout.slot_frame)
    for apart in range(min(MAX_PARAMS // BLOCK, len(camera))):
        one = apart + np.flatnonzero((camera[apart:] >= 0) & (camera[apart:] == camera[: len(camera) - apart]))
        found = sigma.between(first + one, first + one - apart)
        rows, others = columns[one], columns[one - apart]
        k, a, b = np.nonzero((rows >= 0)[:, :, None] & (others >= 0)[:, None, :])
        blocks[camera[one[k]], rows[k, a], others[k, b]] = found[k, a, b]
        blocks[camera[one[k]], others[k, b], rows[k, a]] = found[k, a, b]
    return blocks


def _undetermined(entry: int, layout: Layout) -> Rejected:
    """Whose parameter an entry of the reduced system is."""
    row = entry // 6
    if row < len(layout.slot_frame):
        image = np.flatnonzero(layout.image_frame == layout.slot_frame[row])[0]
        return Rejected("undetermined_pose", str(image))
    shared = row - len(layout.slot_frame)
    if layout.shared.camera[shared] >= 0:
        return Rejected("undetermined_camera", str(layout.shared.camera[shared]))
    if layout.shared.sensor[shared] >= 0:
        return Rejected("undetermined_sensor", str(layout.shared.sensor[shared]))
    return Rejected("undetermined_bias", str(layout.shared.bias[shared]))
