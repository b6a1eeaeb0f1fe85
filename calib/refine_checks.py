"""Whether the views determine a camera, and how the boards stand, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from calib.refine_fit import Fit
from calib.refine_system import RIDGE, CalibrationSystem
from calib.zhang import largest_angle_between
from sfm.core.arrays import FloatArray
from sfm.core.errors import Rejected
from sfm.core.optim.levenberg_marquardt import Summary

_OPEN_FOCAL = 0.1
"""Standard deviation of a focal length over itself, beyond which it is not determined."""
_OPEN_CENTER = 0.1
"""Standard deviation of the principal point over the longer side, beyond which it is not determined."""
_FRONTAL, _PARALLEL = math.radians(3.0), math.radians(6.0)
"""Angles of boards to the image and to one another below which they are as good as none."""

Checked = tuple[CalibrationSystem, Summary, np.ndarray, tuple[str, ...]]


def check_determined(fit: Fit, system: CalibrationSystem, summary: Summary) -> Checked | Rejected:
    """Holds the principal point where the views leave it open; refuses where they leave the focal length open."""
    camera = system.estimate.camera
    names, mean = camera.model_info.param_names, camera.mean_focal_length
    columns, longer = fit.lens.columns(), max(system.observations.width, system.observations.height)
    deviations = _deviations(system, summary, [names[k] for k in columns])
    focal = [d for name, d in deviations.items() if name.startswith("f")]
    center = [d for name, d in deviations.items() if name.startswith("c")]
    fallbacks: tuple[str, ...] = ()
    between, tilt, one_axis = _tilts(system.rotations)
    if max(center) > _OPEN_CENTER * longer or max(focal) > _OPEN_FOCAL * mean:
        columns = np.array([k for k in columns if not names[k].startswith("c")])
        fallbacks = (f"the principal point is held at the centre of the image: {_tilts_in_words(system)}",)
        camera = fit.start.camera
        centred = fit.lens.camera(
            camera.width, camera.height, *camera.focal_lengths, camera.width / 2, camera.height / 2
        )
        estimate = fit.placed(system.observations, centred, False)
        if isinstance(estimate, Rejected):
            return estimate
        system, summary = fit.solve(system.observations, estimate, columns)
        deviations = _deviations(system, summary, [names[k] for k in columns])
        focal = [d for name, d in deviations.items() if name.startswith("f")]
        mean, tilt = system.estimate.camera.mean_focal_length, _tilts(system.rotations)[1]
    elif between < _PARALLEL or one_axis:
        fallbacks = (f"focal length and principal point rest on little: {_tilts_in_words(system)}",)
    if tilt < _FRONTAL:
        # The focal length and all distances may grow together, whatever the noise makes of it.
        return Rejected("undetermined_focal", _tilts_in_words(system))
    if not (max(focal) <= _OPEN_FOCAL * mean and mean < 20 * longer):
        return Rejected(
            "undetermined_focal", f"focal length {mean:.0f} ± {max(focal):.0f} px: {_tilts_in_words(system)}"
        )
    return system, summary, columns, fallbacks


def _deviations(system: CalibrationSystem, summary: Summary, names: Sequence[str]) -> dict[str, float]:
    """Standard deviation of each free parameter, inf where nothing determines them."""
    inverse = system.shared_inverse()
    if inverse is None:
        # Coefficients of the lens may be open and the focal length not; with the ridge what is open is very uncertain.
        inverse = system.shared_inverse(RIDGE)
    freedom = max(2 * len(system.observations.rows) - 6 * len(system.observations) - system.shared_count, 1)
    noise = 2 * summary.final_cost / freedom
    if inverse is None:
        return dict.fromkeys(names, math.inf)
    # Noise-free views that leave something open have no noise to tell so.
    floor = 1e-6
    return dict(zip(names, np.sqrt(np.diag(inverse)[: len(names)] * max(noise, floor)).tolist(), strict=True))


def _tilts(rotations: FloatArray) -> tuple[float, float, bool]:
    """Largest angle between two boards, largest between a board and the image, radians; whether about one axis only."""
    normals = rotations[:, :, 2]
    tilts = np.arccos(np.clip(np.abs(normals[:, 2]), 0, 1))
    directions = (normals[:, :2] / np.maximum(np.linalg.norm(normals[:, :2], axis=1, keepdims=True), 1e-12))[
        tilts > 0.1
    ]
    spread = np.linalg.svd(directions, compute_uv=False) if len(directions) > 1 else np.ones(2)
    return largest_angle_between(normals), float(tilts.max()), bool(spread[-1] < 0.15 * spread[0])


def _tilts_in_words(system: CalibrationSystem) -> str:
    """How the boards stand to one another and to the image, in degrees, and what would help."""
    between, tilt, one_axis = _tilts(system.rotations)
    views = f"all {len(system.observations)} views"
    if tilt < _FRONTAL:
        return f"{views} within {np.rad2deg(tilt):.0f}° of the image plane; tilt the board by 15° to 45° about two axes"
    if between < _PARALLEL:
        return f"{views} within {np.rad2deg(between):.0f}° of parallel; tilt the board by 15° to 45° about two axes"
    if one_axis:
        return f"{views} are tilted about one axis only; tilt the board about the other one, too"
    return f"tilts up to {np.rad2deg(tilt):.0f}° are too few or too alike; add views that fill the image"
