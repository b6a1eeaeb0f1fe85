"""Which shape of the board says best where corners of unseen photos are, and does not cost the camera.

A board that is bent, or printed a little askew, taken for flat bends the camera. With the boards, poses and noise of
eight sets of photos a camera from a board that is taken for flat is off by 2 to 10 times as much as one that is
calibrated along with every point of the board, where these points lie as estimated there; where the board is flat, the
latter costs 3 to 45 % (with 13 views of 24 corners 150 %). So shapes are judged as lens models are: by views that were
held out, from the simplest on, and a richer one has to be clearly better and to generalise; see `uncertainty_choice`.

Held-out views are blind where camera and board may be exchanged for one another: boards that are all held alike, as
in a second of video, are predicted well by a wrong pair of them. Then the camera is uncertain; shapes with which it is
much more uncertain than with another are not chosen. (Otherwise it is less so, since smaller residuals outweigh the
additional unknowns: the uncertainty with the richest shape is 0.3 to 1.05 of that with a flat board for eight of nine
sets, and 4.6 for the one that is a second of video.) The uncertainty meant here is that of corners that are independent
and all alike: too low, but its ratio is a matter of how boards were held. The one by views is noise to it: with a bent
board rather than a flat one it is 1.9 times as large for OpenCV's right photos and 1.1 for the left ones, and 1.5 for
the second of video.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_board import ShapeKind
from calib.refine_views import BoardView
from calib.uncertainty import covariance, rms_uncertainty
from calib.uncertainty_choice import GENERALISES, generalises, is_clearly_lower, photos_needed, what_it_brings
from calib.uncertainty_holdout import HeldOut, hold_out, views_of
from sfm.core.arrays import Points3D, Value, Vector
from sfm.core.errors import Rejected

CANDIDATES: tuple[ShapeKind, ...] = ("flat", "paraboloid", "free")
"""From the simplest to the richest."""
_LARGEST_WORK = 1e10
"""Corners times squared number of coefficients, beyond which a shape takes minutes."""
_COST = 1.5
"""Uncertainty of the camera over that with a simpler shape, beyond which a shape is not chosen."""
_ROUNDS = 3
"""Of corners and choice: mostly the first choice keeps the corners that it was judged by."""
_CLEAR = 2.0
"""Standard errors by which a richer shape has to be better."""
NAMES: dict[ShapeKind, str] = {
    "flat": "a flat", "scale": "a stretched", "paraboloid": "a bent", "height": "an uneven", "free": "a free",
}  # fmt: skip
"""What a board is called that has a shape."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RankedShape(Value):
    """A shape of the board among others.

    Attributes:
        held: errors of views that were held out, of the corners that the best fitting shape keeps.
        rms_px: error of the fit to all of these.
        camera_bound_px: rms over the image of the standard deviation of the pixel of a fixed point, far away, were
            all corners independent: a lower bound, to compare shapes by.
        excess, excess_error: mean over views of the squared error less that of the best shape, px², and its standard
            error.
        refused: why there is no such calibration, or why it is not to be chosen.
        would_bring: of one that predicts clearly better than the chosen one: what, and what it would need, in a
            sentence.
        calibration: with its own choice of corners.
    """

    kind: ShapeKind
    held: HeldOut | None = None
    rms_px: float = math.nan
    camera_bound_px: float = math.nan
    excess: float = math.nan
    excess_error: float = math.nan
    refused: str = ""
    would_bring: str = ""
    calibration: Calibration | None = None

    @property
    def ratio(self) -> float:
        """Error on held-out views over that of the fit."""
        return self.held_out_rms_px / max(self.rms_px, 1e-12)

    @property
    def held_out_rms_px(self) -> float:
        """NaN where it is not known."""
        return math.nan if self.held is None else self.held.rms_px


def choose_shape(
    board: Points3D, views: Sequence[BoardView], config: CalibrationConfig = CalibrationConfig(), *,
    shapes: Sequence[ShapeKind] = CANDIDATES, folds: int = 5, seed: int = 0,
) -> tuple[RankedShape, ...] | Rejected:  # fmt: skip
    """Shapes by the error of held-out views, the chosen one first.

    Corners that one of them leaves out are left out for all: first the best fitting one's, then, if another is chosen,
    the chosen one's, so that its errors are those of the camera that comes of it.

    Returns:
        what the first shape was refused for, where all are. Where views are too few to hold some out, the simplest
        shape comes first, and `refused` says so.
    """
    fits = {kind: _fit(board, views, dataclasses.replace(config, shape=kind)) for kind in shapes}
    good = {kind: fit for kind, fit in fits.items() if isinstance(fit, Calibration)}
    if not good:
        first = fits[shapes[0]]
        return first if isinstance(first, Rejected) else Rejected("no_shape", "none was asked for")
    by = min(good.values(), key=lambda fit: fit.sigma_px)
    ranked: tuple[RankedShape, ...] = ()
    for _ in range(_ROUNDS):
        rows: list[RankedShape] = []
        for kind in shapes:
            fit = fits[kind]
            if isinstance(fit, Rejected):
                rows.append(RankedShape(kind, refused=f"{fit.reason}: {fit.detail}"))
                continue
            plain = dataclasses.replace(config, shape=kind, reject=False)
            rows.append(_judged(board, fit, by, plain, folds, np.random.default_rng(seed)))
        ranked = _ranked(rows)
        chosen = ranked[0].calibration
        if ranked[0].held is None or chosen is None or _same_corners(chosen, by):
            break
        by = chosen
    return ranked


def _same_corners(one: Calibration, other: Calibration) -> bool:
    a, b = one.observations, other.observations
    return a.names == b.names and np.array_equal(a.offsets, b.offsets) and np.array_equal(a.rows, b.rows)


def free_is_too_large(points: int, corners: int) -> bool:
    """Whether so many corners, of a board of so many points that all are free, take minutes."""
    return corners * (3.0 * points) ** 2 > _LARGEST_WORK


def _fit(board: Points3D, views: Sequence[BoardView], config: CalibrationConfig) -> Calibration | Rejected:
    count = {"flat": 0, "scale": 1, "paraboloid": 3, "height": len(board), "free": 3 * len(board)}[config.shape]
    if sum(len(view.corner_ids) for view in views) * float(count) ** 2 > _LARGEST_WORK:
        return Rejected("too_large", "this many corners take minutes; it is done if it is asked for by name")
    return calibrate(board, views, config)


def _judged(
    board: Points3D, fit: Calibration, best: Calibration, config: CalibrationConfig, folds: int,
    rng: np.random.Generator,
) -> RankedShape:  # fmt: skip
    """A shape by the corners that the fit `best` keeps."""
    row = RankedShape(config.shape, calibration=fit)
    found = fit if fit is best else calibrate(board, views_of(best.observations), config)
    held = found if isinstance(found, Rejected) else hold_out(board, found, config, folds=folds, rng=rng)
    if isinstance(found, Rejected) or isinstance(held, Rejected):
        why = found if isinstance(found, Rejected) else held
        assert isinstance(why, Rejected)
        return dataclasses.replace(row, refused=f"{why.reason}: {why.detail}")
    if not math.isfinite(held.rms_px) or held.names != best.observations.names:
        return dataclasses.replace(row, refused="a held-out view is not seen")
    return dataclasses.replace(row, held=held, rms_px=found.rms_px, camera_bound_px=_camera_bound(found))


def _camera_bound(found: Calibration) -> float:
    covariances = covariance(found, alike=True)
    return math.inf if isinstance(covariances, Rejected) else rms_uncertainty(found, covariances, across=16)


def _ranked(rows: list[RankedShape]) -> tuple[RankedShape, ...]:
    able = [row for row in rows if row.held is not None]
    if not able:  # too few views to judge by: the simplest that can be had
        first = next(row for row in rows if row.calibration is not None)
        return (first, *(row for row in rows if row is not first))
    chosen, barred = able[0], dict[ShapeKind, tuple[str, str]]()
    for row in able[1:]:
        if not is_clearly_lower(_squares(row), _squares(chosen), _CLEAR):
            continue
        why = _why_not(row, chosen)
        if why:
            barred[row.kind] = why
        else:
            chosen = row
    best = min(able, key=lambda row: row.held_out_rms_px)
    judged = [_compared(row, best) for row in rows]
    told = [_told(row, chosen, barred.get(row.kind)) for row in judged]
    first = next(row for row in told if row.kind == chosen.kind)
    return (first, *(row for row in told if row is not first))


def _squares(row: RankedShape) -> Vector:
    assert row.held is not None
    return row.held.squares


def _why_not(row: RankedShape, simpler: RankedShape) -> tuple[str, str] | None:
    """Why a shape that predicts better is not taken all the same, and what it would need."""
    if row.camera_bound_px > _COST * simpler.camera_bound_px:
        times = f"{row.camera_bound_px / simpler.camera_bound_px:.2g} times"
        told = f"the camera would be {times} as uncertain as with {NAMES[simpler.kind]} one"
        return told, "boards that are tilted in more directions"
    if not generalises(row.ratio, simpler.ratio):
        times = f"{row.ratio:.2f} times its error on the photos it was fitted to (up to {GENERALISES:g} is believed)"
        return f"that is {times}", photos_needed(len(_squares(row)), row.ratio)
    return None


def _told(row: RankedShape, chosen: RankedShape, why: tuple[str, str] | None) -> RankedShape:
    """What stands beside a shape: why it was not taken, if it predicts better than the one that was.

    It may have been barred beside a simpler shape, and predict worse than the one that was taken in the end.
    """
    if row.held is None or row.kind == chosen.kind or not row.held_out_rms_px < chosen.held_out_rms_px:
        return row
    if why is None or not is_clearly_lower(_squares(row), _squares(chosen), _CLEAR):
        return dataclasses.replace(row, refused="not clearly better")
    errors = chosen.held_out_rms_px, row.held_out_rms_px
    brings = what_it_brings(f"{NAMES[row.kind]} board shape", errors, *why, f"--shape {row.kind}")
    return dataclasses.replace(row, refused=why[0], would_bring=brings)


def _compared(row: RankedShape, best: RankedShape) -> RankedShape:
    if row.held is None or best.held is None:
        return row
    excess = row.held.squares - best.held.squares
    error = float(np.std(excess, ddof=1) / math.sqrt(len(excess))) if len(excess) > 1 else math.inf
    return dataclasses.replace(row, excess=float(np.mean(excess)), excess_error=error)
