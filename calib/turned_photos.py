"""Photos that were turned by 180° in their files: cut to their pixels, with nothing in the file that says so.

With the board turned along, such a photo is as good as any, and the only sign of it is the camera: its principal point
lies on the other side of the middle of the image, and what is not symmetric of the distortion has the other sign. So
the choice of photos that are turned is one of signs, as that of boards' ends, and found in the same way
(`refine_ends`): about the solution with a camera that is symmetric, again with those that were found turned back,
until no more are found. It is believed if the errors are then clearly smaller, and if it explains them: where photos
that are turned back still want a camera each, it is the camera that changed (see `diagnose_changes`), as by zooming,
and turning some of them has only made up for a part of that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from calib.diagnose_changes import changed_camera
from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_ends import Quadratics, most_likely_turns
from calib.refine_system import CalibrationSystem, Estimate
from calib.refine_turns import without_poses
from calib.refine_views import BoardView
from sfm.core.arrays import Points3D
from sfm.core.optim.levenberg_marquardt import StopRules, minimize

_RULES = StopRules(max_iterations=50, relative_cost_tolerance=1e-8, gradient_tolerance=0.0)
_CLEARLY = 0.9
"""Error with photos turned back over that without, below which they were turned."""
_CENTER, _SKEWED = 0.03, 0.003
"""Standard deviations that are expected of the principal point's distance from the middle, by the longer side, and of
what is not symmetric of the distortion."""
_ROUNDS = 5
_COMPOSED = np.array([[0, 1], [1, 0]])


@dataclasses.dataclass(frozen=True, slots=True)
class TurnedPhotos:
    """Photos that seem turned by 180°, and the errors of all as they are and with these turned back, px."""

    names: tuple[str, ...]
    rms_px: float
    turned_back_rms_px: float


def turned_photos(board: Points3D, views: Sequence[BoardView], config: CalibrationConfig) -> TurnedPhotos | None:
    """Which photos seem turned by 180° against most of the others; None where none does."""
    plain = dataclasses.replace(config, reject=False)
    turned, errors = set[str](), list[float]()
    for _ in range(_ROUNDS):
        found = calibrate(board, [turned_back(view) if view.name in turned else view for view in views], plain)
        if not isinstance(found, Calibration):
            return None
        errors.append(found.rms_px)
        against = _against_the_others(found)
        if against is None:
            return None
        if not against.any():
            break
        turned ^= {found.observations.names[v] for v in np.flatnonzero(against)}
    else:
        return None
    if not turned or not errors[-1] < _CLEARLY * errors[0] or changed_camera(found) is not None:
        return None
    names = tuple(view.name for view in views if view.name in turned)
    return TurnedPhotos(names, errors[0], errors[-1])


def _against_the_others(found: Calibration) -> np.ndarray | None:
    """(V,) above zero for views that are turned; None where it cannot be told."""
    names, free = found.camera.model_info.param_names, found.columns
    skewed = np.array([names[k][0] in "cps" for k in free], bool)
    if not skewed.any():
        return None
    system = CalibrationSystem(found.observations, _symmetric(found), free[~skewed])
    minimize(system, _RULES)
    A, b = without_poses(CalibrationSystem(found.observations, system.estimate, np.append(free[~skewed], free[skewed])))
    quadratics = _quadratics(found, A, b, [names[k] for k in free[skewed]])
    return most_likely_turns(quadratics, _COMPOSED)


def turned_back(view: BoardView) -> BoardView:
    """The view of the same photo, turned by 180°; covariances of corners stay as they are."""
    return dataclasses.replace(view, points2D=np.array([view.width, view.height]) - view.points2D)


def _symmetric(found: Calibration) -> Estimate:
    """With the principal point in the middle and symmetric distortion."""
    camera, estimate = found.camera, found.estimate
    params = np.array(camera.params)
    for k, name in enumerate(camera.model_info.param_names):
        if name[0] in "ps":
            params[k] = 0.0
    for k, middle in zip(camera.model_info.principal_point_indices, (camera.width / 2, camera.height / 2), strict=True):
        params[k] = middle
    return dataclasses.replace(estimate, camera=camera.with_params(params))


def _quadratics(found: Calibration, A: np.ndarray, b: np.ndarray, names: Sequence[str]) -> Quadratics:
    """Costs of views as they are and turned back, in units of the noise; what changes its sign comes last."""
    longer = max(found.camera.width, found.camera.height)
    same = np.eye(len(names))
    noise = found.sigma_px**2
    prior = 1e-9 * np.diag(A.sum(0)) / noise
    prior[-len(names) :] += [1 / (_CENTER * longer if name[0] == "c" else _SKEWED) ** 2 for name in names]
    return Quadratics(A / noise, b / noise, np.stack([same, -same]), np.diag(prior))
