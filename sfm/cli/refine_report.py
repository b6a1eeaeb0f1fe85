"""What `sfm refine` says of an adjusted model."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sfm.pipeline.refined_model import MeasuredFrame, RefinedModel

_REASONS = {
    "relative_cost": "a full step hardly lowered the cost",
    "gradient": "the gradient vanished (residuals are perpendicular to what parameters do to them)",
    "step": "steps became as small as rounding errors",
    "no_decrease": "NOT CONVERGED: no step lowers the cost, though the gradient has not vanished: an observation is "
    "on the edge of what its lens can show; free fewer parameters, or bound them",
    "max_iterations": "NOT CONVERGED: the limit of iterations was reached",
    "no_free_parameters": "nothing was free to change",
}


def summary(refined: RefinedModel, folder: Path, graduated: bool = False) -> str:
    """A few lines for a person."""
    result, model = refined.result, refined.reconstruction
    count = max(len(result.problem.obs_images) - result.invalid, 1)
    before, after = refined.rms_px
    lines = [
        f"{len(model.image_ids)} images · {len(model.points3D)} points · {count} observations",
        f"root mean square reprojection error {before:.4f} → {after:.4f} px, "
        f"cost {result.initial_cost:.6g} → {result.final_cost:.6g}"
        + (" by the last scale of the loss" if graduated else ""),
        f"{result.iterations} iterations; {_REASONS[result.reason]}",
        *_measured_lines(refined.frame),
    ]
    if result.invalid:
        lines.append(f"{result.invalid} observations have no projection (behind the camera) and took no part")
    if result.lost:
        lines.append(f"{result.lost} observations lost their projection on the way")
    for camera_id, names in list(refined.at_bounds.items())[:5]:
        lines.append(f"camera {camera_id}: {', '.join(names)} ended on a bound")
    if len(refined.at_bounds) > 5:
        lines.append(f"and parameters of {len(refined.at_bounds) - 5} more cameras")
    lines += _uncertainty_lines(refined)
    for camera_id, camera in list(model.cameras.items())[:5]:
        sigmas = refined.sigmas(camera_id)
        told = [
            f"{name} {value:.6g}" + (f" ± {sigmas[k]:.2g}" if sigmas is not None and sigmas[k] > 0 else "")
            for k, (name, value) in enumerate(zip(camera.model_info.param_names, camera.params, strict=True))
        ]
        lines.append(f"camera {camera_id}  {camera.model}  {'  '.join(told)}")
    if len(model.cameras) > 5:
        lines.append(f"and {len(model.cameras) - 5} more cameras (--json has them all)")
    return "\n".join([*lines, f"model    {folder}"])


def _uncertainty_lines(refined: RefinedModel) -> list[str]:
    """Of which noise standard deviations are, or why there are none."""
    from sfm.core.errors import Rejected

    told = refined.uncertainty
    if told is None:
        return []
    if isinstance(told, Rejected):
        return [f"no standard deviations: the observations leave open {refined.undetermined}"]
    medians = [f"{name} ± {value:.2g}{unit}" for name, value, unit in _medians(refined) if math.isfinite(value)]
    tables = f"{', '.join(medians) or 'nothing uncertain'} (medians; pose_sigmas.csv, point_sigmas.csv)"
    if told.keypoint_sigma_px == told.noise_px:
        return [f"standard deviations for the noise that the residuals show, {told.noise_px:.3g} px", tables]
    stated = f"standard deviations for keypoints of {told.keypoint_sigma_px:g} px, as stated (--pixel-sigma); "
    if math.isnan(told.noise_px):
        return [stated + "no observation is left over to tell their noise", tables]
    return [stated + f"the residuals show {told.noise_px:.3g} px", tables]


def _medians(refined: RefinedModel) -> list[tuple[str, float, str]]:
    found, unit = refined.median_sigmas, " units"
    if refined.frame is not None:
        unit = " m" if refined.frame.origin is not None else ""
    return [
        ("camera centres", found["centers"], unit),
        ("rotations", found["rotations_deg"], "°"),
        ("points", found["points"], unit),
    ]


def _measured_lines(frame: MeasuredFrame | None) -> list[str]:
    if frame is None:
        return []
    lines = []
    for kind, after in frame.deviations[1].items():
        before, bias = frame.deviations[0][kind], after.get("bias")
        line = f"{kind:<15}{after['count']}, {before['rms_sigmas']:.3g} → {after['rms_sigmas']:.3g} standard deviations"
        line += f", {after['unlikely']} hardly by chance" if after["unlikely"] else ""
        lines.append(line + (f", all shifted by {' '.join(f'{b:.3g}' for b in bias)}" if bias else ""))
    if frame.not_in_model:
        lines.append(f"{frame.not_in_model} of the measurements are of images or points that the model lacks")
    if frame.origin is not None:
        latitude, longitude, height = frame.origin
        lines.append(f"frame    east, north, up in m from {latitude:.7f}, {longitude:.7f}, {height:.2f} m (frame.json)")
    return lines
