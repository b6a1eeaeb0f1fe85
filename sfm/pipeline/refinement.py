"""Bundle adjustment of a finished model, ours or not."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from sfm.bundle import (
    BundleConfig,
    BundleCovariance,
    BundleProblem,
    adjust,
    covariance,
    covariance_bytes,
    free_params_of,
    problem_from_reconstruction,
    squared_errors,
    update_reconstruction,
)
from sfm.bundle.limits import check_scale
from sfm.bundle.reconstruction import Intrinsics
from sfm.core.arrays import BoolArray, FloatArray
from sfm.core.cameras import Camera
from sfm.core.errors import InputError
from sfm.core.events import SILENT, Observer
from sfm.core.geometry.similarity import Sim3
from sfm.core.scene import Reconstruction
from sfm.core.scene.transformation import transformed
from sfm.pipeline.control_points import with_marks, without_marks
from sfm.pipeline.frame import frame_from_model
from sfm.pipeline.memory import free_memory_bytes
from sfm.pipeline.priors import Measurements, ModelPriors, PriorConfig, deviations, priors_of
from sfm.pipeline.refined_model import MeasuredFrame, RefinedModel, Uncertainty


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RefinementConfig:
    """What of a model may change, and how it is adjusted."""

    intrinsics: tuple[Intrinsics, ...] = ("focal", "extra")
    """Kinds of camera parameters that may change. The principal point is weakly determined by photos of a scene."""
    focal_sigma: float | None = None
    """Standard deviation in px with which present focal lengths are known; None: they are not."""
    principal_point_sigma: float | None = None
    """The same of principal points, in px."""
    distortion_sigma: float | None = None
    """The same of each parameter of a distortion."""
    focal_bounds: tuple[float, float] | None = None
    """Least and largest factor by which focal lengths may change; None: any."""
    principal_point_bounds: tuple[float, float] | None = None
    """By how many px coordinates of principal points may at least and at most change."""
    distortion_bounds: tuple[float, float] | None = None
    """What each parameter of a distortion may be at least and at most."""
    sensors: bool = False
    """The poses of cameras on their rigs may change."""
    poses: bool = True
    """Poses may change."""
    points: bool = True
    """Points may change."""
    bundle: BundleConfig = dataclasses.field(default_factory=lambda: BundleConfig(relative_cost_tolerance=1e-8))
    """The adjustment itself. 1e-8 is ten iterations after the last that anybody would see, and exact."""
    priors: PriorConfig = dataclasses.field(default_factory=PriorConfig)
    """What measurements count."""
    pixel_sigma: float = 1.0
    """Standard deviation of keypoints in px: what residuals weigh against measurements."""
    seed: int = 0
    """Of the samples by which positions are aligned."""

    def __post_init__(self) -> None:
        for name in ("pixel_sigma", "focal_sigma", "principal_point_sigma", "distortion_sigma"):
            value = getattr(self, name)
            if value is not None:
                check_scale(name, value)
        for name, now in (("focal_bounds", 1.0), ("principal_point_bounds", 0.0), ("distortion_bounds", None)):
            bounds = getattr(self, name)
            if bounds is None:
                continue
            if not bounds[0] < bounds[1]:
                raise ValueError(f"{name} must rise, got {bounds[0]:g}..{bounds[1]:g}")
            if now is not None and not bounds[0] <= now <= bounds[1]:
                raise ValueError(f"{name} must contain {now:g}, no change; got {bounds[0]:g}..{bounds[1]:g}")


def refine_model(
    reconstruction: Reconstruction,
    config: RefinementConfig = RefinementConfig(),
    *,
    measured: Measurements | None = None,
    with_covariance: bool = False,
    threads: int = 1,
    observer: Observer = SILENT,
) -> RefinedModel:
    """The model of least reprojection error near to this one; observations, tracks and colours stay.

    Images that a rig took at one moment move together. With measurements, the model is first moved into their frame,
    and then also agrees with them as far as their standard deviations demand. Covariances are for keypoints with the
    noise that is left at the end. With measurements, or camera parameters that are known with a standard deviation,
    they are for the standard deviations that are stated, `pixel_sigma` among them: these have weighed one against the
    other, and what residuals show says nothing of measurements.

    Raises:
        InputError: it has no observation with a projection, or a camera whose place on its rig is not known, or
            covariances do not fit into memory; or measurements are of another scene.
    """
    original, priors, there = reconstruction, None, Sim3.identity()
    if measured is not None:
        reconstruction, measured, unmarked = _marked(reconstruction, measured)
        priors = priors_of(reconstruction, measured, config.priors)
        priors = dataclasses.replace(priors, not_in_model=priors.not_in_model + unmarked)
        there = frame_from_model(reconstruction, priors, rng=np.random.default_rng(config.seed))
        reconstruction = transformed(reconstruction, there)
    problem = _problem(reconstruction, config, priors)
    if with_covariance:
        _check_memory(covariance_bytes(problem, config.bundle))
    result = adjust(problem, config.bundle, threads=threads, observer=observer)
    if result.invalid == len(problem.obs_images):
        raise InputError("no observation of this model has a projection; there is nothing to adjust")
    found = None
    if with_covariance:
        found = covariance(result.problem, config.bundle, biases=result.biases, threads=threads)
        if isinstance(found, BundleCovariance):
            found = _uncertainty(found, result.problem, config.pixel_sigma)
    refined = update_reconstruction(reconstruction, result.problem)
    rms = _rms(problem, result.problem)
    frame = None if priors is None else _frame(there, priors, (reconstruction, refined), result.biases, rms)
    return RefinedModel(without_marks(refined, original), result, rms, found, frame)


def _marked(model: Reconstruction, measured: Measurements) -> tuple[Reconstruction, Measurements, int]:
    """With the control points that are marked in photos as points of the model, and the number that are not."""
    if measured.control_points is None or measured.marks is None:
        return model, measured, 0
    model, named, unmarked = with_marks(model, measured.control_points, measured.marks)
    return model, dataclasses.replace(measured, control_points=named), unmarked


def _problem(model: Reconstruction, config: RefinementConfig, priors: ModelPriors | None) -> BundleProblem:
    try:
        problem = problem_from_reconstruction(model, config.intrinsics, refine_sensors=config.sensors)
    except ValueError as error:
        raise InputError(str(error), remedy="remove rigs and frames, and every image moves on its own") from error
    problem = dataclasses.replace(
        problem, free_poses=problem.free_poses & config.poses, free_points=problem.free_points & config.points
    )
    problem = _with_known_parameters(problem, model.cameras, config)
    problem = _with_bounds(problem, model.cameras, config)
    if config.pixel_sigma != 1:
        problem = dataclasses.replace(problem, obs_sigmas=np.full(len(problem.obs_images), config.pixel_sigma))
    if priors is None:
        return problem
    return dataclasses.replace(problem, priors=(*priors.of_poses, *priors.of_points))


def _with_known_parameters(
    problem: BundleProblem, cameras: Mapping[int, Camera], config: RefinementConfig
) -> BundleProblem:
    """The problem with its camera parameters expected to be what they are, where the config says how certainly."""
    sigmas: dict[Intrinsics, float | None] = {
        "focal": config.focal_sigma,
        "principal_point": config.principal_point_sigma,
        "extra": config.distortion_sigma,
    }
    known = np.full(problem.camera_params.shape, np.inf)
    for row, camera in zip(known, cameras.values(), strict=True):
        for kind, sigma in sigmas.items():
            if sigma is not None:
                row[free_params_of(camera.model_info, (kind,))] = sigma
    if np.all(np.isinf(known)):
        return problem
    return dataclasses.replace(problem, prior_params=problem.camera_params, prior_sigmas=known)


def _with_bounds(problem: BundleProblem, cameras: Mapping[int, Camera], config: RefinementConfig) -> BundleProblem:
    """The problem with its camera parameters bounded as the config says."""
    kinds: dict[Intrinsics, tuple[float, float] | None] = {
        "focal": config.focal_bounds,
        "principal_point": config.principal_point_bounds,
        "extra": config.distortion_bounds,
    }
    lower, upper = np.full(problem.camera_params.shape, -np.inf), np.full(problem.camera_params.shape, np.inf)
    for c, (camera_id, camera) in enumerate(cameras.items()):
        for kind, bounds in kinds.items():
            mine = free_params_of(camera.model_info, (kind,))
            now = problem.camera_params[c, mine]
            for side, bound in zip((lower, upper), bounds or (), strict=False):
                side[c, mine] = {"focal": now * bound, "principal_point": now + bound, "extra": bound}[kind]
        _check_within(camera_id, camera, problem.free_params[c], (lower[c], upper[c]))
    if np.all(np.isinf(lower)) and np.all(np.isinf(upper)):
        return problem
    return dataclasses.replace(problem, lower_params=lower, upper_params=upper)


def _check_within(camera_id: int, camera: Camera, free: BoolArray, bounds: tuple[FloatArray, FloatArray]) -> None:
    for k, (name, now) in enumerate(zip(camera.model_info.param_names, camera.params.tolist(), strict=True)):
        least, most = float(bounds[0][k]), float(bounds[1][k])
        if free[k] and not least <= now <= most:
            raise InputError(
                f"{name} of camera {camera_id} is {now:g}, out of its bounds {least:g}..{most:g}",
                remedy="wider --bounds, or a model within them",
            )


def _uncertainty(found: BundleCovariance, problem: BundleProblem, pixel_sigma: float) -> Uncertainty:
    """For the noise that residuals show, where nothing but residuals is weighed and some are left over."""
    factor = found.variance_factor
    noise_px = pixel_sigma * float(np.sqrt(factor))
    known = problem.prior_sigmas is not None and np.any(np.isfinite(problem.prior_sigmas) & problem.free_params)
    if known or problem.priors or not 0 < factor < np.inf:
        return Uncertainty(found, pixel_sigma, noise_px)
    return Uncertainty(found.scaled(), noise_px, noise_px)


def _frame(
    there: Sim3,
    priors: ModelPriors,
    models: tuple[Reconstruction, Reconstruction],
    biases: FloatArray,
    rms_px: tuple[float, float],
) -> MeasuredFrame:
    before, after = models
    origin = None if priors.origin is None else tuple(priors.origin.tolist())
    return MeasuredFrame(
        frame_from_model=there,
        origin=origin,
        deviations=(deviations(priors, before, np.zeros_like(biases)), deviations(priors, after, biases)),
        rms_px=rms_px,
        not_in_model=priors.not_in_model,
    )


def _rms(before: BundleProblem, after: BundleProblem) -> tuple[float, float]:
    """Root mean square residuals in px of the observations that took part, those with a projection at the start."""
    errors = squared_errors(before)
    part = np.isfinite(errors)
    left = squared_errors(after)[part]
    left = left[np.isfinite(left)]
    return float(np.sqrt(np.mean(errors[part]))), float(np.sqrt(np.mean(left))) if len(left) else float("nan")


def _check_memory(needed: int) -> None:
    free = free_memory_bytes()
    if free is not None and needed > free:
        raise InputError(
            f"standard deviations take {needed / 1e9:.0f} GB of memory here, and {free / 1e9:.0f} GB are free",
            remedy="leave out --sigmas",
        )
