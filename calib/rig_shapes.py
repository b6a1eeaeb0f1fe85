"""Which shape of the board predicts frames best that a rig has not seen.

As `uncertainty_shapes` for one camera: from the simplest on, a richer shape has to be clearly better on held-out frames
and to generalise, all by the corners that the best fitting one keeps. A board that is bent and taken for flat bends
cameras and baseline alike.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from calib.board_turns import BoardTurn
from calib.refine_board import ShapeKind
from calib.rig import RigCalibration, RigConfig, calibrate_rig
from calib.rig_uncertainty import RigHeldOut, hold_out_frames
from calib.rig_views import RigCamera
from calib.uncertainty_choice import GENERALISES, generalises, is_clearly_lower, photos_needed, what_it_brings
from calib.uncertainty_holdout import views_of
from calib.uncertainty_shapes import NAMES
from sfm.core.arrays import Points3D, Value, Vector
from sfm.core.errors import Rejected

CANDIDATES: tuple[ShapeKind, ...] = ("flat", "paraboloid", "free")
"""From the simplest to the richest."""
_LARGEST_WORK = 1e10
"""Corners times squared number of coefficients, beyond which a shape takes minutes."""
_CLEAR = 2.0
"""Standard errors by which a richer shape has to be better."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RankedRig(Value):
    """A rig with one shape of the board among others.

    Attributes:
        found: with its own choice of corners.
        held: errors on held-out frames, of the corners that the best fitting shape keeps; the chosen one by its own.
        refused: why there is no such rig, or why it is not judged, or not to be chosen.
        would_bring: of one that predicts clearly better than the chosen one: what, and what it would need, in a
            sentence.
    """

    kind: ShapeKind
    found: RigCalibration | None = None
    held: RigHeldOut | None = None
    refused: str = ""
    would_bring: str = ""

    @property
    def ratio(self) -> float:
        """Error on held-out frames over that of the same frames in the fit."""
        return math.nan if self.held is None else self.held.rms_px / max(self.held.training_rms_px, 1e-12)

    @property
    def held_out_rms_px(self) -> float:
        """NaN where it is not known."""
        return math.nan if self.held is None else self.held.rms_px


def choose_rig_shape(
    board: Points3D, cameras: Sequence[RigCamera], config: RigConfig = RigConfig(), *,
    turns: Sequence[BoardTurn] = (), shapes: Sequence[ShapeKind] = CANDIDATES, folds: int = 5, seed: int = 0,
) -> tuple[RankedRig, ...] | Rejected:  # fmt: skip
    """Rigs by shape, the chosen one first.

    Returns:
        what the first shape was refused for, where all are.
    """
    rows, refusals = [], []
    corners = sum(len(view.corner_ids) for one in cameras for view in one.views)
    for kind in shapes:
        count = {"flat": 0, "scale": 1, "paraboloid": 3, "height": len(board), "free": 3 * len(board)}[kind]
        if len(shapes) > 1 and corners * float(count) ** 2 > _LARGEST_WORK:
            rows.append(RankedRig(kind, refused="takes minutes; it is done if it is asked for by name"))
            continue
        found = calibrate_rig(board, cameras, dataclasses.replace(config, shape=kind), turns=turns)
        if isinstance(found, Rejected):
            refusals.append(found)
            rows.append(RankedRig(kind, refused=f"{found.reason}: {found.detail}"))
        else:
            rows.append(RankedRig(kind, found))
    able = [row.found for row in rows if row.found is not None]
    if not able:
        return refusals[0] if refusals else Rejected("no_shape", "none was asked for")
    best = min(able, key=lambda found: found.sigma_px)
    judged = [_judged(board, row, best, cameras, config, folds, seed) for row in rows]
    chosen, *others = _ranked(judged)
    return (_by_its_own_corners(chosen, folds, seed), *others)


def _by_its_own_corners(row: RankedRig, folds: int, seed: int) -> RankedRig:
    """With the errors of frames held out at the corners that it is reported for."""
    if row.found is None or row.held is None:
        return row
    held = hold_out_frames(row.found, folds=folds, rng=np.random.default_rng(seed))
    return row if isinstance(held, Rejected) else dataclasses.replace(row, held=held)


def _judged(
    board: Points3D, row: RankedRig, best: RigCalibration, cameras: Sequence[RigCamera], config: RigConfig, folds: int,
    seed: int,
) -> RankedRig:  # fmt: skip
    """A shape by the corners that the best one keeps, read from the side that it found."""
    if row.found is None:
        return row
    found: RigCalibration | Rejected = row.found
    if found is not best:
        same = [_kept(best, c, one) for c, one in enumerate(cameras)]
        found = calibrate_rig(board, same, dataclasses.replace(config, shape=row.kind, reject=False))
    held = (
        found if isinstance(found, Rejected) else hold_out_frames(found, folds=folds, rng=np.random.default_rng(seed))
    )
    if isinstance(held, Rejected):
        return dataclasses.replace(row, refused=f"{held.reason}: {held.detail}")
    return dataclasses.replace(row, held=held)


def _kept(best: RigCalibration, c: int, camera: RigCamera) -> RigCamera:
    seen, of = best.observations.cameras[c], best.observations.frame_of[c]
    frames = tuple(best.observations.frames[f] for f in of)
    # Weights are those of the cameras, which are found anew.
    plain = dataclasses.replace(seen, roots=seen.roots / np.median(seen.roots[:, 0]))
    return dataclasses.replace(camera, views=tuple(views_of(plain)), frames=frames)


def _ranked(rows: Sequence[RankedRig]) -> tuple[RankedRig, ...]:
    judged = [row for row in rows if row.found is not None and row.held is not None and row.found.converged]
    if not judged:
        first = next(row for row in rows if row.found is not None)
        return (first, *(row for row in rows if row is not first))
    chosen, barred = judged[0], list[RankedRig]()
    for row in judged[1:]:
        if not is_clearly_lower(*_squares(row, chosen), _CLEAR):
            continue
        if generalises(row.ratio, chosen.ratio):
            chosen = row
        else:
            barred.append(row)
    told = [_told(row, chosen) if any(row is other for other in barred) else row for row in rows]
    first = next(row for row in told if row.kind == chosen.kind)
    return (first, *(row for row in told if row is not first))


def _told(row: RankedRig, chosen: RankedRig) -> RankedRig:
    """A shape that predicts frames better than a simpler one but does not generalise, with what it would bring."""
    times = f"{row.ratio:.2f} times its error on the photos it was fitted to (up to {GENERALISES:g} is believed)"
    squares = _squares(row, chosen)
    brings = ""
    if is_clearly_lower(*squares, _CLEAR):
        errors = chosen.held_out_rms_px, row.held_out_rms_px
        needs = photos_needed(len(squares[0]), row.ratio, "frames")
        name, option = f"{NAMES[row.kind]} board shape", f"--shape {row.kind}"
        brings = what_it_brings(name, errors, f"that is {times}", needs, option)
    return dataclasses.replace(row, refused=f"that is {times}", would_bring=brings)


def _squares(row: RankedRig, other: RankedRig) -> tuple[Vector, Vector]:
    """Squared errors of both, of the frames that both have."""
    assert row.held is not None
    assert other.held is not None
    _, at1, at2 = np.intersect1d(row.held.frames, other.held.frames, return_indices=True)
    return row.held.squares[at1], other.held.squares[at2]
