"""Which lens model says photos best that it has not seen: see `uncertainty_holdout`.

Two lens models are compared view by view, so that what they share cancels; `uncertainty_choice` has the rule.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_lenses import lens_by_name
from calib.refine_views import BoardView
from calib.uncertainty import pixel_grid, projection_difference
from calib.uncertainty_choice import generalises, is_clearly_lower, photos_needed, what_it_brings
from calib.uncertainty_holdout import HeldOut, as_read, hold_out, views_of
from sfm.core.arrays import Points3D, Value
from sfm.core.errors import Rejected

_CLEAR = 1.0
"""Standard errors by which a richer lens model has to be better."""
CANDIDATES = ("pinhole", "simple_radial", "radial", "opencv4", "opencv5", "opencv8", "fisheye", "eucm")


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
        one = dataclasses.replace(config, lens=name)
        row = RankedLens(name, len(lens_by_name(name).free_names))
        found = calibrate(board, common, as_read(one))
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
