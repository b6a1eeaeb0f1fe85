"""The frame of measurements: the similarity that brings a model into it, before an adjustment makes them agree.

An adjustment moves by small steps; a model in a frame of its own is first brought near to what was measured. Three
positions that are not on a line, or control points, fix all of it. Positions on a line leave open how it is turned
about the line, one position everything but the place; then directions of gravity and distances decide, and what no
measurement decides stays as it is. Positions without heights fix all of it in a level scene; in another, gravity has
to say what is level.
"""

from __future__ import annotations

import numpy as np

from sfm.bundle.priors import DistancePrior, GravityPrior, PointPrior, PositionPrior
from sfm.core.arrays import FloatArray, Points3D
from sfm.core.errors import InputError, Rejected
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.similarity import Sim3
from sfm.core.robust.alignment import align_robust
from sfm.core.scene import Reconstruction
from sfm.pipeline.priors import ModelPriors

_SIGMAS = 5.0
_EXTENT = 0.05
"""A model that is bent agrees with positions only to a part of its extent."""
_ON_A_LINE = 1e-3
"""Part of the extent along a line within which positions lie on it."""


def frame_from_model(model: Reconstruction, priors: ModelPriors, *, rng: np.random.Generator) -> Sim3:
    """The similarity that brings a model near to its priors.

    Args:
        rng: for the samples of the robust alignment of positions.
    Raises:
        InputError: most positions are elsewhere than the model says, in any frame.
    """
    there = Sim3.identity()
    for prior in priors.of_poses:
        if isinstance(prior, DistancePrior):
            there = _scaling(prior, model.cams_from_world.center) @ there
    for prior in priors.of_poses:
        if isinstance(prior, GravityPrior):
            there = _uprighting(prior, model) @ there
    mine, theirs, sigma = _correspondences(model, priors)
    upright = any(isinstance(prior, GravityPrior) for prior in priors.of_poses)
    return there if not len(mine) else _placing_measured(there @ mine, theirs, sigma, upright, rng) @ there


def _scaling(prior: DistancePrior, centers: Points3D) -> Sim3:
    lengths = np.linalg.norm(centers[prior.first] - centers[prior.second], axis=1)
    usable = (lengths > 0) & (prior.distances > 0)
    scale = float(np.median(prior.distances[usable] / lengths[usable])) if usable.any() else 1.0
    return Sim3(np.array(scale), Rotation3.identity(), np.zeros(3))


def _uprighting(prior: GravityPrior, model: Reconstruction) -> Sim3:
    """Turns the mean of the measured directions to where down is."""
    in_world = model.cams_from_world.rotation[prior.images].inverse() @ prior.directions_in_camera
    mean = in_world.mean(axis=0)
    if np.linalg.norm(mean) < 0.5:
        raise InputError(
            "the directions of gravity contradict the model: they point everywhere",
            remedy="give down in the frame of each camera: x right, y down, z forward",
        )
    return _turn(_smallest_rotation(mean, prior.down))


def _correspondences(model: Reconstruction, priors: ModelPriors) -> tuple[Points3D, Points3D, float]:
    """Places of the model and where they were measured, NaN where not, and how far these may be off."""
    mine, theirs, sigmas = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for prior in (*priors.of_poses, *priors.of_points):
        if isinstance(prior, PositionPrior | PointPrior):
            rows = prior.images if isinstance(prior, PositionPrior) else prior.points
            mine.append((model.cams_from_world.center if isinstance(prior, PositionPrior) else model.points3D)[rows])
            variances = np.einsum("kaa->ka", prior.covariances)
            measured = np.isfinite(variances)
            theirs.append(np.where(measured, prior.positions, np.nan))
            sigmas.append(np.sqrt(np.where(measured, variances, 0.0).max(axis=1)))
    typical = np.concatenate(sigmas)
    return np.concatenate(mine), np.concatenate(theirs), float(np.median(typical)) if len(typical) else 0.0


def _placing_measured(mine: Points3D, theirs: Points3D, sigma: float, upright: bool, rng: np.random.Generator) -> Sim3:
    """The similarity from places of which some coordinates may be NaN; of an upright model in its level if so."""
    complete = np.isfinite(theirs).all(axis=1)
    if np.all(complete) or complete.sum() >= 3:
        return _placing(mine[complete], theirs[complete], sigma, rng)
    means = np.where(np.isnan(theirs), 0.0, theirs).sum(axis=0) / np.maximum(np.isfinite(theirs).sum(axis=0), 1)
    theirs = np.where(np.isnan(theirs), means, theirs)
    if not upright:
        return _placing(mine, theirs, sigma, rng)
    level = np.array([1.0, 1.0, 0.0])
    turned = _placing(mine * level, theirs * level, sigma, rng)
    rise = theirs[:, 2].mean() - (turned @ mine)[:, 2].mean()
    return Sim3(np.ones(()), Rotation3.identity(), np.array([0.0, 0.0, rise])) @ turned


def _placing(mine: Points3D, theirs: Points3D, sigma: float, rng: np.random.Generator) -> Sim3:
    center, extents, axes = _spread(theirs)
    my_center, my_extents, my_axes = _spread(mine)
    if len(mine) == 1 or not (extents[0] > 0 and my_extents[0] > 0):
        return Sim3(np.ones(()), Rotation3.identity(), center - my_center)
    if extents[1] < _ON_A_LINE * extents[0] or my_extents[1] < _ON_A_LINE * my_extents[0]:
        along, mine_along = (theirs - center) @ axes[0], (mine - my_center) @ my_axes[0]
        direction = axes[0] if along @ mine_along > 0 else -axes[0]
        turned = Sim3(np.array(extents[0] / my_extents[0]), _smallest_rotation(my_axes[0], direction), np.zeros(3))
        return Sim3(np.ones(()), Rotation3.identity(), center - turned @ my_center) @ turned
    within = max(_SIGMAS * sigma, _EXTENT * float(np.linalg.norm(extents)) / np.sqrt(len(theirs)))
    found = align_robust(mine, theirs, within, rng=rng)
    if isinstance(found, Rejected) or 2 * found[1].sum() < len(mine):
        agreeing = 0 if isinstance(found, Rejected) else int(found[1].sum())
        raise InputError(
            f"positions contradict the model: only {agreeing} of {len(mine)} are within {within:.3g} of where it says",
            remedy="check names, units and the order of the columns; without heights, tell --gravity",
        )
    return found[0]


def _spread(places: Points3D) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean, singular values and axes."""
    center = places.mean(axis=0)
    _, extents, axes = np.linalg.svd(places - center, full_matrices=False)
    return center, np.append(extents, np.zeros(3))[:3], axes


def _smallest_rotation(start: FloatArray, end: FloatArray) -> Rotation3:
    """The rotation by the smallest angle that turns one direction into another; opposite ones about any axis."""
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis = np.cross(a, b)
    if np.linalg.norm(axis) < 1e-12 and a @ b < 0:
        other = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        return Rotation3.exp(np.pi * other / np.linalg.norm(other))
    return Rotation3(np.array([1 + a @ b, *axis]))


def _turn(rotation: Rotation3) -> Sim3:
    return Sim3(np.ones(()), rotation, np.zeros(3))
