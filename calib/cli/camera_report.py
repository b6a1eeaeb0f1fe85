"""A calibrated camera for a person, for a program, and for its file."""

from __future__ import annotations

import dataclasses
import datetime
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from calib import __version__
from calib.cli.calibrating import CalibratedCamera, would_bring
from calib.cli.sightings import Sightings
from calib.cli.suggestions_text import suggestion_lines, suggestions_json
from calib.cli.yardstick_text import yardstick_json, yardstick_lines
from calib.next_views import SuggestedView
from calib.refine import Calibration
from calib.uncertainty import CalibrationCovariance, rms_uncertainty, uncertainty_map
from calib.uncertainty_holdout import HeldOut, SplitHalf
from calib.uncertainty_lenses import RankedLens
from calib.uncertainty_shapes import RankedShape
from sfm.core.errors import Rejected
from sfm.io.camera_records import BoardRecord, CameraRecord, Fact, ParameterCovariance

_MANY = 12
"""So many views that are left out are named, on the screen."""
_ABSURD_PX = 1000.0
_SHAPES = {
    "flat": "taken for flat",
    "scale": "stretched along y",
    "paraboloid": "stretched and bent",
    "height": "every corner at its own height",
    "free": "every corner where it lies",
}


def record_of(made: CalibratedCamera, seen: Sightings, *, command: str) -> CameraRecord:
    """What goes into the camera file."""
    found, facts = made.found, dict[str, Fact]()
    facts |= {"command": command, "date": _now(), "version": __version__, "lens": found.lens, "kind": seen.kind}
    facts |= {"photos": seen.count, "photos_digest": seen.digest, "views": len(found.observations)}
    facts |= {"corners": len(found.residuals), "rms_px": found.rms_px, "converged": found.converged}
    for key, value in (
        ("sigma_px", found.sigma_px),
        ("holdout_rms_px", _held_out(made)),
        ("holdout_flat_px", made.flat_px),
        ("split_half_px", _half(made)),
        ("uncertainty_px", (_reach(made) or {}).get("rms_px")),
    ):
        if value is not None and math.isfinite(value):
            facts[key] = value
    if made.would_bring:
        facts["would_bring"] = "; ".join(made.would_bring)
    return CameraRecord(
        facts,
        _parameter_covariance(made),
        BoardRecord(_spec(seen), found.shape.kind, np.array(found.shape.displacements)),
        tuple((finding.cause, finding.detail, finding.remedy) for finding in made.findings),
    )


def camera_json(made: CalibratedCamera, seen: Sightings, suggested: Sequence[SuggestedView]) -> dict[str, Any]:
    """Everything, as plain values; what is not known is null."""
    found = made.found
    camera = found.camera
    return {
        "model": camera.model,
        "lens": found.lens,
        "width": camera.width,
        "height": camera.height,
        "pixel_center": 0.5,
        "param_names": list(camera.model_info.param_names),
        "params": camera.params.tolist(),
        "sigma": _sigmas(made.covariances, camera.model_info.param_names),
        "sigma_by_view": _sigmas(made.by_view, camera.model_info.param_names),
        "rms_px": found.rms_px,
        "sigma_px": _finite(found.sigma_px),
        "holdout_rms_px": _finite(_held_out(made)),
        "split_half_px": _finite(_half(made)),
        "not_judged": _not_judged(made),
        "uncertainty": _reach(made),
        "converged": found.converged,
        "iterations": found.iterations,
        "fallbacks": list(found.fallbacks),
        "start": found.rung,
        "board": {"spec": _spec(seen), "shape": found.shape.kind} | _board(found),
        "lenses": [_row(row, row.lens) for row in made.lenses],
        "shapes": [_row(row, row.kind) for row in made.shapes],
        "would_bring": list(made.would_bring),
        "yardstick": yardstick_json(made.yardstick),
        seen.kind: {"count": seen.count, "digest": seen.digest},
        "views": _views(found),
        "turned_views": list(found.turned_views),
        "rejected": [dataclasses.asdict(view) for view in made.left_out],
        "findings": [dataclasses.asdict(finding) for finding in made.findings],
        "suggestions": suggestions_json(suggested),
    }


def camera_lines(made: CalibratedCamera, seen: Sightings, suggested: Sequence[SuggestedView]) -> Iterator[str]:
    """Everything for the screen: parameters, errors, board, choices, what was left out, what is wrong."""
    found = made.found
    camera, corners = found.camera, len(found.residuals)
    kind = "photos" if seen.kind == "photos" else "views"
    yield f"{len(found.observations)} of {seen.count} {kind} used, {corners} corners of {_spec(seen)}"
    yield f"{camera.model}, {camera.width} × {camera.height} px; lens model {found.lens}{_chosen(bool(made.lenses))}"
    if not camera.model_info.is_in_colmap:
        yield "COLMAP lacks this model, so `sfm run` cannot use it; `calib convert --fit` makes one that it has"
    yield from ("", *_parameter_lines(made), "", *_error_lines(made), "", *_board_lines(made))
    if made.lenses:
        bent = " and with a board that may be bent" if made.shapes else ""
        yield from ("", f"lens models, compared at the corners that the best fitting one keeps{bent}")
        yield "  lens model    held-out  training  differs by px"
        yield from (_lens_line(row) for row in made.lenses)
        yield from (f"  {sentence}" for sentence in would_bring(made.lenses))
    yield from yardstick_lines(made.yardstick)
    if made.left_out or found.rejected_corners:
        yield from ("", "left out", *_left_out_lines(made))
    if made.findings:
        yield from ("", "what is wrong")
        for finding in made.findings:
            yield from (f"  {finding.cause}: {finding.detail}", f"    → {finding.remedy}")
    yield from suggestion_lines(suggested)


def _parameter_lines(made: CalibratedCamera) -> Iterator[str]:
    names, params = made.found.camera.model_info.param_names, made.found.camera.params
    sigmas, by_view = (_sigmas(part, names) for part in (made.covariances, made.by_view))
    yield "parameter         value          ± σ  ± σ by views"
    for name, value in zip(names, params, strict=True):
        told = [f"{v:12.3g}" if (v := part.get(name)) is not None else f"{'held':>12}" for part in (sigmas, by_view)]
        if name not in made.found.free_names:
            yield f"{name:<10}{value:>14.8g}         held"
        else:
            yield f"{name:<10}{value:>14.8g} {told[0] if sigmas else '?':>12} {told[1] if by_view else '?':>12}"
    if isinstance(made.covariances, Rejected):
        yield f"no standard deviations: {made.covariances.detail}"


def _error_lines(made: CalibratedCamera) -> Iterator[str]:
    reach, why = _reach(made), _not_judged(made)
    yield "error             px"
    yield f"training    {made.found.rms_px:8.4f}  of the photos used"
    held, half = _held_out(made), _half(made)
    if held is not None:
        yield f"held-out    {_px(held)}  of photos that the camera was calibrated without"
    if half is not None:
        yield f"split-half  {_px(half)}  between the cameras of two halves of the photos, over the image (median)"
    if reach is not None:
        by = "by views" if reach["by"] == "views" else "at least: all corners taken for independent"
        yield (
            f"uncertainty {_px(reach['rms_px'])}  of a pixel far away, one standard deviation {by}; "
            f"worst {reach['worst_px']:.2g} near ({reach['worst_at'][0]:.0f}, {reach['worst_at'][1]:.0f})"
        )
    if reach is not None and reach["by"] == "views":
        yield f"  at least  {_px(reach['bound_px'])}  if all corners were independent, which they are not"
    yield from (f"not known: {what}, {reason}" for what, reason in why.items())


def _board_lines(made: CalibratedCamera) -> Iterator[str]:
    found, board = made.found, _board(made.found)
    yield f"board, {_SHAPES[found.shape.kind]}{_chosen(bool(made.shapes))}"
    if found.shape.kind != "flat":
        yield (
            f"  corners lie {1000 * board['displacement_rms_m']:.3g} mm (rms) from their design, "
            f"{1000 * board['bend_m']:.3g} mm from the lowest to the highest"
        )
    if found.turned_views:
        yield f"  read from the other end, as the others: {', '.join(found.turned_views)}"
    for row in made.shapes:
        why = f"  not taken{'' if row.would_bring else f': {row.refused}'}" if row.refused else ""
        yield f"  {row.kind:<12}held-out {_px(row.held_out_rms_px)} px{why}"
    yield from (f"  {sentence}" for sentence in would_bring(made.shapes))


def _left_out_lines(made: CalibratedCamera) -> Iterator[str]:
    for view in made.left_out[:_MANY]:
        yield f"  {view.name}: {view.reason}{f' ({view.detail})' if view.detail else ''}"
    if len(made.left_out) > _MANY:
        counted = Counter(view.reason for view in made.left_out[_MANY:])
        yield f"  and {sum(counted.values())} more: {', '.join(f'{n} {reason}' for reason, n in counted.items())}"
    corners = Counter(name for name, _ in made.found.rejected_corners)
    if corners:
        told = ", ".join(f"{count} of {name}" for name, count in corners.most_common(5))
        yield f"  {sum(corners.values())} single corners{_mostly(len(corners))}: {told}"


def _mostly(photos: int) -> str:
    return f" in {photos} photos, most of them" if photos > 5 else ""


def _lens_line(row: RankedLens) -> str:
    if row.refused:
        return f"  {row.lens:<14}{row.refused}"
    differs = f"{row.differs_px:>8.3f}" if row.differs_px < _ABSURD_PX else f"{'> 1000':>8}"
    return (
        f"  {row.lens:<14}{_px(row.held_out_rms_px)}  {_px(row.rms_px)}  {differs}"
        f"{'' if row.converged else '  not converged'}"
    )


def _chosen(is_chosen: bool) -> str:
    return ", chosen by held-out photos" if is_chosen else ""


def _px(value: float) -> str:
    return f"{value:8.4f}" if math.isfinite(value) else f"{'–':>8}"


def _parameter_covariance(made: CalibratedCamera) -> ParameterCovariance | None:
    if isinstance(made.covariances, Rejected):
        return None
    free = made.found.free_names
    by_view = _sigmas(made.by_view, free)
    return ParameterCovariance(
        free,
        np.array(made.covariances.shared[: len(free), : len(free)]),
        np.array([by_view.get(name, math.nan) for name in free], np.float64),
    )


def _sigmas(covariances: CalibrationCovariance | Rejected, names: Iterable[str]) -> dict[str, float | None]:
    """Of each parameter of the camera, None for those that were held; empty where nothing is known."""
    if isinstance(covariances, Rejected):
        return {}
    return {name: covariances.deviations.get(name) for name in names}


def _reach(made: CalibratedCamera) -> dict[str, Any] | None:
    """Uncertainty of pixels over the image: by views where they are enough, and its lower bound."""
    if isinstance(made.covariances, Rejected) or isinstance(made.doubts, Rejected):
        return None
    deviations, pixels = uncertainty_map(made.found, made.doubts, across=24)
    if not np.isfinite(deviations).any():
        return None
    worst = int(np.nanargmax(deviations))
    return {
        "rms_px": math.sqrt(float(np.nanmean(deviations**2))),
        "worst_px": float(deviations.ravel()[worst]),
        "worst_at": pixels[worst].tolist(),
        "distance": "infinite",
        "by": "corners" if isinstance(made.by_view, Rejected) else "views",
        "bound_px": rms_uncertainty(made.found, made.covariances),
    }


def _board(found: Calibration) -> dict[str, float]:
    moved = found.shape.displacements
    rms = math.sqrt(float(np.mean(np.sum(moved**2, axis=1))))
    return {"displacement_rms_m": rms, "bend_m": found.shape.bend}


def _views(found: Calibration) -> list[dict[str, Any]]:
    lost = dict[str, list[int]]()
    for name, corner in found.rejected_corners:
        lost.setdefault(name, []).append(corner)
    counts, rms = np.diff(found.observations.offsets), found.view_rms_px
    return [
        {"name": name, "corners": int(counts[v]), "rms_px": float(rms[v]), "rejected_corners": lost.get(name, [])}
        for v, name in enumerate(found.observations.names)
    ]


def _row(row: RankedLens | RankedShape, name: str) -> dict[str, Any]:
    held, error = _finite(row.held_out_rms_px), _finite(row.rms_px)
    values: dict[str, Any] = {"name": name, "holdout_rms_px": held, "rms_px": error}
    if isinstance(row, RankedLens):
        values |= {"differs_px": _finite(row.differs_px), "converged": row.converged}
    else:
        values |= {"camera_bound_px": _finite(row.camera_bound_px)}
    return values | ({"refused": row.refused} if row.refused else {})


def _not_judged(made: CalibratedCamera) -> dict[str, str]:
    """What could not be told, and why."""
    parts: dict[str, object] = {
        "sigma": made.covariances, "sigma by views": made.by_view, "held-out error": made.held_out,
        "split-half difference": made.halves,
    }  # fmt: skip
    return {
        name: f"{part.reason}: {part.detail}".strip(": ") for name, part in parts.items() if isinstance(part, Rejected)
    }


def _held_out(made: CalibratedCamera) -> float | None:
    return made.held_out.rms_px if isinstance(made.held_out, HeldOut) else None


def _half(made: CalibratedCamera) -> float | None:
    return made.halves.rms_px if isinstance(made.halves, SplitHalf) else None


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _spec(seen: Sightings) -> str:
    return seen.board.spec if seen.board is not None else f"a board of {len(seen.points3D)} points"


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
