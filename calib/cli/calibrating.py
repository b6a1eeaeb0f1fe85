"""From photos of a board to what calibration is given, and from there to a camera with its doubts.

    photos, or corners that someone else found  →  `see_board`  →  Sightings  →  `calibrate_camera`  →  CalibratedCamera

Commands share this: what is left out carries its reason from the photo on, whoever left it out.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from calib.boards import Board
from calib.cli.photos import detect_photos, detection_cache, find_photos
from calib.detect import Detection
from calib.diagnose import Finding, diagnose
from calib.refine import Calibration, CalibrationConfig, RejectedView, calibrate
from calib.refine_board import ShapeKind
from calib.refine_views import BoardView
from calib.uncertainty import CalibrationCovariance, covariance
from calib.uncertainty_holdout import HeldOut, RankedLens, SplitHalf, choose_lens, hold_out, split_half
from sfm.core.arrays import Points3D, Value
from sfm.core.errors import Rejected
from sfm.core.events import SILENT, Observer, StageFinished, StageStarted

STAGE = "calibration"
AUTO = "auto"


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
    shape: ShapeKind = "flat"
    """What the board may be; see `refine_board`."""
    focal_px: float | None = None
    """First guess where it is known."""
    folds: int = 5
    """Of the held-out views."""
    seed: int = 0
    """Of the choice of views that are held out."""

    @property
    def config(self) -> CalibrationConfig:
        """For the solver; the lens is its default where it is still to be chosen."""
        config = CalibrationConfig(shape=self.shape, focal_px=self.focal_px)
        return config if self.lens == AUTO else dataclasses.replace(config, lens=self.lens)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CalibratedCamera(Value):
    """A calibration, and what is to be thought of it.

    Attributes:
        ranking: of lens models, the chosen one first; empty where it was given.
        covariances, by_view: residuals taken for independent, and only views; see `uncertainty`.
        held_out, halves: errors on views that were held out, and the difference between the cameras of two halves.
        left_out: photos and views without a part in it, from detection on.
        findings: the gravest first.
    """

    found: Calibration
    ranking: tuple[RankedLens, ...]
    covariances: CalibrationCovariance | Rejected
    by_view: CalibrationCovariance | Rejected
    held_out: HeldOut | Rejected
    halves: SplitHalf | Rejected
    left_out: tuple[RejectedView, ...]
    findings: tuple[Finding, ...]


def see_board(
    sources: Sequence[Path], board: Board, *, threads: int = 0, use_cache: bool = True, weighted: bool = True,
    observer: Observer = SILENT,
) -> Sightings:  # fmt: skip
    """Looks for a board in photos.

    Args:
        sources: folders of photos, or photos.
        threads: 0 for all cores.
        use_cache: takes what was found before, and keeps what is found.
        weighted: views carry the covariances of their corners.
    Raises:
        InputError: there are no photos.
    """
    photos = find_photos(sources)
    cache = detection_cache() if use_cache else None
    seen = detect_photos(photos, board, threads=threads, cache=cache, observer=observer)
    return Sightings(board, board.points3D, *sorted_out(seen, weighted=weighted), digest=digest_of(photos))


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
    config, ranking = plan.config, ()
    if plan.lens == AUTO:
        ranking = choose_lens(seen.points3D, seen.views, config, folds=plan.folds, seed=plan.seed)
        if isinstance(ranking, Rejected):
            return ranking
        config = dataclasses.replace(config, lens=ranking[0].lens)
    found = calibrate(seen.points3D, seen.views, config)
    if isinstance(found, Rejected):
        return found
    held_out = hold_out(seen.points3D, found, config, folds=plan.folds, rng=np.random.default_rng(plan.seed))
    halves = split_half(seen.points3D, found, config, rng=np.random.default_rng(plan.seed))
    observer(StageFinished(stage=STAGE, summary=f"rms {found.rms_px:.4f} px"))
    return CalibratedCamera(
        found,
        ranking,
        covariance(found),
        covariance(found, by_view=True),
        held_out,
        halves,
        (*seen.left_out, *found.rejected_views),
        diagnose(found),
    )
