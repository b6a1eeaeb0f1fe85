"""Which shape of the board predicts frames best that a rig has not seen.

As `uncertainty_shapes` for one camera: the simplest shape whose error on held-out frames is within a standard error of
the best one, all by the corners that the best fitting one keeps. A board that is bent and taken for flat bends cameras
and baseline alike.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from calib.refine_board import ShapeKind
from calib.rig import RigCalibration, RigConfig, calibrate_rig
from calib.rig_poses import BoardTurn
from calib.rig_uncertainty import RigHeldOut, hold_out_frames
from calib.rig_views import RigCamera
from calib.uncertainty_holdout import views_of
from sfm.core.arrays import Points3D, Value
from sfm.core.errors import Rejected

CANDIDATES: tuple[ShapeKind, ...] = ("flat", "paraboloid", "free")
"""From the simplest to the richest."""
_LARGEST_WORK = 1e10
"""Corners times squared number of coefficients, beyond which a shape takes minutes."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RankedRig(Value):
    """A rig with one shape of the board among others.

    Attributes:
        found: with its own choice of corners.
        held: errors on held-out frames, of the corners that the best fitting shape keeps.
        refused: why there is no such rig, or why it is not judged.
    """

    kind: ShapeKind
    found: RigCalibration | None = None
    held: RigHeldOut | None = None
    refused: str = ""

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
    chosen = _chosen(judged)
    return (chosen, *(row for row in judged if row is not chosen))


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


def _chosen(rows: Sequence[RankedRig]) -> RankedRig:
    judged = [row for row in rows if row.found is not None and row.held is not None and row.found.converged]
    if not judged:
        return next(row for row in rows if row.found is not None)
    best = min(judged, key=lambda row: row.held_out_rms_px)
    return next(row for row in judged if _as_good(row.held, best.held))


def _as_good(held: RigHeldOut | None, best: RigHeldOut | None) -> bool:
    """Whether its frames, of those that both have, are worse by less than the standard error of the difference."""
    assert held is not None
    assert best is not None
    _, at1, at2 = np.intersect1d(held.frames, best.frames, return_indices=True)
    excess = held.squares[at1] - best.squares[at2]
    if len(excess) < 2:
        return True
    return bool(excess.mean() <= excess.std(ddof=1) / math.sqrt(len(excess)))
