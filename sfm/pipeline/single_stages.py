"""The stages up to verification one by one: each does what is missing before it, and says what it came to.

They leave in the workspace what a whole run would leave, under the same keys, so that a later run goes on from there.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from sfm.core.errors import Rejected
from sfm.core.events import SILENT, Event, Note, Observer, StageStarted
from sfm.core.graphs import connected_components
from sfm.core.scene import PairKind, TwoViewGeometry
from sfm.pipeline.config import DEFAULTS, PipelineConfig
from sfm.pipeline.pairs import first_pairs, match_and_verify
from sfm.pipeline.session import Session, session
from sfm.pipeline.stage_reports import (
    FeaturesReport,
    MatchesReport,
    PairsReport,
    VerificationReport,
    VerifiedPair,
)
from sfm.pipeline.stages import Pair, Run, extract_all, match_all

_BEFORE = {
    "features": (),
    "pairs": ("features",),
    "match": ("features", "pairs"),
    "verify": ("features", "pairs", "matching"),
}
"""Stages, as their events call them, that come before a command's own."""


def run_features(
    images_folder: Path | str | None,
    workspace: Path | str,
    config: PipelineConfig = DEFAULTS,
    *,
    threads: int = 0,
    observer: Observer = SILENT,
) -> FeaturesReport:
    """Features of all photos.

    Args:
        images_folder: None for the one that the workspace was made from.
    Raises:
        As `reconstruct`, but for ReconstructionError.
    """
    with _stage("features", images_folder, workspace, config, threads, observer) as at_work:
        extract_all(at_work.run)
        return _features_report(at_work)


def run_pairs(
    workspace: Path | str, config: PipelineConfig = DEFAULTS, *, threads: int = 0, observer: Observer = SILENT
) -> PairsReport:
    """Which pairs are to be matched; the photos are those that the workspace was made from."""
    with _stage("pairs", None, workspace, config, threads, observer) as at_work:
        run = at_work.run
        choice = first_pairs(run, extract_all(run))
        names = tuple(image.name for image in run.images.values())
        return PairsReport(at_work.workspace, names, [run.pair_names(pair) for pair in choice.pairs], choice.why)


def run_matching(
    workspace: Path | str, config: PipelineConfig = DEFAULTS, *, threads: int = 0, observer: Observer = SILENT
) -> MatchesReport:
    """Matches of the chosen pairs, as yet without the missing links that verification may ask for."""
    with _stage("match", None, workspace, config, threads, observer) as at_work:
        run = at_work.run
        feature_keys = extract_all(run)
        pairs = match_all(run, feature_keys, first_pairs(run, feature_keys).pairs)
        counts = run.database.match_counts()
        needed = config.verification.ransac.min_inliers
        return MatchesReport(at_work.workspace, {run.pair_names(pair): counts[pair] for pair in sorted(pairs)}, needed)


def run_verification(
    workspace: Path | str, config: PipelineConfig = DEFAULTS, *, threads: int = 0, observer: Observer = SILENT
) -> VerificationReport:
    """The geometry of all pairs; where it leaves weak spots, more pairs are matched and verified."""
    with _stage("verify", None, workspace, config, threads, observer) as at_work:
        run = at_work.run
        _, pairs = match_and_verify(run, extract_all(run))
        return _verification_report(at_work, sorted(pairs))


@contextlib.contextmanager
def _stage(
    command: str,
    images_folder: Path | str | None,
    workspace: Path | str,
    config: PipelineConfig,
    threads: int,
    observer: Observer,
) -> Iterator[Session]:
    """A session that says so where stages before the command's own have work left."""

    def tell(event: Event, /) -> None:
        if isinstance(event, StageStarted) and event.total and event.stage in _BEFORE[command]:
            observer(Note(message=f"first completing the {event.stage} that `sfm {command}` builds on"))
        observer(event)

    with session(images_folder, workspace, config, command=command, threads=threads, observer=tell) as at_work:
        yield at_work


def _features_report(at_work: Session) -> FeaturesReport:
    run = at_work.run
    counts = run.database.feature_counts()
    keypoints = {image.name: counts[image_id] for image_id, image in run.images.items()}
    refused = {
        row.item: row.verdict.replace("_", " ")
        for row in run.database.ledger(stage="features")
        if row.gate == "keypoints" and row.verdict != "kept" and row.item in keypoints
    }
    return FeaturesReport(at_work.workspace, keypoints, refused, at_work.scene.skipped)


def _verification_report(at_work: Session, pairs: list[Pair]) -> VerificationReport:
    run = at_work.run
    matches = run.database.match_counts()
    rows = [
        _verified(run, pair, matches[pair], geometry)
        for pair, geometry in ((pair, run.database.read_geometry(*pair)) for pair in pairs)
    ]
    ids = list(run.images)
    place = {image_id: k for k, image_id in enumerate(ids)}
    links = [(place[i], place[j]) for i, j in run.database.linked_pairs()]
    groups = connected_components(len(ids), np.array(links, np.int64).reshape(-1, 2))
    names = [[run.images[ids[k]].name for k in group] for group in groups]
    return VerificationReport(at_work.workspace, at_work.images_folder, rows, names)


def _verified(run: Run, pair: Pair, matches: int, geometry: TwoViewGeometry | Rejected) -> VerifiedPair:
    names = run.pair_names(pair)
    if isinstance(geometry, Rejected):
        return VerifiedPair(*names, matches, 0, "", None, geometry.reason)
    posed = geometry.cam2_from_cam1 is not None and geometry.kind != PairKind.PANORAMIC
    angle = float(np.rad2deg(geometry.tri_angle)) if posed else None
    return VerifiedPair(*names, matches, len(geometry), geometry.kind.name.lower(), angle, "")
