"""From what a user measured to priors of a model, in a frame in which both are.

Positions on the Earth become east, north and up from their mean place. A direction, without any position, makes up the
z axis; a distance, without any, the unit.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sfm.bundle.limits import check_scale
from sfm.bundle.prior_terms import point_prior_residuals, prior_residuals
from sfm.bundle.priors import (
    DistancePrior,
    GravityPrior,
    PointPrior,
    PositionPrior,
    Prior,
    covariances_of,
)
from sfm.core.arrays import FloatArray, Value, readonly
from sfm.core.errors import ImageError, InputError
from sfm.core.geometry.geodesy import earth_from_geodetic, geodetic_from_earth, local_from_earth
from sfm.core.optim.losses import Loss
from sfm.core.scene import Reconstruction
from sfm.evaluation.compare import match_names
from sfm.io.exif import read_image_info
from sfm.io.measurements import ControlPoints, Marks, MeasuredDirections, MeasuredDistances, MeasuredPositions

_DOWN = np.array([0.0, 0.0, -1.0])
_UNLIKELY = np.sqrt([0.0, 9.0, 11.829, 14.156])
"""Lengths that as many normal numbers, 0 to 3, exceed with the probability by which one exceeds 3."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PriorConfig:
    """How certain measurements are that do not say so themselves, and what a wrong one costs."""

    position_sigma: float | None = None
    """Standard deviation of each coordinate of a position, in its unit; for those on the Earth m."""
    position_bias: float | None = None
    """Standard deviation of a shift that all positions have in common, as of an antenna or a day; none without it."""
    gravity_sigma_deg: float = 1.0
    """Standard deviation of a direction of gravity; a phone at rest has about one degree."""
    distance_sigma: float | None = None
    """Standard deviation of a distance, in its unit."""
    control_sigma: float | None = None
    """Standard deviation of each coordinate of a control point, in its unit."""
    loss: Loss = "huber"
    """What a deviation costs; huber bounds the pull of a measurement that is wrong."""
    loss_scale: float = 3.0
    """Standard deviations from which a loss grows more slowly: beyond three hardly any is by chance."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float | int):
                check_scale(field.name, value)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Measurements(Value):
    """All that was measured of a scene. Control points are points of the model, or those marked if there are marks."""

    positions: MeasuredPositions | None = None
    directions: MeasuredDirections | None = None
    distances: MeasuredDistances | None = None
    control_points: ControlPoints | None = None
    marks: Marks | None = None


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ModelPriors(Value):
    """Priors of one model.

    Attributes:
        of_poses, of_points: for its adjustment, rows of images and points of the model.
        kinds: a word for each of `of_poses`.
        origin: latitude and longitude in degrees and height in m of the frame (east, north, up); None if it is not
            on the Earth.
        not_in_model: number of measurements of images or points that the model lacks.
    """

    of_poses: tuple[Prior, ...]
    of_points: tuple[PointPrior, ...]
    kinds: tuple[str, ...]
    origin: np.ndarray | None
    not_in_model: int

    def __post_init__(self) -> None:
        if self.origin is not None:
            object.__setattr__(self, "origin", readonly(self.origin, (3,)))


def priors_of(model: Reconstruction, measured: Measurements, config: PriorConfig = PriorConfig()) -> ModelPriors:
    """The priors that measurements give a model, image by image name.

    Raises:
        InputError: none of the measurements of a kind is of the model, or neither they nor the config say how certain
            they are.
    """
    settings: dict[str, Any] = {"loss": config.loss, "loss_scale": config.loss_scale}
    priors, kinds, points, origin, absent = [], [], [], None, 0
    if (positions := measured.positions) is not None:
        rows, measured_rows = _matched(model, positions.names, "position")
        places, origin = _local(positions, measured_rows)
        sigmas = _completed(positions.sigmas[measured_rows], config.position_sigma, "positions", "position-sigma")
        covariances = covariances_of(np.where(np.isnan(places), np.inf, sigmas))
        priors.append(PositionPrior(rows, places, covariances, config.position_bias, **settings))
        kinds.append("positions")
        absent += len(positions.names) - len(rows)
    if (directions := measured.directions) is not None:
        rows, measured_rows = _matched(model, directions.names, "direction")
        default = np.deg2rad(config.gravity_sigma_deg)
        sigmas = _completed(np.deg2rad(directions.sigmas_deg[measured_rows]), default, "directions", "")
        vectors = directions.directions[measured_rows]
        priors.append(GravityPrior(rows, vectors, sigmas, _DOWN, **settings))
        kinds.append("gravity")
        absent += len(directions.names) - len(rows)
    if (distances := measured.distances) is not None:
        priors.append(_distances(model, distances, config, settings))
        kinds.append("distances")
        absent += len(distances.names) - len(priors[-1].first)
    if (control := measured.control_points) is not None:
        points.append(_control(model, control, config, settings))
        absent += len(control.labels) - len(points[0].points)
    return ModelPriors(tuple(priors), tuple(points), tuple(kinds), origin, absent)


def positions_of_photos(folder: Path, names: Collection[str]) -> MeasuredPositions:
    """Where the photos of a folder were taken by their EXIF, WGS84; those that do not say are left out.

    Raises:
        InputError: none of them says.
    """
    found = {}
    for name in names:
        try:
            info = read_image_info(folder / name)
        except ImageError:
            continue
        if info.gps is not None:
            found[name] = (*info.gps, np.nan if info.altitude_m is None else info.altitude_m)
    if not found:
        remedy = "name the folder whose photos the model is of, or a table of positions"
        raise InputError("no photo of the model here says where it was taken", path=folder, remedy=remedy)
    return MeasuredPositions(tuple(found), np.array(list(found.values())), np.full((len(found), 3), np.nan), True)


def deviations(
    priors: ModelPriors, model: Reconstruction, biases: FloatArray
) -> dict[str, dict[str, float | int | list[float]]]:
    """For each kind: how many there are, how many deviate by more than one in 370 would by chance, as three standard
    deviations of one number, and the root mean square of all numbers in standard deviations; 1 where these are right.

    Args:
        biases: (G, 3) of the groups that have one.
    """
    rotations, centers = model.cams_from_world.rotation.matrix, model.cams_from_world.center
    told: dict[str, dict[str, float | int | list[float]]] = {}
    left = list(biases)
    for kind, prior in zip(priors.kinds, priors.of_poses, strict=True):
        biased = isinstance(prior, PositionPrior) and prior.bias_sigma is not None
        bias = left.pop(0) if biased else np.zeros(3)
        told[kind] = _deviation(prior_residuals(prior, rotations, centers, bias), _coordinates(prior))
        if biased:
            told[kind]["bias"] = [float(b) for b in bias]
    for prior in priors.of_points:
        told["control points"] = _deviation(point_prior_residuals(prior, model.points3D), _coordinates(prior))
    return told


def _deviation(residuals: FloatArray, coordinates: np.ndarray) -> dict[str, float | int | list[float]]:
    """Of residuals (k, 3) with so many coordinates (k,) each."""
    lengths, total = np.linalg.norm(residuals, axis=1), int(coordinates.sum())
    rms = float(np.sqrt(np.sum(lengths**2) / total)) if total else 0.0
    return {"count": len(lengths), "unlikely": int(np.sum(lengths > _UNLIKELY[coordinates])), "rms_sigmas": rms}


def _coordinates(prior: Prior | PointPrior) -> np.ndarray:
    """(k,) how many numbers each measurement is."""
    match prior:
        case PositionPrior() | PointPrior():
            return np.isfinite(np.einsum("kaa->ka", prior.covariances)).sum(axis=1)
        case GravityPrior():
            return np.full(len(prior.images), 2)
        case DistancePrior():
            return np.full(len(prior.first), 1)


def _matched(model: Reconstruction, names: tuple[str, ...], what: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the model's images, and the rows of `names` that they are called."""
    rows, measured = match_names(model.image_names, names)
    if not len(rows):
        raise InputError(f"no {what} is of an image of the model", remedy=_remedy(names[0], model.image_names))
    return rows.astype(np.int32), measured


def _remedy(name: str, known: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"{name!r}: did you mean {close[0]!r}?" if close else f"the model has images like {known[0]!r}"


def _local(positions: MeasuredPositions, rows: np.ndarray) -> tuple[FloatArray, FloatArray | None]:
    """Positions (k, 3) in the frame of the scene, NaN where not measured, and its origin on the Earth."""
    places = positions.places[rows]
    if not positions.geodetic:
        return places, None
    heights = places[:, 2]
    level = 0.0 if np.all(np.isnan(heights)) else float(np.nanmean(heights))
    on_earth = earth_from_geodetic(np.c_[places[:, :2], np.where(np.isnan(heights), level, heights)])
    origin = np.array([*geodetic_from_earth(on_earth.mean(axis=0))[:2], level])
    local = local_from_earth(origin) @ on_earth
    local[np.isnan(heights), 2] = np.nan
    return local, origin


def _completed(sigmas: FloatArray, default: float | None, what: str, option: str) -> FloatArray:
    if default is None and np.any(np.isnan(sigmas)):
        raise InputError(f"it is not said how certain {what} are", remedy=f"give columns of sigmas, or --{option}")
    completed = np.where(np.isnan(sigmas), default or np.nan, sigmas)
    try:
        check_scale(f"standard deviations of {what}", completed)
    except ValueError as error:
        raise InputError(str(error), remedy="correct the table, or choose another unit") from error
    return completed


def _distances(
    model: Reconstruction, distances: MeasuredDistances, config: PriorConfig, settings: Mapping[str, Any]
) -> DistancePrior:
    flat = tuple(dict.fromkeys(name for pair in distances.names for name in pair))
    rows, measured = match_names(model.image_names, flat)
    row_of = {flat[m]: int(row) for row, m in zip(rows, measured, strict=True)}
    kept = [k for k, (one, two) in enumerate(distances.names) if one in row_of and two in row_of]
    if not kept:
        raise InputError("no distance is between two images of the model", remedy=_remedy(flat[0], model.image_names))
    ends = np.array([[row_of[name] for name in distances.names[k]] for k in kept], np.int32)
    sigmas = _completed(distances.sigmas[kept], config.distance_sigma, "distances", "distance-sigma")
    return DistancePrior(ends[:, 0], ends[:, 1], distances.distances[kept], sigmas, **settings)


def _control(
    model: Reconstruction, control: ControlPoints, config: PriorConfig, settings: Mapping[str, Any]
) -> PointPrior:
    row_of = {str(point_id): row for row, point_id in enumerate(model.point_ids.tolist())}
    kept = [k for k, label in enumerate(control.labels) if label in row_of]
    if not kept:
        remedy = "points are named by their ids in the model, or as they are marked in photos"
        raise InputError("no control point is a point of the model", remedy=remedy)
    rows = np.array([row_of[control.labels[k]] for k in kept], np.int32)
    places = control.positions[kept]
    sigmas = _completed(control.sigmas[kept], config.control_sigma, "control points", "control-sigma")
    return PointPrior(rows, places, covariances_of(np.where(np.isnan(places), np.inf, sigmas)), **settings)
