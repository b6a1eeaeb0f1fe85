"""What is known of poses and points before any image is looked at.

A group of measurements of one kind, each with its standard deviation: where cameras stand (GPS), which way is down
(an accelerometer), how far apart two cameras are, where some points lie (control points). Their residuals are divided
by the standard deviations, so that they add to the squared errors of observations divided by theirs; how is in
`sfm.bundle.prior_terms`. All groups have a robust loss of their own, whose scale counts standard deviations.
"""

from __future__ import annotations

import dataclasses
from typing import TypeAlias, TypeVar

import numpy as np
from jaxtyping import Float64, Int32

from sfm.bundle.limits import check_scale
from sfm.core.arrays import BoolArray, FloatArray, Value, readonly
from sfm.core.optim.losses import Loss, loss_id

_SINGULAR = 1e-12
"""Least eigenvalue of a matrix of correlations that is not a rounding error."""
_UNIT = 1e-6


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class PositionPrior(Value):
    """Camera centres are expected at `positions`, all of them shifted by one unknown bias if it has a sigma.

    A coordinate that was not measured has the variance inf, zeros in the rest of its row and column, and any position.

    Attributes:
        images: (k,) rows of the images; one may occur more than once.
        positions: (k, 3) in the world.
        covariances: (k, 3, 3) of the positions, scene units squared; see `of_sigmas`.
        bias_sigma: standard deviation of each coordinate of a bias b that the group has in common, expected to be 0:
            centres lie at positions + b. None: there is no bias.
        loss, loss_scale: of |C − position − b| in standard deviations.

    Raises:
        ValueError: shapes disagree, something is not finite, a covariance is not positive definite, or a scale or
            sigma is not positive.
    """

    images: Int32[np.ndarray, " k"]
    positions: Float64[np.ndarray, "k 3"]
    covariances: Float64[np.ndarray, "k 3 3"]
    bias_sigma: float | None = None
    loss: Loss = "trivial"
    loss_scale: float = 1.0

    def __post_init__(self) -> None:
        _set_checked_positions(self, "images")
        if self.bias_sigma is not None:
            check_scale("bias_sigma", self.bias_sigma)

    @staticmethod
    def of_sigmas(
        images: Int32[np.ndarray, " k"], positions: FloatArray, sigmas: FloatArray | float,
        *, bias_sigma: float | None = None, loss: Loss = "trivial", loss_scale: float = 1.0,
    ) -> PositionPrior:  # fmt: skip
        """From independent standard deviations: one for all, or (k, 3); inf where a coordinate was not measured."""
        covariances = covariances_of(np.broadcast_to(sigmas, np.shape(positions)))
        return PositionPrior(images, positions, covariances, bias_sigma, loss, loss_scale)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class GravityPrior(Value):
    """The direction `down` of the world is expected to be seen along `directions_in_camera`.

    Attributes:
        images: (k,) rows of the images.
        directions_in_camera: (k, 3) unit vectors in the frame of each camera (x right, y down, z forward).
        sigmas_rad: (k,) standard deviations of each of the two angles by which a direction may be off.
        down: (3,) unit vector in the world.
        loss, loss_scale: of the angle in standard deviations.

    Raises:
        ValueError: shapes disagree, a vector is not of unit length, or a sigma or scale is not positive.
    """

    images: Int32[np.ndarray, " k"]
    directions_in_camera: Float64[np.ndarray, "k 3"]
    sigmas_rad: Float64[np.ndarray, " k"]
    down: Float64[np.ndarray, " 3"]
    loss: Loss = "trivial"
    loss_scale: float = 1.0

    def __post_init__(self) -> None:
        count = _set_checked_rows(self, "images")
        _set(self, "directions_in_camera", (count, 3))
        _set(self, "sigmas_rad", (count,))
        _set(self, "down", (3,))
        check_scale("sigmas_rad", self.sigmas_rad)
        for name, vectors in (("directions_in_camera", self.directions_in_camera), ("down", self.down[None])):
            lengths = np.linalg.norm(vectors, axis=1)
            if not np.all(np.abs(lengths - 1) < _UNIT):
                raise ValueError(f"{name} must have unit length, got lengths {_range(lengths)}")
        _check_loss(self)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class DistancePrior(Value):
    """The centres of two cameras are expected to lie this far apart.

    Attributes:
        first, second: (k,) rows of the images.
        distances, sigmas: (k,) in scene units; a distance may be 0.
        loss, loss_scale: of the difference in standard deviations.

    Raises:
        ValueError: shapes disagree, an image is as far from itself, a distance is negative or not finite, or a sigma
            or scale is not positive.
    """

    first: Int32[np.ndarray, " k"]
    second: Int32[np.ndarray, " k"]
    distances: Float64[np.ndarray, " k"]
    sigmas: Float64[np.ndarray, " k"]
    loss: Loss = "trivial"
    loss_scale: float = 1.0

    def __post_init__(self) -> None:
        count = _set_checked_rows(self, "first")
        if _set_checked_rows(self, "second") != count:
            raise ValueError(f"expected {count} second images, got {len(self.second)}")
        if np.any(self.first == self.second):
            raise ValueError(f"image {self.first[self.first == self.second][0]} has a distance to itself")
        _set(self, "distances", (count,))
        _set(self, "sigmas", (count,))
        if not np.all((self.distances >= 0) & np.isfinite(self.distances)):
            raise ValueError(f"distances must be finite and not negative, got {_range(self.distances)}")
        check_scale("sigmas", self.sigmas)
        _check_loss(self)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class PointPrior(Value):
    """Points are expected at `positions`: control points.

    Attributes:
        points: (k,) rows of the points.
        positions: (k, 3) in the world; covariances (k, 3, 3) as in `PositionPrior`.
        loss, loss_scale: of |X − position| in standard deviations.

    Raises:
        ValueError: as `PositionPrior`.
    """

    points: Int32[np.ndarray, " k"]
    positions: Float64[np.ndarray, "k 3"]
    covariances: Float64[np.ndarray, "k 3 3"]
    loss: Loss = "trivial"
    loss_scale: float = 1.0

    def __post_init__(self) -> None:
        _set_checked_positions(self, "points")

    @staticmethod
    def of_sigmas(
        points: Int32[np.ndarray, " k"], positions: FloatArray, sigmas: FloatArray | float,
        *, loss: Loss = "trivial", loss_scale: float = 1.0,
    ) -> PointPrior:  # fmt: skip
        """From independent standard deviations, as `PositionPrior.of_sigmas`."""
        covariances = covariances_of(np.broadcast_to(sigmas, np.shape(positions)))
        return PointPrior(points, positions, covariances, loss, loss_scale)


Prior: TypeAlias = PositionPrior | GravityPrior | DistancePrior
"""What is known of poses."""
AnyPrior = TypeVar("AnyPrior", bound=PositionPrior | GravityPrior | DistancePrior | PointPrior)
_COLUMNS = (
    "images", "first", "second", "points", "positions", "covariances", "directions_in_camera", "sigmas_rad",
    "distances", "sigmas",
)  # fmt: skip
"""What has a row for each measurement of a group."""


def covariances_of(sigmas: FloatArray) -> FloatArray:
    """Diagonal covariances (k, 3, 3) of independent standard deviations (k, 3), which may be inf."""
    out = np.zeros((*np.shape(sigmas), 3))
    diagonal = np.arange(3)
    out[..., diagonal, diagonal] = np.square(sigmas)
    return out


def whitening(covariances: FloatArray) -> FloatArray:
    """W (k, 3, 3) with Wᵀ W the inverse of each covariance: W r has unit covariance. Zero for variances of inf.

    Raises:
        ValueError: a covariance is not symmetric and positive definite.
    """
    variances = np.einsum("kaa->ka", covariances)
    open_ = np.isinf(variances)
    measured = np.where(
        open_[:, :, None] | open_[:, None, :], np.where(covariances != 0, 0.0, covariances), covariances
    )
    measured = measured + open_[:, :, None] * np.eye(3)
    if not np.all(np.isfinite(measured)) or not np.all(np.einsum("kaa->ka", measured) > 0):
        raise ValueError("covariances must have positive variances and be finite, except for variances of inf")
    sigmas = np.sqrt(np.einsum("kaa->ka", measured))
    correlations = measured / (sigmas[:, :, None] * sigmas[:, None, :])
    if not np.allclose(correlations, correlations.swapaxes(1, 2), rtol=0, atol=1e-9):
        raise ValueError("covariances must be symmetric")
    least = np.linalg.eigvalsh(correlations)[:, 0]
    if not np.all(least > _SINGULAR):
        raise ValueError(f"covariance {int(np.argmin(least))} is not positive definite")
    return np.linalg.inv(np.linalg.cholesky(correlations)) / sigmas[:, None, :] * ~open_[:, :, None]


def check_rows(priors: tuple[Prior | PointPrior, ...], images: int, points: int) -> None:
    """That every row that the priors name exists.

    Raises:
        ValueError: one does not.
    """
    for prior in priors:
        for name, count in (("images", images), ("first", images), ("second", images), ("points", points)):
            rows = getattr(prior, name, None)
            if rows is not None and len(rows) and rows.max() >= count:
                raise ValueError(f"{name} of {type(prior).__name__} must lie in 0..{count - 1}, got {rows.max()}")


def where_finite(prior: AnyPrior, poses: BoolArray, points: BoolArray) -> AnyPrior:
    """The group without the measurements of what is not finite: of `poses` (I,) and `points` (P,) that are False.

    Nothing can be compared with these, and they do not move.
    """
    of_rows = {"images": poses, "first": poses, "second": poses, "points": points}
    columns = [field.name for field in dataclasses.fields(prior) if field.name in _COLUMNS]
    keep = np.all([of_rows[name][getattr(prior, name)] for name in columns if name in of_rows], axis=0)
    return prior if keep.all() else dataclasses.replace(prior, **{name: getattr(prior, name)[keep] for name in columns})


def _set(prior: Prior | PointPrior, name: str, shape: tuple[int, ...], dtype: type = np.float64) -> None:
    object.__setattr__(prior, name, readonly(getattr(prior, name), shape, dtype))


def _set_checked_rows(prior: Prior | PointPrior, name: str) -> int:
    count = len(getattr(prior, name))
    _set(prior, name, (count,), np.int32)
    rows = getattr(prior, name)
    if np.any(rows < 0):
        raise ValueError(f"{name} must not be negative, got {rows.min()}")
    return count


def _set_checked_positions(prior: PositionPrior | PointPrior, rows: str) -> None:
    count = _set_checked_rows(prior, rows)
    _set(prior, "positions", (count, 3))
    _set(prior, "covariances", (count, 3, 3))
    whitening(prior.covariances)
    variances = np.einsum("kaa->ka", prior.covariances)
    measured = np.isfinite(variances)
    check_scale("standard deviations of positions", np.sqrt(variances[measured]))
    if not np.all(np.isfinite(prior.positions[measured])):
        raise ValueError("positions must be finite where they were measured")
    _check_loss(prior)


def _check_loss(prior: Prior | PointPrior) -> None:
    loss_id(prior.loss)
    check_scale("loss_scale", prior.loss_scale)


def _range(values: FloatArray) -> str:
    return f"{values.min():g}..{values.max():g}" if len(values) > 1 else f"{values[0]:g}"
