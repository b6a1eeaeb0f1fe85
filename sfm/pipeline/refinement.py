"""Bundle adjustment of a finished model, ours or not."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from sfm.bundle import (
    BundleConfig,
    BundleCovariance,
    BundleResult,
    adjust,
    covariance,
    problem_from_reconstruction,
    update_reconstruction,
)
from sfm.bundle.reconstruction import Intrinsics
from sfm.core.errors import InputError, Rejected
from sfm.core.events import SILENT, Observer
from sfm.core.scene import Reconstruction
from sfm.pipeline.memory import free_memory_bytes


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RefinementConfig:
    """What of a model may change, and how it is adjusted."""

    intrinsics: tuple[Intrinsics, ...] = ("focal", "extra")
    """Kinds of camera parameters that may change. The principal point is weakly determined by photos of a scene."""
    poses: bool = True
    """Poses may change."""
    points: bool = True
    """Points may change."""
    bundle: BundleConfig = dataclasses.field(default_factory=lambda: BundleConfig(relative_cost_tolerance=1e-8))
    """The adjustment itself. 1e-8 is ten iterations after the last that anybody would see, and exact."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RefinedModel:
    """An adjusted model, how it came about, and how certain it is if that was asked."""

    reconstruction: Reconstruction
    result: BundleResult
    covariance: BundleCovariance | Rejected | None

    def to_json(self) -> dict[str, Any]:
        """Costs, iterations, and the cameras with their standard deviations."""
        result, table = self.result, [dataclasses.asdict(row) for row in self.result.table]
        missing = {"undetermined": self.undetermined} if self.undetermined else {}
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
    with_covariance: bool = False,
    threads: int = 1,
    observer: Observer = SILENT,
) -> RefinedModel:
    """The model of least reprojection error near to this one; observations, tracks and colours stay.

    Covariances are for residuals with the variance that is left at the end.

    Raises:
        InputError: it has no observation with a projection, or several cameras on a rig, which would come apart, or
            covariances do not fit into memory.
    """
    if reconstruction.rigs:
        raise InputError(
            "cameras on a rig cannot be adjusted yet: they would come apart",
            remedy="remove rigs and frames from a copy of the model, and every image moves on its own",
        )
    problem = problem_from_reconstruction(reconstruction, config.intrinsics)
    problem = dataclasses.replace(
        problem, free_poses=problem.free_poses & config.poses, free_points=problem.free_points & config.points
    )
    if with_covariance:
        _check_memory(6 * int(problem.free_poses.sum()) + int(problem.free_params.sum()))
    result = adjust(problem, config.bundle, threads=threads, observer=observer)
    if result.invalid == len(problem.obs_images):
        raise InputError("no observation of this model has a projection; there is nothing to adjust")
    found = None
    if with_covariance:
        found = covariance(result.problem, config.bundle, threads=threads)
        found = found.scaled() if isinstance(found, BundleCovariance) else found
    return RefinedModel(update_reconstruction(reconstruction, result.problem), result, found)


def _check_memory(parameters: int) -> None:
    needed, free = 32 * parameters**2, free_memory_bytes()
    if free is not None and needed > free:
        raise InputError(
            f"standard deviations take {needed / 1e9:.0f} GB of memory here, and {free / 1e9:.0f} GB are free",
            remedy="leave out --sigmas",
        )
