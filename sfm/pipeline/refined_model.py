"""A model after its adjustment, as it is told to users."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from sfm.bundle import BundleCovariance, BundleResult
from sfm.bundle.reconstruction import sensors_of
from sfm.core.errors import Rejected
from sfm.core.geometry.similarity import Sim3
from sfm.core.scene import Reconstruction


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
class Uncertainty:
    """Covariances, and what they are for.

    Attributes:
        covariance: of the adjusted problem.
        keypoint_sigma_px: standard deviation of keypoints for which they hold.
        noise_px: that which the residuals show; NaN where no observation is left over beyond what parameters take.
    """

    covariance: BundleCovariance
    keypoint_sigma_px: float
    noise_px: float


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RefinedModel:
    """An adjusted model and how it came about.

    Attributes:
        rms_px: root mean square residual before and after, of the observations that took part.
        uncertainty: what the observations leave open if they do, None if it was not asked.
        frame: if the model was measured.
    """

    reconstruction: Reconstruction
    result: BundleResult
    rms_px: tuple[float, float]
    uncertainty: Uncertainty | Rejected | None
    frame: MeasuredFrame | None = None

    def to_json(self) -> dict[str, Any]:
        """Costs, iterations, and the cameras with their standard deviations."""
        result, table = self.result, [dataclasses.asdict(row) for row in self.result.table]
        missing: dict[str, Any] = {"undetermined": self.undetermined} if self.undetermined else {}
        if self.at_bounds:
            missing["at_bounds"] = self.at_bounds
        if isinstance(self.uncertainty, Uncertainty):
            noise = self.uncertainty.noise_px
            missing["keypoint_sigma_px"] = {
                "of_sigmas": self.uncertainty.keypoint_sigma_px,
                "of_residuals": noise if math.isfinite(noise) else None,
            }
            missing["median_sigmas"] = {
                name: value if math.isfinite(value) else None for name, value in self.median_sigmas.items()
            }
        if self.frame is not None:
            missing["frame"] = self.frame.to_json()
        return {
            **missing,
            "initial_cost": result.initial_cost,
            "final_cost": result.final_cost,
            "rms_px": {"before": self.rms_px[0], "after": self.rms_px[1]},
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
        if not isinstance(self.uncertainty, Rejected):
            return ""
        row, model = int(self.uncertainty.detail), self.reconstruction
        match self.uncertainty.reason:
            case "undetermined_pose":
                return f"the pose of {model.image_names[row]}"
            case "undetermined_sensor":
                rig_id, camera_id = list(sensors_of(model))[row]
                return f"the pose of camera {camera_id} on rig {rig_id}"
            case "undetermined_bias":
                return "the common shift of all positions"
            case _:
                return f"camera {list(model.cameras)[row]}"

    @property
    def pose_sigmas(self) -> tuple[np.ndarray, np.ndarray]:
        """(I, 3) standard deviations of centres along the axes of the world, and of rotations about those of the
        cameras in degrees; 0 where a pose was held, NaN where no observation sees it."""
        found = self._known.covariance
        return _sigmas(found.centers), np.rad2deg(_sigmas(found.poses[:, :3, :3]))

    @property
    def point_sigmas(self) -> np.ndarray:
        """(P, 3) those of the points; NaN where their views do not determine them."""
        return _sigmas(self._known.covariance.points3D[: len(self.reconstruction.points3D)])

    @property
    def median_sigmas(self) -> dict[str, float]:
        """Medians of the root sum of squares over three axes, of what was not held; NaN where all was."""
        centers, rotations = self.pose_sigmas
        return {
            name: _median(np.linalg.norm(sigmas, axis=1))
            for name, sigmas in (("centers", centers), ("rotations_deg", rotations), ("points", self.point_sigmas))
        }

    @property
    def _known(self) -> Uncertainty:
        if not isinstance(self.uncertainty, Uncertainty):
            raise ValueError("the model has no standard deviations")
        return self.uncertainty

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
        if not isinstance(self.uncertainty, Uncertainty):
            return None
        row = list(self.reconstruction.cameras).index(camera_id)
        return np.sqrt(np.diag(self.uncertainty.covariance.params[row]))


def _sigmas(covariances: np.ndarray) -> np.ndarray:
    """(N, k) the roots of the diagonals of covariances (N, k, k), in which rounding may leave less than nothing."""
    variances = np.einsum("naa->na", covariances)
    return np.sqrt(np.where(variances < 0, 0.0, variances))


def _median(sigmas: np.ndarray) -> float:
    known = sigmas[sigmas > 0]
    return float(np.median(known)) if len(known) else math.nan
