"""From what photos show of a board to a camera with its doubts.

    Sightings  →  `calibrate_camera`  →  CalibratedCamera

Commands share this: the lens and the board's shape are chosen where that is asked for, and the photos and the solution
are looked through for what is wrong.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Literal, TypeAlias

import numpy as np

from calib.board_turns import board_turns
from calib.circle_shifts import TRIED, with_exact_centres
from calib.cli.sightings import Sightings
from calib.cli.tried import with_what_was_measured, with_what_was_tried
from calib.diagnose import Finding, diagnose
from calib.diagnose_window import window_finding
from calib.refine import Calibration, CalibrationConfig, RejectedView, calibrate
from calib.refine_board import ShapeKind
from calib.refine_views import gather
from calib.turned_photos import turned_photos
from calib.uncertainty import CalibrationCovariance, covariance
from calib.uncertainty_holdout import HeldOut, SplitHalf, fit_poses, hold_out, split_half, views_of
from calib.uncertainty_lenses import RankedLens, choose_lens
from calib.uncertainty_shapes import RankedShape, choose_shape
from calib.yardstick import Yardstick, measure_lens
from sfm.core.arrays import Points3D, Value
from sfm.core.errors import Rejected
from sfm.core.events import SILENT, Observer, StageFinished, StageStarted

STAGE = "calibration"
AUTO = "auto"
Auto: TypeAlias = Literal["auto"]
_NAMED = 12
"""Photos that a finding names."""
_WHILE_LENS_IS_CHOSEN: ShapeKind = "paraboloid"
"""Of all shapes it costs least where it is not needed, and takes most of a bend."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class CameraPlan:
    """How a camera is to be calibrated."""

    lens: str = AUTO
    """Row of `refine_lenses.LENSES`, or auto: the one that predicts held-out views best."""
    shape: ShapeKind | Auto = "auto"
    """What the board may be (see `refine_board`), or auto: what predicts held-out views best."""
    focal_px: float | None = None
    """First guess where it is known."""
    folds: int = 5
    """Of the held-out views."""
    seed: int = 0
    """Of the choice of views that are held out."""

    @property
    def config(self) -> CalibrationConfig:
        """For the solver; lens and shape are defaults where they are still to be chosen."""
        config = CalibrationConfig(focal_px=self.focal_px)
        if self.lens != AUTO:
            config = dataclasses.replace(config, lens=self.lens)
        return config if self.shape == "auto" else dataclasses.replace(config, shape=self.shape)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CalibratedCamera(Value):
    """A calibration, and what is to be thought of it.

    Attributes:
        lenses, shapes: ranked, the chosen one first; empty where it was given.
        covariances, by_view: residuals taken for independent, and only views; see `uncertainty`.
        held_out, halves: errors on views that were held out, and the difference between the cameras of halves.
        flat_px: error on views that were held out with the board taken for flat; NaN where it is not known.
        left_out: photos and views without a part in it, from detection on.
        findings: the gravest first.
        would_bring: what a richer lens and board shape would bring that were not taken, and need; a sentence each.
        yardstick: the lens beside a splined one; None where it was given rather than chosen.
    """

    found: Calibration
    config: CalibrationConfig
    lenses: tuple[RankedLens, ...]
    shapes: tuple[RankedShape, ...]
    covariances: CalibrationCovariance | Rejected
    by_view: CalibrationCovariance | Rejected
    held_out: HeldOut | Rejected
    halves: SplitHalf | Rejected
    left_out: tuple[RejectedView, ...]
    findings: tuple[Finding, ...]
    flat_px: float = math.nan
    would_bring: tuple[str, ...] = ()
    yardstick: Yardstick | Rejected | None = None

    @property
    def doubts(self) -> CalibrationCovariance | Rejected:
        """What is told as uncertainty: by views, or, where these are too few for that, its lower bound."""
        return self.covariances if isinstance(self.by_view, Rejected) else self.by_view


def calibrate_camera(
    seen: Sightings, plan: CameraPlan = CameraPlan(), *, observer: Observer = SILENT
) -> CalibratedCamera | Rejected:
    """The camera that took the photos, with its errors on views that it has not seen and what is wrong with it.

    Returns:
        why there is none; see `calibrate` and `choose_lens`.
    """
    observer(StageStarted(stage=STAGE))
    turns = board_turns(seen.board) if seen.board is not None else ()
    config = dataclasses.replace(plan.config, turns=turns)
    lenses_of_centres = TRIED if plan.lens == AUTO else (plan.lens,)
    views = with_exact_centres(seen.board, seen.views, config, lenses=lenses_of_centres)
    seen = dataclasses.replace(seen, views=views)
    lenses: tuple[RankedLens, ...] = ()
    shapes: tuple[RankedShape, ...] = ()
    if plan.lens == AUTO:
        trial = dataclasses.replace(config, shape=_WHILE_LENS_IS_CHOSEN) if plan.shape == "auto" else config
        ranked = choose_lens(seen.points3D, seen.views, trial, folds=plan.folds, seed=plan.seed)
        if isinstance(ranked, Rejected):
            return ranked
        lenses, config = ranked, dataclasses.replace(config, lens=ranked[0].lens)
    found = held_out = None
    if plan.shape == "auto":
        judged = choose_shape(seen.points3D, seen.views, config, folds=plan.folds, seed=plan.seed)
        if isinstance(judged, Rejected):
            return judged
        shapes, config = judged, dataclasses.replace(config, shape=judged[0].kind)
        found, held_out = judged[0].calibration, judged[0].held
    if found is None:
        found = calibrate(seen.points3D, seen.views, config)
    if isinstance(found, Rejected):
        return found
    if held_out is None or held_out.counts.sum() != len(found.residuals):
        held_out = hold_out(seen.points3D, found, config, folds=plan.folds, rng=np.random.default_rng(plan.seed))
    halves = split_half(seen.points3D, found, config, rng=np.random.default_rng(plan.seed))
    plain, by_view = covariance(found), covariance(found, by_view=True)
    made = CalibratedCamera(
        found=found,
        config=config,
        lenses=lenses,
        shapes=shapes,
        covariances=plain,
        by_view=by_view,
        held_out=held_out,
        halves=halves,
        left_out=(*seen.left_out, *found.rejected_views),
        findings=with_what_was_tried(
            _findings(seen, found, config, plain if isinstance(by_view, Rejected) else by_view), lenses, shapes
        ),
        flat_px=_held_out_flat(seen, found, config, shapes, held_out, plan),
        would_bring=(*would_bring(lenses), *would_bring(shapes)),
    )
    made = with_yardstick(made, seen.points3D, plan) if plan.lens == AUTO else made
    observer(StageFinished(stage=STAGE, summary=f"rms {found.rms_px:.4f} px"))
    return made


def with_yardstick(made: CalibratedCamera, board: Points3D, plan: CameraPlan = CameraPlan()) -> CalibratedCamera:
    """The same, with its lens beside a splined one, and what follows for the findings."""
    held_out_px = math.inf if isinstance(made.held_out, Rejected) else made.held_out.rms_px
    rng = np.random.default_rng(plan.seed)
    measured = measure_lens(board, made.found, made.config, held_out_px, folds=plan.folds, rng=rng)
    if isinstance(measured, Rejected):
        return dataclasses.replace(made, yardstick=measured)
    return dataclasses.replace(
        made, yardstick=measured, findings=with_what_was_measured(made.findings, measured)
    )  # fmt: skip


def _held_out_flat(
    seen: Sightings, found: Calibration, config: CalibrationConfig, shapes: Sequence[RankedShape],
    held_out: HeldOut | Rejected, plan: CameraPlan,
) -> float:  # fmt: skip
    """What photos of another board may err by, whose shape is not known."""
    if config.shape == "flat":
        return math.nan if isinstance(held_out, Rejected) else held_out.rms_px
    if known := [row.held_out_rms_px for row in shapes if row.kind == "flat"]:
        return known[0]
    plain = dataclasses.replace(config, shape="flat", reject=False)
    flat = calibrate(seen.points3D, views_of(found.observations), plain)
    if isinstance(flat, Rejected):
        return math.nan
    held = hold_out(seen.points3D, flat, plain, folds=plan.folds, rng=np.random.default_rng(plan.seed))
    return math.nan if isinstance(held, Rejected) else held.rms_px


def would_bring(rows: Sequence[RankedLens | RankedShape]) -> list[str]:
    """What the best of those would bring that predict better than the one that was taken; at most one sentence."""
    able = [row for row in rows if row.would_bring]
    return [min(able, key=lambda row: row.held_out_rms_px).would_bring] if able else []


def _findings(
    seen: Sightings, found: Calibration, config: CalibrationConfig, doubts: CalibrationCovariance | Rejected
) -> tuple[Finding, ...]:  # fmt: skip
    """Of the corners all are looked at, whether they were left out or not: what they were left out for is a cause."""
    alike = [view for view in seen.views if (view.width, view.height) == (found.camera.width, found.camera.height)]
    system, _ = fit_poses(found.camera, found.shape, gather(seen.points3D, alike))
    window = window_finding(system.observations, system.residuals())
    turned = tuple(_turned(seen, config))
    return (*turned, *filter(None, [window]), *diagnose(found, doubts, is_explained=bool(turned)))


def _turned(seen: Sightings, config: CalibrationConfig) -> Iterator[Finding]:
    turned = turned_photos(seen.points3D, seen.views, config)
    if turned is None:
        return
    named = ", ".join(turned.names[:_NAMED]) + (
        f" and {len(turned.names) - _NAMED} more" if turned.names[_NAMED:] else ""
    )
    yield Finding(
        "turned_photos",
        f"{named}: turned by 180° in the file against the other photos; as they are the error is "
        f"{turned.rms_px:.3f} px, with these turned back {turned.turned_back_rms_px:.3f} px",
        "turn them back, or take the photos as the camera wrote them",
    )
