"""What a calibration says of photos that it has not seen.

The residuals of a fit tell little of the next photo: every coefficient lowers them, and those of one view share their
errors. So views are held out: the camera and the board come from the others, and of a held-out view only its pose is
fitted. Its error is as free of the camera's own fit as a calibration in use.

    fold k holds out views k, k + K, k + 2K … of a random order; every view is held out once

`split_half` asks the other way round: how far do the cameras of two halves of the views differ? By how many pixels is
measured over the image, with frames aligned. One split is as much a matter of chance as one throw of dice (of OpenCV's
left photos splits differ by 0.5 to 6.4 px), so that the median of several is told. Half as many views err √2 times as
much, and two such cameras differ by √2 times that: twice the uncertainty is to be expected.

Reference:
    Hastie, Tibshirani & Friedman, The Elements of Statistical Learning, 2nd ed. 2009, §7.10.
    Kogan, mrcal, Cross-validation (documentation).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from calib.board_turns import BoardTurn
from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_board import BoardShape
from calib.refine_system import CalibrationSystem, Estimate
from calib.refine_turns import read_after, turns_matter
from calib.refine_views import BoardView, Observations
from calib.uncertainty import pixel_grid, projection_difference
from calib.zhang import poses_of_views
from sfm.core.arrays import Points3D, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.optim.levenberg_marquardt import StopRules, minimize

_POSES = StopRules(max_iterations=50, relative_cost_tolerance=1e-10, gradient_tolerance=0.0)
_GAIN = 1 - 1e-6
"""Of an error that is less than another by more than rounding."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class HeldOut(Value):
    """Errors of views that were held out.

    Attributes:
        names: of the views.
        squares: (V,) mean squared length of a view's residuals, px²; inf where the camera sees no pose for it.
        counts: (V,) corners.
        training_rms_px: of the fits, over all folds.
    """

    names: tuple[str, ...]
    squares: Vector
    counts: Vector
    training_rms_px: float

    @property
    def rms_px(self) -> float:
        """Over all corners, to compare with `Calibration.rms_px`."""
        return math.sqrt(float(self.squares @ self.counts / self.counts.sum()))


def hold_out(
    board: Points3D, found: Calibration, config: CalibrationConfig, *, folds: int = 5, rng: np.random.Generator
) -> HeldOut | Rejected:
    """Errors of the views of a calibration, each held out once, at the corners that it kept.

    Args:
        folds: as many as views leaves out one at a time.
    Returns:
        `too_few_views` where the folds leave too few to calibrate from, or what such a calibration was refused for.
    """
    views = views_of(found.observations)
    folds = min(folds, len(views))
    order = rng.permutation(len(views))
    squares, trained = np.empty(len(views)), []
    plain = as_read(config)
    for fold in range(folds):
        held = sorted(order[fold::folds].tolist())
        kept = sorted(set(range(len(views))) - set(held))
        fit = calibrate(board, [views[v] for v in kept], plain)
        if isinstance(fit, Rejected):
            return fit
        trained.append(fit.rms_px)
        squares[held] = pose_only_errors(fit, found.observations.of_views(held), config.turns)
    return HeldOut(
        names=found.observations.names,
        squares=squares,
        counts=np.diff(found.observations.offsets).astype(float),
        training_rms_px=math.sqrt(float(np.mean(np.square(trained)))),
    )


def as_read(config: CalibrationConfig) -> CalibrationConfig:
    """For views of a calibration, with the corners and the ends that it found."""
    return dataclasses.replace(config, reject=False, turns=())


def pose_only_errors(found: Calibration, observations: Observations, turns: Sequence[BoardTurn] = ()) -> Vector:
    """(V,) mean squared length of residuals in px² with this camera and board, each view's pose fitted to it.

    Args:
        turns: of the board that nothing printed on it tells apart; a view is read after the one that suits it best.
    """
    if not turns_matter(found.shape, turns):
        turns = ()
    return read_as_suits(found.camera, found.shape, observations, turns)[1]


def read_as_suits(
    camera: Camera, shape: BoardShape, observations: Observations, turns: Sequence[BoardTurn]
) -> tuple[Observations, Vector]:
    """Each view after the turn by which its error is least, and these errors, as `pose_only_errors` gives them.

    Views stay as they are where a turn gains nothing.
    """
    best, least = np.zeros(len(observations), np.int64), _errors(camera, shape, observations)
    for g in range(1, len(turns)):
        tried = _errors(camera, shape, read_after(observations, np.full(len(best), g), turns))
        better = tried < _GAIN * least
        best[better], least[better] = g, tried[better]
    return read_after(observations, best, turns), least


def _errors(camera: Camera, shape: BoardShape, observations: Observations) -> Vector:
    system, seen = fit_poses(camera, shape, observations)
    out = np.full(len(observations), np.inf)
    if not seen:
        return out
    some = system.observations
    lengths = np.sum(system.residuals() ** 2, axis=1)
    sums = np.bincount(some.view_of, np.where(np.isfinite(lengths), lengths, np.inf), len(some))
    out[seen] = sums / np.diff(some.offsets)
    return out


def fit_poses(camera: Camera, shape: BoardShape, observations: Observations) -> tuple[CalibrationSystem, list[int]]:
    """The problem of the poses alone, at its solution, and the views in it: those with a pose before this camera."""
    R, t, errors = poses_of_views(observations, camera)
    seen = np.flatnonzero(np.isfinite(errors) & np.isfinite(t).all(1)).tolist()
    estimate = Estimate(camera, R[seen], t[seen], shape)
    system = CalibrationSystem(observations.of_views(seen), estimate, np.zeros(0, np.int64))
    if seen:
        minimize(system, _POSES)
    return system, seen


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class SplitHalf(Value):
    """How much the cameras of two halves of the views differ over the image, px, with frames aligned.

    Attributes:
        rms_px, worst_px: medians over the splits.
        splits: that gave two cameras.
    """

    rms_px: float
    worst_px: float
    splits: int = 1


def split_half(
    board: Points3D, found: Calibration, config: CalibrationConfig, *, splits: int = 7, rng: np.random.Generator
) -> SplitHalf | Rejected:
    """Calibrates from each half of the views, by chance, and compares; several times, and tells the medians.

    Returns:
        what the last split was refused for, where most of them are.
    """
    views, plain = views_of(found.observations), as_read(config)
    differences, refused = [], None
    for _ in range(splits):
        order = rng.permutation(len(views))
        halves = [[views[v] for v in sorted(order[side::2].tolist())] for side in range(2)]
        lengths = _difference_of_halves(board, halves, plain, found.camera)
        if isinstance(lengths, Rejected):
            refused = lengths
        else:
            differences.append((math.sqrt(float(np.mean(lengths**2))), float(lengths.max())))
    if refused is not None and 2 * len(differences) <= splits:
        return refused
    rms, worst = np.median(differences, axis=0).tolist()
    return SplitHalf(rms, worst, len(differences))


def _difference_of_halves(
    board: Points3D, halves: Sequence[Sequence[BoardView]], config: CalibrationConfig, camera: Camera
) -> Vector | Rejected:
    """Lengths of the differences over the image, px, where both cameras of the halves see something."""
    cameras = []
    for views in halves:
        half = calibrate(board, views, config)
        if isinstance(half, Rejected):
            return half
        cameras.append(half.camera)
    pixels, _ = pixel_grid(camera, 24)
    lengths = np.linalg.norm(projection_difference(cameras[0], cameras[1], pixels), axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return lengths if len(lengths) else Rejected("no_common_pixels", "the two cameras see nothing in common")


def views_of(observations: Observations) -> list[BoardView]:
    """The views behind flat columns, with their weights as covariances."""
    views = []
    for v, name in enumerate(observations.names):
        rows = slice(observations.offsets[v], observations.offsets[v + 1])
        a, b, c = observations.roots[rows].T
        equal = np.all((a == 1) & (b == 0) & (c == 1))
        information = np.stack([np.stack([a * a, a * b], -1), np.stack([a * b, b * b + c * c], -1)], -2)
        views.append(
            BoardView(
                name,
                observations.width,
                observations.height,
                observations.rows[rows],
                observations.points2D[rows],
                None if equal else np.linalg.inv(information),
            )
        )
    return views
