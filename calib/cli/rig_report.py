"""What the commands for rigs say: a rig file, a table that a person reads, the same as JSON."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from calib import __version__
from calib.boards import Board
from calib.cli.sightings import Sightings
from calib.diagnose import Finding
from calib.rig_epipolar import EpipolarErrors, epipolar_errors
from calib.rig_frames import FrameTable
from calib.rig_result import RigCalibration
from calib.rig_shapes import RankedRig
from calib.rig_uncertainty import RelativeUncertainty, RigCovariance, relative_uncertainty, rig_covariance
from sfm.core.errors import Rejected
from sfm.core.scene import CameraRig
from sfm.io.rig_files import MountedSigmas, RigFile

_SHOWN = 12
WOULD_BRING = "would_bring"
GIVEN = "given"
"""In place of a lens, in the file of a rig: the camera was known before."""


def rig_record(
    ranked: Sequence[RankedRig], seen: Mapping[str, Sightings], table: FrameTable, board: Board, command: str
) -> RigFile:
    """What goes to the disk: the rig, and what it takes to make it again from its photos."""
    found, held = _found(ranked[0]), ranked[0].held
    covariances = rig_covariance(found)
    facts: dict[str, str | int | float | bool] = {
        "command": command,
        "version": __version__,
        "board": board.spec,
        "shape": found.shape.kind,
        "frames": len(found.observations.frames),
        "sigma_px": found.sigma_px,
        "converged": found.converged,
        **({"holdout_rms_px": held.rms_px} if held else {}),
        **({WOULD_BRING: told[0]} if (told := would_bring(ranked)) else {}),
        "paired_by": table.by,
        **_intrinsics(found),
        **{f"photos_{name}": f"{one.count}, digest {one.digest}" for name, one in seen.items()},
    }
    rig = CameraRig(found.names, found.cameras, found.cams_from_rig, found.names[0])
    sigmas = () if isinstance(covariances, Rejected) else tuple(_sigmas(found, covariances))
    return RigFile(rig, found.rms_px, sigmas, facts)


def _intrinsics(found: RigCalibration) -> dict[str, str | bool]:
    """By which lenses cameras were calibrated, and what was held."""
    alone = [one.calibration for one in found.alone]
    refined = [bool(names) for names in found.free_names]
    return {
        "held": any(one and not free for one, free in zip(alone, refined, strict=True)),
        "given_refined": any(one is None and free for one, free in zip(alone, refined, strict=True)),
        **{f"lens_{name}": one.lens if one else GIVEN for name, one in zip(found.names, alone, strict=True)},
    }


def _sigmas(found: RigCalibration, covariances: RigCovariance) -> Iterator[MountedSigmas]:
    for c, camera in enumerate(found.cameras):
        known = covariances.sigma_params[c]
        params = np.array([known.get(name, 0.0) for name in camera.model_info.param_names])
        relative = relative_uncertainty(found, covariances, 0, c)
        yield MountedSigmas(params, relative.sigma_rotation, relative.sigma_translation)


def _found(ranked: RankedRig) -> RigCalibration:
    assert ranked.found is not None
    return ranked.found


# --- as JSON ------------------------------------------------------------------------------------------------------


def rig_json(
    ranked: Sequence[RankedRig], seen: Mapping[str, Sightings], table: FrameTable, finding: Finding | None = None
) -> dict[str, Any]:  # fmt: skip
    """Everything that is known of a rig."""
    chosen, found = ranked[0], _found(ranked[0])
    covariances = [rig_covariance(found, by_frame=by_frame) for by_frame in (False, True)]
    return {
        "rms_px": found.rms_px,
        "sigma_px": found.sigma_px,
        "holdout_rms_px": chosen.held.rms_px if chosen.held else None,
        "training_rms_px": chosen.held.training_rms_px if chosen.held else None,
        "converged": found.converged,
        "iterations": found.iterations,
        "reference": found.names[0],
        "unit": "m",
        "pixel_center": 0.5,
        "shape": {"kind": found.shape.kind, "bend_m": found.shape.bend, "judged": [_shape_json(row) for row in ranked]},
        "frames": {
            "paired_by": table.by,
            "used": list(found.observations.frames),
            "without_partner": {name: list(table.without_partner(name)) for name in table.frames},
        },
        "cameras": [_camera_json(found, c, covariances, seen[name]) for c, name in enumerate(found.names)],
        "pairs": [_pair_json(found, i, j, covariances) for i, j in itertools.combinations(range(len(found.names)), 2)],
        "fallbacks": list(found.fallbacks),
        "findings": [] if finding is None else [dataclasses.asdict(finding)],
    }


def _shape_json(row: RankedRig) -> dict[str, Any]:
    held = row.held_out_rms_px
    return {
        "kind": row.kind,
        "holdout_rms_px": held if math.isfinite(held) else None,
        "refused": row.refused,
        "would_bring": row.would_bring,
    }


def _camera_json(
    found: RigCalibration, c: int, covariances: Sequence[RigCovariance | Rejected], seen: Sightings
) -> dict[str, Any]:
    camera, pose = found.cameras[c], found.cams_from_rig[c]
    named = [{} if isinstance(one, Rejected) else one.sigma_params[c] for one in covariances]
    return {
        "name": found.names[c],
        "model": camera.model,
        "width": camera.width,
        "height": camera.height,
        "params": dict(zip(camera.model_info.param_names, camera.params.tolist(), strict=True)),
        "sigma": named[0],
        "sigma_by_frame": named[1],
        "rms_px": found.camera_rms_px[c],
        "rotation": pose.rotation.wxyz.tolist(),
        "translation": pose.translation.tolist(),
        "views": list(found.observations.cameras[c].names),
        "rejected": {
            view.name: f"{view.reason} {view.detail}".strip() for view in (*seen.left_out, *found.rejected_views[c])
        },
        "rejected_corners": len(found.rejected_corners[c]),
        "read_from_the_other_side": list(found.turned[c]),
    }


def _pair_json(
    found: RigCalibration, i: int, j: int, covariances: Sequence[RigCovariance | Rejected]
) -> dict[str, Any]:  # fmt: skip
    known = [None if isinstance(one, Rejected) else relative_uncertainty(found, one, i, j) for one in covariances]
    motion = found.cams_from_rig[j] @ found.cams_from_rig[i].inverse()
    errors = epipolar_errors(found, i, j)
    return {
        "cameras": [found.names[i], found.names[j]],
        "baseline_m": float(np.linalg.norm(motion.translation)),
        "sigma_baseline_m": known[0].sigma_baseline if known[0] else None,
        "sigma_baseline_by_frame_m": known[1].sigma_baseline if known[1] else None,
        "rotation_deg": np.degrees(motion.rotation.log()).tolist(),
        "sigma_rotation_deg": np.degrees(known[0].sigma_rotation).tolist() if known[0] else None,
        "translation_m": motion.translation.tolist(),
        "sigma_translation_m": known[0].sigma_translation.tolist() if known[0] else None,
        "frames": errors.frames if errors else 0,
        "epipolar_rms_px": errors.rms_px if errors else None,
        "epipolar_worst_px": errors.worst_px if errors else None,
        "vertical_rms_px": errors.vertical_px if errors and math.isfinite(errors.vertical_px) else None,
    }


# --- for a person -------------------------------------------------------------------------------------------------


def rig_lines(
    ranked: Sequence[RankedRig], seen: Mapping[str, Sightings], table: FrameTable, finding: Finding | None = None
) -> Iterator[str]:
    """The report on the screen, with what else was found to be wrong."""
    chosen, found = ranked[0], _found(ranked[0])
    covariances, by_frame = rig_covariance(found), rig_covariance(found, by_frame=True)
    yield from _frame_lines(found, table)
    yield ""
    yield from _camera_lines(found, covariances)
    yield ""
    yield from _pair_lines(found, covariances, by_frame)
    yield ""
    held = f", of frames held out {chosen.held.rms_px:.4f}" if chosen.held else ""
    yield f"rms {found.rms_px:.4f} px{held}; board {found.shape.kind}{_bend(found)}; {_converged(found)}"
    yield from _shape_lines(ranked)
    yield from _left_out_lines(found, seen)
    if finding is not None:
        yield f"note: {finding.detail}; {finding.remedy}"
    yield from (f"note: {words}" for words in (*found.fallbacks, *rig_remarks(found)))


def _frame_lines(found: RigCalibration, table: FrameTable) -> Iterator[str]:
    views = found.observations.views_per_frame
    shared = int(np.count_nonzero(views > 1))
    yield f"{len(views)} frames, {shared} of them seen by two cameras or more; photos paired by {table.by}"
    for name in found.names:
        if lonely := table.without_partner(name):
            yield f"  {name}: {len(lonely)} photos without a partner: {_some(lonely)}"


def _camera_lines(found: RigCalibration, covariances: RigCovariance | Rejected) -> Iterator[str]:
    width = max(6, *map(len, found.names))
    yield f"{'camera':<{width}}  views  corners  rms px  model and parameters"
    for c, (name, camera) in enumerate(zip(found.names, found.cameras, strict=True)):
        o = found.observations.cameras[c]
        sigma = {} if isinstance(covariances, Rejected) else covariances.sigma_params[c]
        lens = found.alone[c].calibration
        model = f"{camera.model} ({lens.lens})" if lens else f"{camera.model} (given)"
        yield f"{name:<{width}}  {len(o):>5}  {len(o.rows):>7}  {found.camera_rms_px[c]:6.4f}  {model}"
        values = [
            f"{key} {value:.6g}" + (f" ± {sigma[key]:.2g}" if key in sigma else "")
            for key, value in zip(camera.model_info.param_names, camera.params.tolist(), strict=True)
            if value or key in sigma
        ]
        for first in range(0, len(values), 4):
            yield f"{'':<{width}}  " + "   ".join(values[first : first + 4])


def _pair_lines(
    found: RigCalibration, covariances: RigCovariance | Rejected, by_frame: RigCovariance | Rejected
) -> Iterator[str]:
    pairs = list(itertools.combinations(range(len(found.names)), 2))
    labels = [f"{found.names[i]} → {found.names[j]}" for i, j in pairs]
    width = max(map(len, labels))
    yield (f"{'':<{width}}  {'baseline mm':>20}  {'(by frames)':>11}  {'rotation °':>17}  frames  epipolar px  rows px")
    for (i, j), label in zip(pairs, labels, strict=True):
        known = _relative(found, covariances, i, j)
        careful = _relative(found, by_frame, i, j)
        motion = found.cams_from_rig[j] @ found.cams_from_rig[i].inverse()
        baseline = f"{1e3 * float(np.linalg.norm(motion.translation)):.3f}"
        turn = f"{np.degrees(motion.rotation.angle):.3f}"
        if known:
            baseline += f" ± {1e3 * known.sigma_baseline:.3f}"
            turn += f" ± {np.degrees(known.sigma_rotation.max()):.3f}"
        clustered = f"± {1e3 * careful.sigma_baseline:.3f}" if careful else "–"
        yield f"{label:<{width}}  {baseline:>20}  {clustered:>11}  {turn:>17}  {_errors(epipolar_errors(found, i, j))}"


def _relative(
    found: RigCalibration, covariances: RigCovariance | Rejected, i: int, j: int
) -> RelativeUncertainty | None:
    return None if isinstance(covariances, Rejected) else relative_uncertainty(found, covariances, i, j)


def _errors(errors: EpipolarErrors | None) -> str:
    if errors is None:
        return f"{0:>6}  {'–':>11}  {'–':>7}"
    rows = f"{errors.vertical_px:7.4f}" if math.isfinite(errors.vertical_px) else f"{'–':>7}"
    return f"{errors.frames:>6}  {errors.rms_px:11.4f}  {rows}"


def _bend(found: RigCalibration) -> str:
    return f", bent by {1e3 * found.shape.bend:.2f} mm" if len(found.shape.coefficients) else ""


def _converged(found: RigCalibration) -> str:
    return f"converged in {found.iterations} steps" if found.converged else "NOT CONVERGED"


def _shape_lines(ranked: Sequence[RankedRig]) -> Iterator[str]:
    if len(ranked) > 1:
        told = ", ".join(
            f"{row.kind} {row.held_out_rms_px:.4f} px" if row.held else f"{row.kind}: {row.refused}" for row in ranked
        )
        yield f"shapes of the board by held-out frames: {told}"
        yield from (f"  {sentence}" for sentence in would_bring(ranked))


def would_bring(ranked: Sequence[RankedRig]) -> list[str]:
    """What the best of those shapes would bring that predict better than the one taken; at most one sentence."""
    able = [row for row in ranked if row.would_bring]
    return [min(able, key=lambda row: row.held_out_rms_px).would_bring] if able else []


def _left_out_lines(found: RigCalibration, seen: Mapping[str, Sightings]) -> Iterator[str]:
    for c, name in enumerate(found.names):
        views = (*seen[name].left_out, *found.rejected_views[c])
        for view in views[:_SHOWN]:
            yield f"left out: {name} {view.name}: {f'{view.reason} {view.detail}'.strip()}"
        if len(views) > _SHOWN:
            yield f"left out: {name}: {len(views) - _SHOWN} more photos"
        if corners := found.rejected_corners[c]:
            most = Counter(view for view, _ in corners).most_common(3)
            told = ", ".join(f"{count} of {view}" for view, count in most)
            yield f"left out: {name}: {len(corners)} corners ({told}{', …' if len(most) == 3 else ''})"
        if found.turned[c]:
            frames = f"frame{'s' * (len(found.turned[c]) > 1)} {_some(found.turned[c])}"
            yield f"{name}: read the board from its other end in {frames}, which was undone"


def rig_remarks(found: RigCalibration) -> Iterator[str]:
    """What may be a mistake of the hand."""
    if found.names[:2] == ("left", "right") and len(found.names) == 2:
        motion = found.cams_from_rig[1]
        if motion.center[0] < 0:
            yield "the right camera stands to the left of the left one; were the folders swapped?"


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (", …" if len(names) > 4 else "")
