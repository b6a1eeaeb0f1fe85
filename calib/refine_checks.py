"""Whether the views determine a camera, and how the boards stand, in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from calib.refine_fit import Fit
from calib.refine_lenses import Lens
from calib.refine_system import RIDGE, CalibrationSystem
from calib.zhang import largest_angle_between
from sfm.core.arrays import FloatArray
from sfm.core.cameras import Camera
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
    names = system.estimate.camera.model_info.param_names
    columns, longer = fit.lens.columns(), max(system.observations.width, system.observations.height)
    fallbacks: tuple[str, ...] = ()
    if fit.lens.spare and _is_focal_open(_deviations(system, summary, [names[k] for k in columns]), system):
        held = _without_spare(fit, system)
        if isinstance(held, Rejected):
            return held
        system, summary, columns, fallbacks = held
    deviations = _deviations(system, summary, [names[k] for k in columns])
    focal = [d for name, d in deviations.items() if name.startswith("f")]
    center = [d for name, d in deviations.items() if name.startswith("c")]
    mean = system.estimate.camera.mean_focal_length
    between, tilt, one_axis = _tilts(system.rotations)
    if max(center) > _OPEN_CENTER * longer or max(focal) > _OPEN_FOCAL * mean:
        columns = np.array([k for k in columns if not names[k].startswith("c")])
        told = f"the principal point is held at the centre of the image: {_tilts_in_words(system)}"
        camera = fit.start.camera
        centred = fit.lens.camera(
            camera.width, camera.height, *camera.focal_lengths, camera.width / 2, camera.height / 2
        )
        estimate = fit.placed(system.observations, _without(fit.lens, centred) if fallbacks else centred, False)
        if isinstance(estimate, Rejected):
            return estimate
        system, summary = fit.solve(system.observations, estimate, columns)
        deviations = _deviations(system, summary, [names[k] for k in columns])
        focal = [d for name, d in deviations.items() if name.startswith("f")]
        mean, tilt = system.estimate.camera.mean_focal_length, _tilts(system.rotations)[1]
        fallbacks += (told,)
    elif between < _PARALLEL or one_axis:
        fallbacks += (f"focal length and principal point rest on little: {_tilts_in_words(system)}",)
    if tilt < _FRONTAL:
        # The focal length and all distances may grow together, whatever the noise makes of it.
        return Rejected("undetermined_focal", _tilts_in_words(system))
    if not (max(focal) <= _OPEN_FOCAL * mean and mean < 20 * longer):
        return Rejected(
            "undetermined_focal", f"focal length {mean:.0f} ± {max(focal):.0f} px: {_tilts_in_words(system)}"
        )
    return system, summary, columns, fallbacks


def _is_focal_open(deviations: Mapping[str, float], system: CalibrationSystem) -> bool:
    worst = max(d for name, d in deviations.items() if name.startswith("f"))
    return not worst <= _OPEN_FOCAL * system.estimate.camera.mean_focal_length


def _without_spare(fit: Fit, system: CalibrationSystem) -> Checked | Rejected:
    """The solution with the parameters held that the lens can do without."""
    spare, names = dict(fit.lens.spare), system.estimate.camera.model_info.param_names
    estimate = fit.placed(system.observations, _without(fit.lens, system.estimate.camera), False)
    if isinstance(estimate, Rejected):
        return estimate
    columns = np.array([k for k in fit.lens.columns() if names[k] not in spare])
    told = ", ".join(f"{name} is held at {value:g}" for name, value in spare.items())
    words = f"{told}: the photos do not tell it from the focal length"
    return (*fit.solve(system.observations, estimate, columns), columns, (words,))


def _without(lens: Lens, camera: Camera) -> Camera:
    """The camera with the parameters where they are held that the lens can do without."""
    values = dict(zip(camera.model_info.param_names, camera.params.tolist(), strict=True)) | dict(lens.spare)
    return camera.with_params(np.array(list(values.values())))


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
