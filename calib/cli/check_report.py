"""A checked camera for a person and for a program."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from calib.check import GRAVE, CameraCheck
from calib.cli.sightings import Sightings
from calib.cli.suggestions_text import suggestion_lines, suggestions_json
from calib.next_views import SuggestedView
from sfm.io.camera_records import CameraRecord

_MANY = 12


def check_json(
    check: CameraCheck, seen: Sightings, record: CameraRecord, suggested: Sequence[SuggestedView], limit_from: str
) -> dict[str, Any]:
    """Everything, as plain values; what is not known is null."""
    rms, counts = check.found.view_rms_px, np.diff(check.found.observations.offsets)
    return {
        "verdict": "failed" if check.failed else "passed",
        "rms_px": check.rms_px,
        "limit_px": check.limit_px,
        "limit_from": limit_from,
        "calibration": {
            "rms_px": _finite(record.number("rms_px")),
            "holdout_rms_px": _finite(record.number("holdout_rms_px")),
            "findings": [dict(zip(("cause", "detail", "remedy"), words, strict=True)) for words in record.findings],
        },
        "same_photos": _is_same(seen, record),
        "rms_px_with_free_focal_and_center": _finite(check.free_rms_px),
        "changes": {name: {"difference": d, "sigma": sigma} for name, (d, sigma) in check.changes.items()},
        seen.kind: {"count": seen.count, "digest": seen.digest},
        "views": [
            {"name": name, "corners": int(counts[v]), "rms_px": float(rms[v])}
            for v, name in enumerate(check.found.observations.names)
        ],
        "rejected": [dataclasses.asdict(view) for view in (*seen.left_out, *check.left_out)],
        "findings": [dataclasses.asdict(f) | {"fails": f.cause in GRAVE} for f in check.findings],
        "suggestions": suggestions_json(suggested),
    }


def check_lines(
    check: CameraCheck, seen: Sightings, record: CameraRecord, suggested: Sequence[SuggestedView], limit_from: str
) -> Iterator[str]:
    """Verdict, errors, what has changed, what is wrong, what would help."""
    camera = check.found.camera
    grave = ", ".join(finding.cause for finding in check.findings if finding.cause in GRAVE)
    yield f"{f'FAILED: {grave};' if grave else 'passed:'} error {check.rms_px:.4f} px, {check.limit_px:.4f} px allowed"
    yield f"allowed is {limit_from}"
    kind = "photos" if seen.kind == "photos" else "views"
    yield (
        f"{len(check.found.observations)} of {seen.count} {kind} of {camera.width} × {camera.height} px, "
        f"{len(check.found.residuals)} corners; only the poses of the board are fitted"
    )
    trained, held = record.number("rms_px"), record.number("holdout_rms_px")
    if not math.isnan(trained):
        told = "" if math.isnan(held) else f", {held:.4f} px on photos held out"
        yield f"when it was calibrated: {trained:.4f} px{told}"
    if _is_same(seen, record):
        yield "these are the very photos that it was calibrated from: the error says nothing of others"
    if check.changes:
        yield from ("", "focal length and principal point by these photos, less those of the file")
        told = (f"{name} {difference:+.3f} ± {sigma:.3f} px" for name, (difference, sigma) in check.changes.items())
        yield f"  {', '.join(told)}; error {check.free_rms_px:.4f} px with them"
    left_out = (*seen.left_out, *check.left_out)
    if left_out:
        yield from ("", "left out")
        for view in left_out[:_MANY]:
            yield f"  {view.name}: {view.reason}{f' ({view.detail})' if view.detail else ''}"
        if len(left_out) > _MANY:
            yield f"  and {len(left_out) - _MANY} more"
    if check.findings:
        yield from ("", "in these photos")
        for finding in check.findings:
            yield from (f"  {finding.cause}: {finding.detail}", f"    → {finding.remedy}")
    if record.findings:
        yield from ("", "in the calibration")
        for cause, detail, remedy in record.findings:
            yield from (f"  {cause}: {detail}", f"    → {remedy}")
    yield from suggestion_lines(suggested)


def _is_same(seen: Sightings, record: CameraRecord) -> bool:
    return record.facts.get("photos_digest") == seen.digest


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
