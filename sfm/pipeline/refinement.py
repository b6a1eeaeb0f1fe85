"""Bundle adjustment of a finished model, ours or not."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from sfm.bundle import (
    BundleConfig,
    BundleCovariance,
    BundleProblem,
    BundleResult,
    adjust,
    covariance,
    covariance_bytes,
    free_params_of,
    problem_from_reconstruction,
    squared_errors,
    update_reconstruction,
)
from sfm.bundle.reconstruction import Intrinsics
from sfm.core.cameras import Camera
from sfm.core.errors import InputError, Rejected
from sfm.core.events import SILENT, Observer
from sfm.core.geometry.similarity import Sim3
from sfm.core.scene import Reconstruction
from sfm.core.scene.transformation import transformed
from sfm.pipeline.control_points import with_marks, without_marks
from sfm.pipeline.frame import frame_from_model
from sfm.pipeline.memory import free_memory_bytes
from sfm.pipeline.priors import Measurements, ModelPriors, PriorConfig, deviations, priors_of


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
            if value is not None and not 0 < value < np.inf:
                raise ValueError(f"{name} must be positive and finite, got {value}")
        for name, now in (("focal_bounds", 1.0), ("principal_point_bounds", 0.0), ("distortion_bounds", None)):
            bounds = getattr(self, name)
            if bounds is None:
                continue
            if not bounds[0] < bounds[1]:
                raise ValueError(f"{name} must rise, got {bounds[0]:g}..{bounds[1]:g}")
            if now is not None and not bounds[0] <= now <= bounds[1]:
                raise ValueError(f"{name} must contain {now:g}, no change; got {bounds[0]:g}..{bounds[1]:g}")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MeasuredFrame:
    """The frame of the measurements, how the model came into it, and how it agrees with them.

    Attributes:
        frame_from_model: by which the model was moved before it was adjusted.
        origin: latitude and longitude in degrees and height in m where the frame is (east, north, up) on the Earth.
        deviations: before and after, see `sfm.pipeline.priors.deviations`.
        rms_px: root mean square residual before and after.
        not_in_model: measurements of images or points that the model lacks.
    """

    frame_from_model: Sim3
    origin: tuple[float, float, float] | None
    deviations: tuple[dict[str, Any], dict[str, Any]]
    rms_px: tuple[float, float]
    not_in_model: int

    def to_json(self) -> dict[str, Any]:
        """All of it; the similarity as scale, rotation (a quaternion wxyz) and translation."""
        there = self.frame_from_model
        names = ("latitude_deg", "longitude_deg", "height_m")
        return {
            "origin": None if self.origin is None else dict(zip(names, self.origin, strict=True)),
            "axes": "east, north, up" if self.origin is not None else "of the measurements",
            "frame_from_model": {
                "scale": float(there.scale),
                "rotation_wxyz": there.rotation.wxyz.tolist(),
                "translation": there.translation.tolist(),
            },
            "measurements": {"before": self.deviations[0], "after": self.deviations[1]},
            "rms_px": {"before": self.rms_px[0], "after": self.rms_px[1]},
            "not_in_model": self.not_in_model,
        }


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RefinedModel:
    """An adjusted model, how it came about, how certain it is if that was asked, and its frame if it was measured."""

    reconstruction: Reconstruction
    result: BundleResult
    covariance: BundleCovariance | Rejected | None
    frame: MeasuredFrame | None = None

    def to_json(self) -> dict[str, Any]:
        """Costs, iterations, and the cameras with their standard deviations."""
        result, table = self.result, [dataclasses.asdict(row) for row in self.result.table]
        missing: dict[str, Any] = {"undetermined": self.undetermined} if self.undetermined else {}
        if self.at_bounds:
            missing["at_bounds"] = self.at_bounds
        if self.frame is not None:
            missing["frame"] = self.frame.to_json()
        return {
            **missing,
            "initial_cost": result.initial_cost,
            "final_cost": result.final_cost,
            "reason": result.reason,
            "observations": len(result.problem.obs_images),
            "without_projection": result.invalid,
            "cameras": {str(k): self.camera_json(k) for k in self.reconstruction.cameras},
            "iterations": table,
        }

    @property
    def at_bounds(self) -> dict[str, list[str]]:
        """Names of the parameters that ended on a bound, by the id of their camera."""
        ids, found = list(self.reconstruction.cameras), {}
        for row, name in self.result.at_bounds:
            found.setdefault(str(ids[row]), []).append(name)
        return found

    @property
    def undetermined(self) -> str:
        """What the observations leave open, so that there are no standard deviations; else empty."""
        if not isinstance(self.covariance, Rejected):
            return ""
        row, model = int(self.covariance.detail), self.reconstruction
        if self.covariance.reason == "undetermined_pose":
            return f"the pose of {model.image_names[row]}"
        return f"camera {list(model.cameras)[row]}"

    def camera_json(self, camera_id: int) -> dict[str, Any]:
        """The parameters of a camera by their names, and the standard deviations of those that were free."""
        camera = self.reconstruction.cameras[camera_id]
        names = camera.model_info.param_names
        told = {"model": camera.model, "params": dict(zip(names, camera.params.tolist(), strict=True))}
        sigmas = self.sigmas(camera_id)
        if sigmas is not None:
            told["sigmas"] = {name: s for name, s in zip(names, sigmas.tolist(), strict=False) if s > 0}
        return told

    def sigmas(self, camera_id: int) -> np.ndarray | None:
        """(12,) standard deviations of the parameters of a camera, 0 where they were held."""
        if not isinstance(self.covariance, BundleCovariance):
            return None
        row = list(self.reconstruction.cameras).index(camera_id)
        return np.sqrt(np.diag(self.covariance.params[row]))


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
    and then also agrees with them as far as their standard deviations demand. Covariances are for residuals with the
    variance that is left at the end; with measurements for the standard deviations that are stated.

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
        found = covariance(result.problem, config.bundle, threads=threads)
        found = found.scaled() if isinstance(found, BundleCovariance) and priors is None else found
    refined = update_reconstruction(reconstruction, result.problem)
    frame = None if priors is None else _frame(there, priors, (reconstruction, refined), problem, result)
    return RefinedModel(without_marks(refined, original), result, found, frame)


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
    problem = _with_known_parameters(problem, list(model.cameras.values()), config)
    problem = _with_bounds(problem, list(model.cameras.values()), config)
    if config.pixel_sigma != 1:
        problem = dataclasses.replace(problem, obs_sigmas=np.full(len(problem.obs_images), config.pixel_sigma))
    if priors is None:
        return problem
    return dataclasses.replace(problem, priors=(*priors.of_poses, *priors.of_points))


def _with_known_parameters(
    problem: BundleProblem, cameras: Sequence[Camera], config: RefinementConfig
) -> BundleProblem:
    """The problem with its camera parameters expected to be what they are, where the config says how certainly."""
    sigmas: dict[Intrinsics, float | None] = {
        "focal": config.focal_sigma,
        "principal_point": config.principal_point_sigma,
        "extra": config.distortion_sigma,
    }
    known = np.full(problem.camera_params.shape, np.inf)
    for row, camera in zip(known, cameras, strict=True):
        for kind, sigma in sigmas.items():
            if sigma is not None:
                row[free_params_of(camera.model_info, (kind,))] = sigma
    if np.all(np.isinf(known)):
        return problem
    return dataclasses.replace(problem, prior_params=problem.camera_params, prior_sigmas=known)


def _with_bounds(problem: BundleProblem, cameras: Sequence[Camera], config: RefinementConfig) -> BundleProblem:
    """The problem with its camera parameters bounded as the config says."""
    kinds: dict[Intrinsics, tuple[float, float] | None] = {
        "focal": config.focal_bounds,
        "principal_point": config.principal_point_bounds,
        "extra": config.distortion_bounds,
    }
    lower, upper = np.full(problem.camera_params.shape, -np.inf), np.full(problem.camera_params.shape, np.inf)
    for c, camera in enumerate(cameras):
        for kind, bounds in kinds.items():
            mine = free_params_of(camera.model_info, (kind,))
            now = problem.camera_params[c, mine]
            for side, bound in zip((lower, upper), bounds or (), strict=False):
                side[c, mine] = {"focal": now * bound, "principal_point": now + bound, "extra": bound}[kind]
    if np.all(np.isinf(lower)) and np.all(np.isinf(upper)):
        return problem
    try:
        return dataclasses.replace(problem, lower_params=lower, upper_params=upper)
    except ValueError as error:
        raise InputError(str(error), remedy="wider --bounds, or a model within them") from error


def _frame(
    there: Sim3,
    priors: ModelPriors,
    models: tuple[Reconstruction, Reconstruction],
    problem: BundleProblem,
    result: BundleResult,
) -> MeasuredFrame:
    before, after = models
    origin = None if priors.origin is None else tuple(priors.origin.tolist())
    return MeasuredFrame(
        frame_from_model=there,
        origin=origin,
        deviations=(deviations(priors, before, np.zeros_like(result.biases)), deviations(priors, after, result.biases)),
        rms_px=(_rms(problem), _rms(result.problem)),
        not_in_model=priors.not_in_model,
    )


def _rms(problem: BundleProblem) -> float:
    return float(np.sqrt(np.nanmean(squared_errors(problem))))


def _check_memory(needed: int) -> None:
    free = free_memory_bytes()
    if free is not None and needed > free:
        raise InputError(
            f"standard deviations take {needed / 1e9:.0f} GB of memory here, and {free / 1e9:.0f} GB are free",
            remedy="leave out --sigmas",
        )
