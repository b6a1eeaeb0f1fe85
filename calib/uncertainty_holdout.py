"""What a calibration says of photos that it has not seen, and which lens model says it best.

The residuals of a fit tell little of the next photo: every coefficient lowers them, and those of one view share their
errors. So views are held out: the camera and the board come from the others, and of a held-out view only its pose is
fitted. Its error is as free of the camera's own fit as a calibration in use.

    fold k holds out views k, k + K, k + 2K … of a random order; every view is held out once

Two lens models are compared view by view, so that what they share cancels; `uncertainty_choice` has the rule.

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
from calib.refine_lenses import lens_by_name
from calib.refine_system import CalibrationSystem, Estimate
from calib.refine_turns import read_after, turns_matter
from calib.refine_views import BoardView, Observations
from calib.uncertainty import pixel_grid, projection_difference
from calib.uncertainty_choice import generalises, is_clearly_lower, photos_needed, what_it_brings
from calib.zhang import poses_of_views
from sfm.core.arrays import Points3D, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.optim.levenberg_marquardt import StopRules, minimize

_POSES = StopRules(max_iterations=50, relative_cost_tolerance=1e-10, gradient_tolerance=0.0)
_GAIN = 1 - 1e-6
"""Of an error that is less than another by more than rounding."""
_CLEAR = 1.0
"""Standard errors by which a richer lens model has to be better."""
CANDIDATES = ("pinhole", "simple_radial", "radial", "opencv4", "opencv5", "opencv8", "fisheye", "eucm")


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
    plain = dataclasses.replace(config, reject=False)
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
    views, plain = views_of(found.observations), dataclasses.replace(config, reject=False)
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


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RankedLens(Value):
    """A lens model among others.

    Attributes:
        held_out_rms_px: error of views that were held out.
        excess, excess_error: mean over views of the squared error less that of the best model, px², and its standard
            error.
        differs_px: rms over the image of the difference to the chosen model, frames aligned.
        refused: why there is no such calibration; then the rest is NaN.
        would_bring: of one that predicts clearly better than the chosen one: what, and what it would need, in a
            sentence.
    """

    lens: str
    coefficients: int
    held_out_rms_px: float = math.nan
    rms_px: float = math.nan
    excess: float = math.nan
    excess_error: float = math.nan
    differs_px: float = math.nan
    converged: bool = False
    refused: str = ""
    would_bring: str = ""
    calibration: Calibration | None = None

    @property
    def ratio(self) -> float:
        """Error on held-out views over that of the fit."""
        return self.held_out_rms_px / max(self.rms_px, 1e-12)


def choose_lens(
    board: Points3D, views: Sequence[BoardView], config: CalibrationConfig = CalibrationConfig(), *,
    lenses: Sequence[str] = CANDIDATES, folds: int = 5, seed: int = 0,
) -> tuple[RankedLens, ...] | Rejected:  # fmt: skip
    """Lens models ranked by the error of held-out views, the chosen one first.

    From the model with the fewest coefficients on, one with more is taken if it converged, has clearly lower errors and
    generalises; see `uncertainty_choice`. Models of wide lenses come after those of perspective ones.
    Corners that the best fitting model leaves out are left out for all, so that all are judged by the same.

    Returns:
        `no_lens` where no model can be calibrated, with the reason of the first.
    """
    rows: list[RankedLens] = []
    squares: dict[str, HeldOut] = {}
    common = _common_corners(board, views, config, lenses)
    if isinstance(common, Rejected):
        return common
    for name in lenses:
        one = dataclasses.replace(config, lens=name, reject=False)
        row = RankedLens(name, len(lens_by_name(name).free_names))
        found = calibrate(board, common, one)
        if isinstance(found, Rejected):
            rows.append(dataclasses.replace(row, refused=f"{found.reason}: {found.detail}"))
            continue
        held = hold_out(board, found, one, folds=folds, rng=np.random.default_rng(seed))
        if isinstance(held, Rejected) or not math.isfinite(held.rms_px):
            reason = f"{held.reason}: {held.detail}" if isinstance(held, Rejected) else "a held-out view is not seen"
            rows.append(dataclasses.replace(row, refused=reason))
            continue
        squares[name] = held
        rows.append(
            dataclasses.replace(
                row,
                held_out_rms_px=held.rms_px,
                rms_px=found.rms_px,
                converged=found.converged,
                calibration=found,
            )
        )
    if not squares:
        return Rejected("no_lens", rows[0].refused if rows else "no lens models were asked for")
    return _ranked(rows, squares)


def _common_corners(
    board: Points3D, views: Sequence[BoardView], config: CalibrationConfig, lenses: Sequence[str]
) -> list[BoardView] | Rejected:
    """The views and corners that the best fitting model keeps."""
    best: Calibration | None = None
    first: Rejected | None = None
    for name in lenses:
        found = calibrate(board, views, dataclasses.replace(config, lens=name))
        if isinstance(found, Rejected):
            first = found if first is None else first
        elif best is None or found.sigma_px < best.sigma_px:
            best = found
    if best is None:
        return Rejected(
            "no_lens", f"{first.reason}: {first.detail}" if first is not None else "no lens models were asked for"
        )
    return views_of(best.observations)


def _ranked(rows: list[RankedLens], held: dict[str, HeldOut]) -> tuple[RankedLens, ...]:
    # One that did not converge, or has no rays where no board was shown, has coefficients that the photos cannot bear.
    sound = [row for row in rows if row.lens in held and row.converged and _sees_whole_image(row)]
    sound = sound or [row for row in rows if row.lens in held and row.converged] or [r for r in rows if r.lens in held]
    # Other programs read perspective models, so that wide ones have to be better than the best of those.
    chosen, *others = sorted(sound, key=lambda row: (lens_by_name(row.lens).start == "wide", row.coefficients))
    for row in others:
        # One that predicts better than the other fits has not got there by its few coefficients alone.
        is_believed = generalises(row.ratio, chosen.ratio) or row.held_out_rms_px < chosen.rms_px
        if is_believed and is_clearly_lower(held[row.lens].squares, held[chosen.lens].squares, _CLEAR):
            chosen = row
    best = min(sound, key=lambda row: row.held_out_rms_px)
    judged = [_judged(row, chosen, held[best.lens], held.get(row.lens), held[chosen.lens]) for row in rows]
    first = next(row for row in judged if row.lens == chosen.lens)
    rest = sorted((row for row in judged if row is not first), key=lambda row: (bool(row.refused), row.held_out_rms_px))
    return tuple(_compared(row, first) for row in (first, *rest))


def _judged(
    row: RankedLens, chosen: RankedLens, best: HeldOut, held: HeldOut | None, held_chosen: HeldOut
) -> RankedLens:
    """How far a model is from the best one, and what it would bring if it was not taken though it predicts better."""
    if held is None:
        return row
    excess = held.squares - best.squares
    error = float(np.std(excess, ddof=1) / math.sqrt(len(excess))) if len(excess) > 1 else math.inf
    row = dataclasses.replace(row, excess=float(np.mean(excess)), excess_error=error)
    if row.lens == chosen.lens or not is_clearly_lower(held.squares, held_chosen.squares, _CLEAR):
        return row
    told = f"that is {row.ratio:.3f} times its error on the photos it was fitted to"
    why = told, photos_needed(len(excess), row.ratio)
    if not row.converged:
        why = "it does not converge", "more photos"
    elif not _sees_whole_image(row):
        why = "it has no rays for the corners of the image", "photos with the board there"
    brings = what_it_brings(row.lens, (chosen.held_out_rms_px, row.held_out_rms_px), *why, f"--model {row.lens}")
    return dataclasses.replace(row, would_bring=brings)


def _sees_whole_image(row: RankedLens) -> bool:
    """Whether there is a ray for each corner of the image; of fisheyes, whose circle may end before, always."""
    if row.calibration is None or row.calibration.camera.model_info.is_fisheye:
        return row.calibration is not None
    w, h = float(row.calibration.camera.width), float(row.calibration.camera.height)
    return bool(row.calibration.camera.unproject(np.array([[0, 0], [w, 0], [0, h], [w, h]]))[1].all())


def _compared(row: RankedLens, chosen: RankedLens) -> RankedLens:
    if row.calibration is None or chosen.calibration is None:
        return row
    pixels, _ = pixel_grid(chosen.calibration.camera, 24)
    lengths = projection_difference(chosen.calibration.camera, row.calibration.camera, pixels)
    finite = lengths[np.isfinite(lengths).all(1)]
    differs = math.sqrt(float(np.mean(np.sum(finite**2, 1)))) if len(finite) else math.nan
    return dataclasses.replace(row, differs_px=differs)


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
