"""A camera in the words of another model: exactly where that is possible, otherwise as near as can be.

Exact conversions rename parameters, set those to zero that the source lacks, and refuse where a parameter that is not
zero has no place. Perspective lenses, fisheyes by the angle, and models on spheres are families of their own, between
which there is no exact way, save that all contain the unified or the pinhole camera as a limit.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy.optimize import least_squares

from sfm.core.arrays import BoolArray, FloatArray, Points2D, Rays
from sfm.core.cameras.camera import Camera
from sfm.core.cameras.models import CameraModel, model_by_name
from sfm.core.errors import Rejected

_STEPS = 40
"""Of the grid across the longer side: a fit sees 1,200 rays of a photo, and its judge four times as many."""
_WIDEST = math.radians(88.0)
"""Perspective models are fitted and judged up to here: 90° is infinitely far off their images."""
_SPHERES = ("EUCM", "DOUBLE_SPHERE")


@dataclasses.dataclass(frozen=True, slots=True)
class Difference:
    """How far two cameras are apart over an image.

    Attributes:
        largest_px, rms_px: between the pixels to which both send the rays of the first's image; NaN where they share
            none.
        uncovered: the part of the first's image whose rays the second does not see.
    """

    largest_px: float
    rms_px: float
    uncovered: float


def converted(camera: Camera, model: str) -> Camera | Rejected:
    """The same camera as another model.

    Returns:
        `no_exact_conversion` with the parameter that is in the way.
    Raises:
        ValueError: the model is unknown.
    """
    source, target = camera.model_info, model_by_name(model)
    if source == target:
        return camera
    values = dict(zip(source.param_names, camera.params.tolist(), strict=True))
    if source.name in _SPHERES or target.name in _SPHERES:
        return _between_spheres(camera, values, target)
    if source.is_fisheye != target.is_fisheye or "EQUIRECTANGULAR" in (source.name, target.name):
        return Rejected("no_exact_conversion", f"{source.name} and {target.name} see the world by different formulas")
    wide = _in_full(values)
    named = target.param_names
    if "f" in named:
        if wide["fx"] != wide["fy"]:
            detail = f"{target.name} has one focal length, and fx, fy are {wide['fx']:.9g}, {wide['fy']:.9g}"
            return Rejected("no_exact_conversion", detail)
        wide["f"] = wide["fx"]
    if "k" in named:
        wide["k"] = wide.pop("k1", 0.0)
    lost = [f"{name} = {value:.3g}" for name, value in wide.items() if value and name not in (*named, "f", "fx", "fy")]
    if lost:
        return Rejected("no_exact_conversion", f"{target.name} has no place for {', '.join(lost)}")
    params = np.array([wide.get(name, 0.0) for name in named])
    return dataclasses.replace(camera, model=model, params=params)


def fitted(camera: Camera, model: str) -> Camera | Rejected:
    """The camera of another model that sends the rays of the image nearest to where they come from.

    Least squares over a grid of the image, with a start whose scale on the axis is that of `camera`.

    Returns:
        `no_fit` where the models share too few rays.
    Raises:
        ValueError: the model is unknown, or has no parameters that could be fitted.
    """
    target = model_by_name(model)
    if not target.focal_indices:
        raise ValueError(f"{model} has nothing to fit")
    exact = converted(camera, model)
    if isinstance(exact, Camera):
        return exact
    pixels, rays = _rays_of(camera, _STEPS)
    if not target.is_fisheye:
        ahead = rays[:, 2] > math.cos(_WIDEST)
        pixels, rays = pixels[ahead], rays[ahead]
    start = _start(camera, target)
    if len(rays) < 2 * len(start.params):
        return Rejected("no_fit", f"{len(rays)} rays of the image lie within reach of {model}")

    def residuals(params: FloatArray) -> FloatArray:
        found, valid = start.with_params(params).project(rays)
        return np.where(valid[:, None], found - pixels, max(camera.width, camera.height)).ravel()

    def derivatives(params: FloatArray) -> FloatArray:
        _, _, by_params, _ = start.with_params(params).project_with_jacobians(rays)
        return by_params.reshape(-1, len(params))

    params = start.params
    for columns in _stages(target):
        held = params.copy()

        def at(free: FloatArray, held: FloatArray = held, columns: FloatArray = columns) -> FloatArray:
            whole = held.copy()
            whole[columns] = free
            return whole

        found = least_squares(
            lambda free, at=at: residuals(at(free)),
            params[columns],
            jac=lambda free, at=at, columns=columns: derivatives(at(free))[:, columns],  # type: ignore[arg-type]
            x_scale="jac",
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
            max_nfev=200,
        )
        params = at(found.x)
    return dataclasses.replace(start.with_params(params), has_prior_focal_length=camera.has_prior_focal_length)


def difference(camera: Camera, other: Camera) -> Difference:
    """How far `other` is from `camera`, over a grid of its image up to the border."""
    pixels, rays = _rays_of(camera, 2 * _STEPS)
    found, valid = other.project(rays)
    if not valid.any():
        return Difference(math.nan, math.nan, 1.0)
    lengths = np.linalg.norm(found[valid] - pixels[valid], axis=1)
    return Difference(float(lengths.max()), float(np.sqrt(np.mean(lengths**2))), 1 - float(np.mean(valid)))


def _rays_of(camera: Camera, steps: int) -> tuple[Points2D, Rays]:
    """Pixels of a grid that reaches to the corners of the image, and their rays; only those that have one."""
    step = max(camera.width, camera.height) / steps
    across = np.linspace(0, camera.width, max(2, round(camera.width / step) + 1))
    down = np.linspace(0, camera.height, max(2, round(camera.height / step) + 1))
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    return pixels[valid], rays[valid]


def _in_full(values: dict[str, float]) -> dict[str, float]:
    """Parameters of a lens with polynomials, with two focal lengths and k1."""
    wide = dict(values)
    if "f" in wide:
        wide["fx"] = wide["fy"] = wide.pop("f")
    if "k" in wide:
        wide["k1"] = wide.pop("k")
    return wide


def _between_spheres(camera: Camera, values: dict[str, float], target: CameraModel) -> Camera | Rejected:
    """EUCM with β = 1 and the double sphere with ξ = 0 are the unified camera; with α = 0 that is a pinhole."""
    source = camera.model_info
    unified = source.name in _SPHERES and values.get("beta", 1.0) == 1.0 and values.get("xi", 0.0) == 0.0
    alpha = values.get("alpha", 0.0)
    if source.name not in _SPHERES:
        pinhole = converted(camera, "PINHOLE")
        if isinstance(pinhole, Rejected):
            return Rejected("no_exact_conversion", f"{source.name} and {target.name} bend rays by different formulas")
        camera, unified = pinhole, True
    # On a sphere α = 0 sees no more than a pinhole, whatever β is.
    if target.name in _SPHERES and (unified or alpha == 0.0 == values.get("xi", 0.0)):
        shape = [alpha, 1.0] if target.name == "EUCM" else [0.0, alpha]
        return dataclasses.replace(camera, model=target.name, params=np.array([*camera.params[:4], *shape]))
    if target.name not in _SPHERES and alpha == 0.0 == values.get("xi", 0.0):
        return converted(dataclasses.replace(camera, model="PINHOLE", params=camera.params[:4]), target.name)
    return Rejected("no_exact_conversion", f"{source.name} and {target.name} bend rays by different formulas")


def _start(camera: Camera, target: CameraModel) -> Camera:
    """The target without distortion, with the scale that `camera` has at its principal point."""
    center = np.array([camera.principal_point])
    axis, valid = camera.unproject(center)
    _, by_point, _, seen = camera.project_with_jacobians(axis)
    scale = by_point[0][[0, 1], [0, 1]] * axis[0, 2] if valid[0] and seen[0] else np.array(camera.focal_lengths)
    focal = {"f": float(scale.mean()), "fx": float(scale[0]), "fy": float(scale[1])}
    values = {**focal, "cx": float(center[0, 0]), "cy": float(center[0, 1]), "alpha": 0.5, "beta": 1.0}
    params = np.array([values.get(name, 0.0) for name in target.param_names])
    return Camera(target.name, camera.width, camera.height, params, camera.has_prior_focal_length)


def _stages(target: CameraModel) -> list[BoolArray]:
    """Free parameters, a few more each time: a rational function from zero in one step is led astray."""
    names = np.array(target.param_names)
    rich = np.isin(names, ("k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "sx1", "sy1"))
    return [~rich, np.ones(len(names), bool)] if rich.any() else [~rich]
