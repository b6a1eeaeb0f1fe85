"""From photos of a board to what calibration is given, and from there to a camera with its doubts.

    photos, or corners that someone else found  →  `see_board`  →  Sightings  →  `calibrate_camera`  →  CalibratedCamera

Commands share this: what is left out carries its reason from the photo on, whoever left it out.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from calib.board_turns import board_turns
from calib.boards import Board
from calib.cli.corner_files import corner_files, read_corners
from calib.cli.photos import detect_photos, detection_cache, find_photos
from calib.cli.tried import with_what_was_measured, with_what_was_tried
from calib.detect import Detection
from calib.diagnose import Finding, diagnose
from calib.diagnose_window import window_finding
from calib.refine import Calibration, CalibrationConfig, RejectedView, calibrate
from calib.refine_board import ShapeKind
from calib.refine_views import BoardView, gather
from calib.turned_photos import turned_photos
from calib.uncertainty import CalibrationCovariance, covariance
from calib.uncertainty_holdout import (
    HeldOut,
    RankedLens,
    SplitHalf,
    choose_lens,
    fit_poses,
    hold_out,
    split_half,
    views_of,
)
from calib.uncertainty_shapes import RankedShape, choose_shape
from calib.yardstick import Yardstick, measure_lens
from sfm.core.arrays import Points3D, Value
from sfm.core.errors import ConfigError, Rejected
from sfm.core.events import SILENT, Observer, StageFinished, StageStarted
from sfm.io.images import list_images

STAGE = "calibration"
AUTO = "auto"
_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".heic", ".jp2")
Auto: TypeAlias = Literal["auto"]
_NAMED = 12
"""Photos that a finding names."""
_WHILE_LENS_IS_CHOSEN: ShapeKind = "paraboloid"
"""Of all shapes it costs least where it is not needed, and takes most of a bend."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Sightings(Value):
    """What photos of one camera show of a board.

    Attributes:
        board: what was looked for; None where corners came from elsewhere without saying of what.
        points3D: (P, 3) its points, metres.
        views: of the photos that show it, in the order of the photos.
        left_out: photos that do not, and why.
        digest: of the contents of all files, in their order.
        kind: what the files are: photos, corners.
    """

    board: Board | None
    points3D: Points3D
    views: tuple[BoardView, ...]
    left_out: tuple[RejectedView, ...]
    digest: str
    kind: str = "photos"

    @property
    def count(self) -> int:
        """Of photos, whether they show the board or not."""
        return len(self.views) + len(self.left_out)


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


def see_board(
    sources: Sequence[Path], board: Board | None, *, size: tuple[int, int] | None = None, threads: int = 0,
    use_cache: bool = True, weighted: bool = False, observer: Observer = SILENT,
) -> Sightings:  # fmt: skip
    """Looks for a board in photos, or reads corners that were found before.

    Args:
        sources: folders of photos, photos, or files of corners; see `corner_files`.
        board: may be None for files that name it.
        size: width and height in px, for files of corners that do not tell it.
        threads: 0 for all cores.
        use_cache: takes what was found before, and keeps what is found.
        weighted: views carry the covariances of their corners. They tell how well a corner's pixels fix it, but not
            what its surroundings shift it by, which is most: with them, held-out views of nine sets of photos come out
            0 to 10 % worse.
    Raises:
        InputError: there are no photos, or a file of corners does not do.
        ConfigError: there is no board, or no size where it is needed.
    """
    files = corner_files(sources)
    if files:
        found, points3D, views, left_out = read_corners(files, board, size)
        return Sightings(found, points3D, views, left_out, digest_of(files), "corners")
    if board is None:
        raise ConfigError("no board is named", remedy="for example --board chessboard:9x6:25mm (inner corners)")
    photos = find_photos(sources)
    cache = detection_cache() if use_cache else None
    seen = detect_photos(photos, board, threads=threads, cache=cache, observer=observer)
    views, left_out = sorted_out(seen, weighted=weighted)
    return Sightings(board, board.points3D, views, (*_not_images(sources), *left_out), digest_of(photos))


def _not_images(sources: Sequence[Path]) -> list[RejectedView]:
    """Files in folders that are images by their suffix only."""
    skipped = [pair for source in sources if source.is_dir() for pair in list_images(source).skipped]
    return [
        RejectedView(name, "unreadable", why) for name, why in skipped if Path(name).suffix.lower() in _IMAGE_SUFFIXES
    ]


def sorted_out(
    seen: Mapping[str, Detection | Rejected], *, weighted: bool = True
) -> tuple[tuple[BoardView, ...], tuple[RejectedView, ...]]:
    """Views of the photos that show the board, and the others with the reason."""
    views, left_out = [], []
    for name, detection in seen.items():
        if isinstance(detection, Rejected):
            left_out.append(RejectedView(name, detection.reason, detection.detail))
        else:
            views.append(view_of(detection, weighted=weighted))
    return tuple(views), tuple(left_out)


def view_of(detection: Detection, *, weighted: bool = True) -> BoardView:
    """A detection as calibration wants it."""
    return BoardView(
        detection.name,
        detection.width,
        detection.height,
        detection.corner_ids,
        detection.points2D,
        detection.covariances if weighted else None,
    )


def digest_of(files: Mapping[str, Path]) -> str:
    """Of the contents in this order, whatever the names; a file that cannot be read counts as empty."""
    digest = hashlib.blake2b(digest_size=16)
    for path in files.values():
        try:
            digest.update(hashlib.blake2b(path.read_bytes(), digest_size=16).digest())
        except OSError:
            digest.update(bytes(16))
    return digest.hexdigest()


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
    return (*_turned(seen, config), *filter(None, [window]), *diagnose(found, doubts))


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
