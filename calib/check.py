"""Whether photos of a board agree with a camera, and if not, what has changed.

Only the poses of the board are fitted, so the errors are those of a camera in use. Where it has changed, the photos say
how: with focal length and principal point free as well they give these anew, each with its standard deviation (views
taken for independent). A difference counts if it is several of its own standard deviations, file and photos together,
and moves pixels at the border of the image by more than the errors of the photos.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from calib.board_turns import BoardTurn
from calib.diagnose import Finding, diagnose_photos
from calib.diagnose_window import stated_finding, window_finding
from calib.refine import Calibration
from calib.refine_board import BoardShape
from calib.refine_copies import without_copies
from calib.refine_system import CalibrationSystem
from calib.refine_views import BoardView, RejectedView, gather
from calib.uncertainty import covariance
from calib.uncertainty_holdout import fit_poses, read_as_suits
from sfm.core.arrays import Points3D, Value
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.optim.levenberg_marquardt import StopRules, minimize

_RULES = StopRules(max_iterations=50, relative_cost_tolerance=1e-10, gradient_tolerance=0.0)
_MIN_CORNERS = 4
_CLEAR = 4.0
"""Standard deviations that are a difference."""
_SUSPICIOUS = 3.0
"""Views with so many times the median error take no part in the question what has changed."""
_FAILED = 0.5
"""More views than this part that are not seen or far off are no outliers."""
_BY_SHAPE = ("bent_board", "lens_model", "correlated_corners")
GRAVE = (
    "error_above_limit",
    "focal_length_differs",
    "principal_point_differs",
    "lens_or_board_differs",
    "no_pose",
    "other_size",
)
"""Causes for which a check fails."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CameraCheck(Value):
    """What photos say of a camera.

    Attributes:
        found: the photos with this camera, poses fitted; nothing else is estimated.
        rms_px: over all corners, as `Calibration.rms_px`.
        limit_px: what it was to stay below.
        free_rms_px: with focal length and principal point free; NaN where the photos leave them open.
        changes: of these parameters, from the file to the photos: (difference, standard deviation of it), px.
        left_out: views that could not be used.
        findings: the gravest first; causes in `GRAVE` are failures.
    """

    found: Calibration
    rms_px: float
    limit_px: float
    free_rms_px: float
    changes: Mapping[str, tuple[float, float]]
    left_out: tuple[RejectedView, ...]
    findings: tuple[Finding, ...]

    @property
    def failed(self) -> bool:
        """Whether the photos disagree with the camera."""
        return any(finding.cause in GRAVE for finding in self.findings)


def check_camera(
    camera: Camera, shape: BoardShape, views: Sequence[BoardView], *, limit_px: float,
    sigmas: Mapping[str, float] | None = None, stated_px: float = math.nan, is_ours: bool = False,
    turns: Sequence[BoardTurn] = (),
) -> CameraCheck | Rejected:  # fmt: skip
    """Compares photos of a board with a camera.

    Args:
        shape: of the board; nothing of it is estimated.
        views: of the camera's size; others are left out.
        limit_px: rms error that is allowed.
        sigmas: standard deviations of the camera's parameters, where they are known.
        stated_px, is_ours: rms error of the corners that it was calibrated with, and whether they were found here.
        turns: of the board that nothing printed on it tells apart; a view is read from the end that suits it best.
    Returns:
        `no_views` where none can be used, with the reason of the first.
    """
    usable, left_out = _sorted_out(camera, views)
    observations, _ = read_as_suits(camera, shape, gather(shape.given, usable), turns)
    system, seen = fit_poses(camera, shape, observations)
    left_out += [
        RejectedView(view.name, "no_pose", "its corners are not seen by this camera from anywhere")
        for v, view in enumerate(usable)
        if v not in set(seen)
    ]
    if not seen:
        first = f"{left_out[0].name}: {left_out[0].reason} {left_out[0].detail}" if left_out else "no views"
        return Rejected("no_views", first)
    found = _as_calibration(camera, system, ())
    changed = _changed(found)
    changes = _compared(camera, changed, sigmas or {})
    free_rms = changed.rms_px if changed is not None else math.nan
    check = CameraCheck(found, found.rms_px, limit_px, free_rms, changes, tuple(left_out), ())
    lost = sum(view.reason == "no_pose" for view in left_out)
    differences = (*_of_sizes(camera, left_out, len(views)), *_differences(check, lost, len(usable)))
    # Residuals of another camera are no longer white, whatever the board and the lens.
    of_photos = (f for f in diagnose_photos(found) if not (differences and f.cause in _BY_SHAPE))
    window = window_finding(found.observations, found.residuals)
    stated = stated_finding(stated_px, found.observations, found.residuals, is_ours=is_ours)
    if stated is not None:
        differences = tuple(_perhaps_of_corners(finding) for finding in differences)
    of_corners = (finding for finding in (window, stated) if finding is not None)
    findings = (*of_corners, *differences, *(f for f in of_photos if f.cause != "few_views"))
    return dataclasses.replace(check, findings=findings)


def _perhaps_of_corners(finding: Finding) -> Finding:
    """A difference of a camera that was calibrated from worse corners."""
    if finding.cause not in ("focal_length_differs", "principal_point_differs"):
        return finding
    return dataclasses.replace(finding, remedy=f"it may be those corners; if not, {finding.remedy}")


def _sorted_out(camera: Camera, views: Sequence[BoardView]) -> tuple[list[BoardView], list[RejectedView]]:
    views, left_out = without_copies(views)
    usable = []
    for view in views:
        if (view.width, view.height) != (camera.width, camera.height):
            detail = f"{view.width}x{view.height}, the camera has {camera.width}x{camera.height}"
            left_out.append(RejectedView(view.name, "other_size", detail))
        elif len(view.corner_ids) < _MIN_CORNERS:
            left_out.append(RejectedView(view.name, "too_few_corners", f"{len(view.corner_ids)}"))
        else:
            usable.append(view)
    return usable, left_out


def _as_calibration(camera: Camera, system: CalibrationSystem, free_names: tuple[str, ...]) -> Calibration:
    residuals, estimate = system.residuals(), system.estimate
    residuals = np.where(np.isfinite(residuals), residuals, 1e3)
    freedom = residuals.size - 6 * len(system.observations) - system.shared_count
    square = float(np.sum(residuals**2))
    return Calibration(
        lens=camera.model,
        camera=estimate.camera,
        cams_from_board=estimate.cams_from_board,
        shape=estimate.shape,
        free_names=free_names,
        observations=system.observations,
        residuals=residuals,
        rejected_views=(),
        rejected_corners=(),
        rms_px=math.sqrt(square / len(residuals)),
        sigma_px=math.sqrt(square / freedom) if freedom > 0 else math.nan,
        rung="given",
        fallbacks=(),
        converged=True,
        iterations=0,
        cost=square / 2,
    )


def _changed(found: Calibration) -> Calibration | None:
    """The photos with focal length and principal point free; None where they leave them open."""
    info = found.camera.model_info
    columns = np.array(sorted((*info.focal_indices, *info.principal_point_indices)), np.int64)
    rms = found.view_rms_px
    good = np.flatnonzero(rms <= _SUSPICIOUS * np.median(rms)).tolist()
    if not len(columns) or len(good) < 3:
        return None
    system = CalibrationSystem(found.observations.of_views(good), found.estimate.of_views(good), columns)
    minimize(system, _RULES)
    if system.shared_inverse() is None:
        return None
    return _as_calibration(found.camera, system, tuple(info.param_names[k] for k in columns))


def _compared(
    camera: Camera, changed: Calibration | None, sigmas: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    if changed is None:
        return {}
    covariances = covariance(changed, by_view=True)
    if isinstance(covariances, Rejected):
        covariances = covariance(changed)
    if isinstance(covariances, Rejected):
        return {}
    names = list(camera.model_info.param_names)
    changes = {}
    for name, sigma in covariances.deviations.items():
        difference = float(changed.camera.params[names.index(name)] - camera.params[names.index(name)])
        changes[name] = difference, math.hypot(sigma, sigmas.get(name, 0.0))
    return changes


def _of_sizes(camera: Camera, left_out: Sequence[RejectedView], total: int) -> Iterator[Finding]:
    others = sum(view.reason == "other_size" for view in left_out)
    if others > _FAILED * total:
        yield Finding(
            "other_size", f"{others} of {total} photos are not of {camera.width} × {camera.height} px",
            "name photos as the camera takes them at these settings, uncropped; resized ones all by the same",
        )  # fmt: skip


def _differences(check: CameraCheck, lost: int, total: int) -> Iterator[Finding]:
    if lost > _FAILED * total:
        yield Finding(
            "no_pose", f"{lost} of {total} boards cannot be where this camera sees them",
            "check the board, and that the photos come from this camera",
        )  # fmt: skip
    differs = list(_of_parameters(check))
    yield from differs
    if not check.rms_px > check.limit_px:
        return
    yield Finding(
        "error_above_limit", f"{check.rms_px:.3f} px, where {check.limit_px:.3f} px are allowed",
        "calibrate anew" if differs else "look at the views below, at the board, and at the photos",
    )  # fmt: skip
    if check.free_rms_px > check.limit_px:
        yield Finding(
            "lens_or_board_differs",
            f"even with another focal length and principal point the error is {check.free_rms_px:.3f} px",
            "check that it is the same lens, and that the board is the one named, and flat",
        )


def _of_parameters(check: CameraCheck) -> Iterator[Finding]:
    """Focal length and principal point, where they differ by more than chance, and visibly."""
    camera, visible = check.found.camera, check.free_rms_px
    reach = math.hypot(camera.width, camera.height) / 2 / camera.mean_focal_length
    focal = [change for name, change in check.changes.items() if name.startswith("f")]
    if focal:
        mean = sum(difference for difference, _ in focal) / len(focal)
        sigma = max(sigma for _, sigma in focal)
        # A pixel at the border moves by Δf times the tangent of its angle.
        if abs(mean) > _CLEAR * sigma and abs(mean) * reach > visible:
            part, how = 100 * abs(mean) / camera.mean_focal_length, "longer" if mean > 0 else "shorter"
            yield Finding(
                "focal_length_differs",
                f"{part:.2g} % {how} in these photos ({mean:+.2f} ± {sigma:.2f} px)",
                "focus or zoom has changed: calibrate at those that are used, and hold them",
            )
    center = {name: change for name, change in check.changes.items() if name.startswith("c")}
    if any(abs(d) > _CLEAR * sigma and abs(d) > 2 * visible for d, sigma in center.values()):
        told = ", ".join(f"{name} {d:+.2f} ± {sigma:.2f} px" for name, (d, sigma) in center.items())
        yield Finding(
            "principal_point_differs", told,
            "the photos were cropped or turned, or a stabiliser moved the lens: calibrate with it off",
        )  # fmt: skip


def resized(camera: Camera, sigmas: Mapping[str, float], width: int, height: int) -> tuple[Camera, dict[str, float]]:
    """The camera of resized photos, and the standard deviations of its parameters."""
    factor = width / camera.width
    lengths = ("f", "fx", "fy", "cx", "cy")
    return camera.scaled(width, height), {n: s * (factor if n in lengths else 1.0) for n, s in sigmas.items()}


def known_shape(points: Points3D) -> BoardShape:
    """A board whose corners lie at known places."""
    moved = np.array(points)
    return BoardShape("flat", moved, np.zeros((len(moved), 3, 0)), np.zeros(0))
