"""The next photos that would help most, from a calibration and what was photographed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calib.cli.calibrating import CalibratedCamera
from calib.cli.sightings import Sightings
from calib.cli.suggestions_svg import suggestions_svg
from calib.next_views import SuggestedView, camera_uncertainty, suggest_views
from calib.refine import Calibration
from calib.uncertainty import rms_uncertainty, uncertainty_map
from sfm.core.arrays import FloatArray
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.io.camera_records import CameraRecord

_CELLS = 40
_LENGTHS = ("f", "fx", "fy", "cx", "cy")


def next_photos(made: CalibratedCamera, seen: Sightings, count: int = 3) -> tuple[SuggestedView, ...]:
    """Suggested views, the best first; none where the uncertainty is not known."""
    if isinstance(made.covariances, Rejected) or isinstance(made.doubts, Rejected):
        return ()
    found, free = made.found, len(made.found.free_names)
    return _suggested(
        found.camera, found.columns, made.covariances.shared[:free, :free], found.sigma_px, seen,
        rms_uncertainty(found, made.doubts), count,
    )  # fmt: skip


def drawn(made: CalibratedCamera, seen: Sightings, suggested: Sequence[SuggestedView]) -> str:
    """The image of the camera with its uncertainty, corners and suggested views as SVG."""
    deviations = None
    if not isinstance(made.doubts, Rejected):
        deviations = uncertainty_map(made.found, made.doubts, across=_CELLS)[0]
    points = np.array(made.found.observations.points2D)
    return suggestions_svg(made.found.camera, seen.board, points, deviations, suggested)


def further_photos(
    camera: Camera,
    record: CameraRecord,
    seen: Sightings,
    found: Calibration,
    *,
    resized_by: float = 1.0,
    count: int = 3,
) -> tuple[SuggestedView, ...]:  # fmt: skip
    """Suggested views for a camera from a file, beside the photos that it was calibrated from.

    Args:
        camera: at the size of the photos, which is that of the file times `resized_by`.
    Returns:
        None where the file does not say how certain it is.
    """
    known = record.uncertainty
    if known is None or not found.sigma_px > 0:
        return ()
    columns = [camera.model_info.param_names.index(name) for name in known.free]
    scale = np.where([name in _LENGTHS for name in known.free], resized_by, 1.0)
    return _suggested(
        camera, columns, known.covariance * np.outer(scale, scale), found.sigma_px, seen,
        resized_by * record.number("uncertainty_px"), count,
    )  # fmt: skip


def _suggested(
    camera: Camera, columns: Sequence[int] | np.ndarray, covariance: FloatArray, sigma_px: float, seen: Sightings,
    uncertainty_px: float, count: int,
) -> tuple[SuggestedView, ...]:  # fmt: skip
    """Chosen by the covariance of independent corners, and told in the measure of what the uncertainty is.

    The covariance by views has as few directions as there are views. So views that were and views to come are taken
    for worse alike, by as much as makes the uncertainty over the image what it is.

    Args:
        covariance: of independent corners.
        uncertainty_px: rms over the image; NaN where it is not known.
    """
    factor = uncertainty_px / camera_uncertainty(camera, columns, covariance)
    factor = factor if math.isfinite(factor) and factor > 0 else 1.0
    return suggest_views(
        camera,
        columns,
        factor**2 * covariance,
        factor * sigma_px,
        seen.points3D,
        count=count,
        y_up=_has_y_up(seen),
    )


def _has_y_up(seen: Sightings) -> bool:
    return seen.board is not None and seen.board.kind == "aprilgrid"
