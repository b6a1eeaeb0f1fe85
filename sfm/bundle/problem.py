"""What an adjustment is given and what it returns."""

from __future__ import annotations

import dataclasses
from typing import Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float64, Int32

from sfm.bundle.limits import check_scale, check_tolerance
from sfm.bundle.priors import PointPrior, Prior, check_rows, where_finite
from sfm.bundle.rig_arrays import RigArrays, check_in_range
from sfm.core.arrays import BoolArray, FloatArray, Value, readonly
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.cameras.models import model_by_id
from sfm.core.geometry.rigid import Rigid3
from sfm.core.optim.levenberg_marquardt import Iteration, StopReason
from sfm.core.optim.losses import Loss

SolverChoice: TypeAlias = Literal["auto", "dense", "sparse", "exact", "cholmod", "iterative"]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BundleProblem(Value):
    """Cameras, poses, points and observations as flat columns, and what of them may change.

    Attributes:
        model_ids: (C,) numbers of the camera models.
        camera_params: (C, K) parameters in the order of the model, padded with zeros; K = MAX_PARAMS holds any.
        image_cameras: (I,) the row of the camera of each image.
        cams_from_world: batch (I,), in scene units.
        points3D: (P, 3) in the world.
        obs_images, obs_points: (n,) the image row and the point row of each observation, in any order.
        obs_points2D: (n, 2) px.
        free_params: (C, K) which camera parameters may change; padding must be False.
        free_poses, free_points: (I,) and (P,).
        obs_sigmas: (n,) standard deviations by which residuals are divided: in px, or up to a common factor; None is 1
            for all.
        lower_params, upper_params: (C, K) what free camera parameters may be at least and at most; −inf and inf bound
            nothing, and so does None for all.
        prior_params, prior_sigmas: (C, K) what free camera parameters are expected to be, and the standard deviation
            of that; inf expects nothing, and so does None for all.
        rigs: where images were taken together; `cams_from_world` must be that of the rigs then, and a rig moves where
            all of its images may. None lets every image move by itself.
        priors: what is known of poses and points besides.

    Raises:
        ValueError: shapes disagree, a row or a model does not exist, a parameter that the model lacks is free or not
            finite, a standard deviation is not within `limits`, an expected parameter is not finite, a free one is out
            of its bounds, or poses are not those of the rigs.
    """

    model_ids: Int32[np.ndarray, " C"]
    camera_params: Float64[np.ndarray, "C K"]
    image_cameras: Int32[np.ndarray, " I"]
    cams_from_world: Rigid3
    points3D: Float64[np.ndarray, "P 3"]
    obs_images: Int32[np.ndarray, " n"]
    obs_points: Int32[np.ndarray, " n"]
    obs_points2D: Float64[np.ndarray, "n 2"]
    free_params: Bool[np.ndarray, "C K"]
    free_poses: Bool[np.ndarray, " I"]
    free_points: Bool[np.ndarray, " P"]
    lower_params: Float64[np.ndarray, "C K"] | None = None
    upper_params: Float64[np.ndarray, "C K"] | None = None
    prior_params: Float64[np.ndarray, "C K"] | None = None
    prior_sigmas: Float64[np.ndarray, "C K"] | None = None
    obs_sigmas: Float64[np.ndarray, " n"] | None = None
    rigs: RigArrays | None = None
    priors: tuple[Prior | PointPrior, ...] = ()

    def __post_init__(self) -> None:
        cameras, images = len(self.model_ids), len(self.image_cameras)
        points, observations = len(self.points3D), len(self.obs_images)
        for name, shape, dtype in (
            ("model_ids", (cameras,), np.int32),
            ("camera_params", (cameras, MAX_PARAMS), np.float64),
            ("image_cameras", (images,), np.int32),
            ("points3D", (points, 3), np.float64),
            ("obs_images", (observations,), np.int32),
            ("obs_points", (observations,), np.int32),
            ("obs_points2D", (observations, 2), np.float64),
            ("free_params", (cameras, MAX_PARAMS), np.bool_),
            ("free_poses", (images,), np.bool_),
            ("free_points", (points,), np.bool_),
        ):
            object.__setattr__(self, name, readonly(getattr(self, name), shape, dtype))
        if (self.prior_params is None) != (self.prior_sigmas is None):
            raise ValueError("prior_params and prior_sigmas go together")
        for name in ("prior_params", "prior_sigmas", "lower_params", "upper_params"):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, readonly(getattr(self, name), (cameras, MAX_PARAMS)))
        self._check_params()
        if self.obs_sigmas is not None:
            object.__setattr__(self, "obs_sigmas", readonly(self.obs_sigmas, (observations,), np.float64))
            check_scale("obs_sigmas", self.obs_sigmas)
        if self.cams_from_world.shape != (images,):
            raise ValueError(f"{self.cams_from_world.shape} poses for {images} images")
        if self.rigs is not None:
            self._check_rigs(self.rigs)
        check_rows(self.priors, images, points)
        check_in_range("image_cameras", self.image_cameras, cameras)
        check_in_range("obs_images", self.obs_images, images)
        check_in_range("obs_points", self.obs_points, points)

    @property
    def pose_priors(self) -> tuple[Prior, ...]:
        """The priors that are about poses; of a pose or a point that is not finite nothing is expected."""
        finite = self._finite
        return tuple(where_finite(prior, *finite) for prior in self.priors if not isinstance(prior, PointPrior))

    @property
    def point_priors(self) -> tuple[PointPrior, ...]:
        """The priors that are about points."""
        finite = self._finite
        return tuple(where_finite(prior, *finite) for prior in self.priors if isinstance(prior, PointPrior))

    @property
    def param_bounds(self) -> tuple[FloatArray, FloatArray]:
        """(C, K) the least and the largest value of each parameter."""
        lower, upper = np.full(self.camera_params.shape, -np.inf), np.full(self.camera_params.shape, np.inf)
        return (
            lower if self.lower_params is None else self.lower_params,
            upper if self.upper_params is None else self.upper_params,
        )

    @property
    def at_bounds(self) -> BoolArray:
        """(C, K) which free parameters are on one of their bounds."""
        lower, upper = self.param_bounds
        return self.free_params & ((self.camera_params <= lower) | (self.camera_params >= upper))

    def param_name(self, camera: int, column: int) -> str:
        """What the model calls the parameter in a column of a camera."""
        return model_by_id(int(self.model_ids[camera])).param_names[column]

    @property
    def _finite(self) -> tuple[BoolArray, BoolArray]:
        """Which poses (I,) and points (P,) are finite; quaternions always are."""
        translations = self.cams_from_world.translation
        return np.all(np.isfinite(translations), axis=1), np.all(np.isfinite(self.points3D), axis=1)

    def _check_params(self) -> None:
        for number in np.unique(self.model_ids):
            model = model_by_id(int(number))
            if self.free_params[self.model_ids == number, len(model.param_names) :].any():
                raise ValueError(f"free_params must be False behind the {len(model.param_names)} of {model.name}")
            if not np.isfinite(self.camera_params[self.model_ids == number, len(model.param_names) :]).all():
                raise ValueError(f"camera_params must be zero behind the {len(model.param_names)} of {model.name}")
        lower, upper = self.param_bounds
        bounded = self.free_params & ~(np.isneginf(lower) & np.isposinf(upper))
        outside = bounded & ~((lower <= self.camera_params) & (self.camera_params <= upper))
        for c, k in np.argwhere(outside)[:1].tolist():
            raise ValueError(
                f"{self.param_name(c, k)} of camera {c} is {self.camera_params[c, k]:g}, "
                f"out of its bounds {lower[c, k]:g}..{upper[c, k]:g}"
            )
        if self.prior_params is None or self.prior_sigmas is None:
            return
        check_scale("prior_sigmas", self.prior_sigmas[~np.isposinf(self.prior_sigmas)])
        if not np.all(np.isfinite(self.prior_params[self.free_params & (self.prior_sigmas < np.inf)])):
            raise ValueError("prior_params must be finite where a free parameter has a standard deviation")

    def _check_rigs(self, rigs: RigArrays) -> None:
        if len(rigs.image_frames) != len(self.image_cameras):
            raise ValueError(f"rigs of {len(rigs.image_frames)} images for {len(self.image_cameras)}")
        ours, theirs = self.cams_from_world, rigs.cams_from_world
        if not np.allclose(ours.matrix, theirs.matrix, rtol=1e-6, atol=1e-6, equal_nan=True):
            raise ValueError("cams_from_world must be the poses of the rigs' sensors")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class BundleConfig:
    """Settings of one adjustment."""

    loss: Loss = "trivial"
    """What a residual costs; trivial is plain least squares, right where outliers have been filtered."""
    loss_scale_px: float = 1.0
    """Residual from which a robust loss grows more slowly: in px, or in standard deviations where `obs_sigmas` has
    some."""
    graduated: bool = False
    """Begin with a scale as wide as the worst residual and narrow it by factors of two, so that a loss which gives up
    on large residuals, tukey or truncated, does not give up on those that only a bad start makes large."""
    max_iterations: int = 100
    """Steps that are tried at most."""
    relative_cost_tolerance: float = 1e-6
    """Stop where a full step lowers the cost by less than this part."""
    gradient_tolerance: float = 1e-10
    """Stop where the residuals are as good as perpendicular to what any parameter does to them: where the cosine of no
    such angle, |g| / √(2 F H) of a gradient and a diagonal entry, exceeds this. Without a unit."""
    gauge: Literal["two_cameras", "three_points", "free"] = "two_cameras"
    """Where the data leave the frame of the scene open: keep one pose and one coordinate of a second centre as they
    were, or two points and the plane through them and a third, or leave the scene wherever the steps took it.
    Covariances are relative to these, or spread over all."""
    solver: SolverChoice = "auto"
    """How the reduced system is solved: by a dense or a sparse factor, the faster of these (exact), a sparse one of
    CHOLMOD, where scikit-sparse is installed, or by conjugate gradients; see `reduced`."""

    def __post_init__(self) -> None:
        check_scale("loss_scale_px", self.loss_scale_px)
        if self.max_iterations < 0:
            raise ValueError(f"max_iterations must not be negative, got {self.max_iterations}")
        check_tolerance("relative_cost_tolerance", self.relative_cost_tolerance)
        check_tolerance("gradient_tolerance", self.gradient_tolerance)
        if self.solver not in get_args(SolverChoice):
            raise ValueError(f"solver must be one of {', '.join(get_args(SolverChoice))}, got {self.solver!r}")
        if self.gauge not in ("two_cameras", "three_points", "free"):
            raise ValueError(f"gauge must be two_cameras, three_points or free, got {self.gauge!r}")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BundleResult(Value):
    """An adjusted problem and how it came about.

    Attributes:
        problem: the problem with its new cameras, poses and points; what was not free is the same to the last bit.
        initial_cost, final_cost: ½ Σ ρ of the observations that take part, in px² or, where `obs_sigmas` has standard
            deviations, without a unit; plus what priors add.
        reason: why the iteration ended.
        invalid: observations without a projection at the start (behind the camera, not finite); they take no part.
        lost: observations that lost their projection on the way; each is charged like the worst at the start.
        table: one row for each trial, the start first.
        biases: (G, 3) of the groups of position priors that have one, in their order.
    """

    problem: BundleProblem
    initial_cost: float
    final_cost: float
    reason: StopReason
    invalid: int
    lost: int
    table: tuple[Iteration, ...]
    biases: FloatArray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def at_bounds(self) -> tuple[tuple[int, str], ...]:
        """Camera row and name of the parameters that ended on a bound."""
        return tuple((c, self.problem.param_name(c, k)) for c, k in np.argwhere(self.problem.at_bounds).tolist())

    @property
    def iterations(self) -> int:
        """Number of steps that were tried."""
        return len(self.table) - 1
