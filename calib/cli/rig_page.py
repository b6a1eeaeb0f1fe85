"""The report of a rig: one HTML page that asks nothing of the network."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from html import escape

import numpy as np

from calib import __version__
from calib import report_rig_figures as figures
from calib.cli.report_html import LONGER, finding_box, html_page, in_px, photo_with_residuals, side_by_side, table
from calib.cli.rig_again import RigAgain
from calib.cli.rig_report import WOULD_BRING, rig_remarks
from calib.diagnose import diagnose
from calib.report_figures import board_figure, coverage_figure, residual_field_figure
from calib.rig_epipolar import epipolar_errors
from calib.rig_result import RigCalibration
from calib.rig_uncertainty import RelativeUncertainty, RigCovariance, relative_uncertainty, rig_covariance
from sfm.core.arrays import FloatArray, ImageU8
from sfm.core.errors import Rejected

_WORST_VIEWS = 3
_PAIRS_DRAWN = 4
_SIDEWAYS = 0.1
"""Part of the rig's size by which cameras stand above one another that is worth a drawing from the side."""


def rig_page(name: str, made: RigAgain, *, photos: Mapping[tuple[str, str], ImageU8] | None = None) -> str:
    """The page.

    Args:
        name: what the rig is called.
        photos: grey or RGB, by camera and name, of the views that `worst_rig_views` names.
    """
    found = made.found
    plain, by_frame = rig_covariance(found), rig_covariance(found, by_frame=True)
    parts = [
        f"<h1>{escape(name)}</h1>",
        f'<p class="quiet">{escape(_in_short(made))}</p>',
        *_findings(made),
        "<h2>How the cameras stand</h2>", _drawings(found), _mounts(found, plain),
        "<h2>From camera to camera</h2>", _pairs(found, plain, by_frame), _lines_of_pairs(found),
        "<h2>How good it is</h2>", _quality(made),
        "<h2>Who saw the board where</h2>",
        side_by_side([figures.frames_figure(found), *(figures.boards_figure(found, side) for side in _sides(found))]),
        *_cameras(found, plain, by_frame),
        "<h2>The board</h2>", side_by_side([board_figure(found.shape)]),
        *_worst(found, photos or {}),
        *_left_out(made),
        f'<p class="quiet">Parallax calib {__version__}. Pixels: the centre of the first is at (½, ½). The frame of '
        f"the rig is that of {escape(found.names[0])}: x to the right, y down, z forward.</p>",
    ]  # fmt: skip
    return html_page(name, parts)


def worst_rig_views(found: RigCalibration) -> list[tuple[str, str]]:
    """Camera and name of the views with the largest errors, whose photos the page shows."""
    views = [
        (float(error), found.names[c], name)
        for c in range(len(found.names))
        for name, error in zip(found.observations.cameras[c].names, found.one_camera(c).view_rms_px, strict=True)
    ]
    return [(camera, name) for _, camera, name in sorted(views, key=lambda view: -view[0])[:_WORST_VIEWS]]


def _in_short(made: RigAgain) -> str:
    o = made.found.observations
    shared = int(np.count_nonzero(o.views_per_frame > 1))
    return (
        f"{len(made.found.names)} cameras, {o.corner_count} corners in {len(o.frames)} frames, {shared} of them seen "
        f"by two cameras or more; photos paired by {made.table.by}; {made.board.spec}"
    )


def _findings(made: RigAgain) -> Iterator[str]:
    found = made.found
    boxes = [finding_box(words) for words in (*found.fallbacks, *rig_remarks(found))]
    if not found.converged:
        boxes.insert(0, finding_box("not converged: poses and cameras are not where the photos want them"))
    for name in found.names:
        if lonely := made.table.without_partner(name):
            told = f"camera {name}: {len(lonely)} photos have no partner: {', '.join(lonely[:4])}"
            boxes.append(finding_box(told + (", …" if len(lonely) > 4 else "")))
    for one in found.alone:
        for finding in diagnose(one.calibration) if one.calibration else ():
            words = f"camera {one.name} alone: {finding.cause.replace('_', ' ')}: {finding.detail}"
            boxes.append(finding_box(words, finding.remedy))
    yield from boxes or ['<div class="finding good">Nothing was found that speaks against this calibration.</div>']


def _sides(found: RigCalibration) -> tuple[figures.Side, ...]:
    centers = found.cams_from_rig.center
    extent = np.ptp(centers, axis=0)
    return ("above", "the right") if extent[1] > _SIDEWAYS * float(np.linalg.norm(extent)) else ("above",)


def _drawings(found: RigCalibration) -> str:
    return side_by_side([figures.rig_figure(found, side) for side in _sides(found)])


def _mounts(found: RigCalibration, covariances: RigCovariance | Rejected) -> str:
    """Places and turns of all cameras in the frame of the first."""
    rows = []
    for c, name in enumerate(found.names):
        cam_from_rig = found.cams_from_rig[c]
        known = None if isinstance(covariances, Rejected) else relative_uncertainty(found, covariances, 0, c)
        place, turn = 1e3 * cam_from_rig.center, np.degrees(cam_from_rig.rotation.inverse().log())
        place_sigma = None if known is None or not c else 1e3 * place_sigmas(known)
        turn_sigma = None if known is None or not c else np.degrees(turn_sigmas(known))
        rows.append([name, *_with_sigma(place, place_sigma), *_with_sigma(turn, turn_sigma)])
    note = (
        '<p class="quiet">Where each camera is in the frame of the first, and how it is turned there, as a vector '
        "along the axis. σ takes all corners for independent and is a lower bound.</p>"
    )
    return table(["", "x mm", "y mm", "z mm", "about x °", "about y °", "about z °"], rows) + note


def place_sigmas(known: RelativeUncertainty) -> FloatArray:
    """(3,) of the camera's centre along the rig's axes: δ = −Rᵀ υ, as the centre does not move with turns about it."""
    R = known.cam2_from_cam1.rotation.matrix
    return np.sqrt(np.maximum(np.diag(R.T @ known.covariance[3:, 3:] @ R), 0.0))


def turn_sigmas(known: RelativeUncertainty) -> FloatArray:
    """(3,) of turns about the rig's axes, radians."""
    R = known.cam2_from_cam1.rotation.matrix
    return np.sqrt(np.maximum(np.diag(R.T @ known.covariance[:3, :3] @ R), 0.0))


def _with_sigma(values: FloatArray, sigmas: FloatArray | None) -> list[str]:
    values = values + 0.0  # no −0
    if sigmas is None:
        return [f"{value:.3f}" for value in values]
    return [f"{value:.3f} ± {sigma:.3f}" for value, sigma in zip(values, sigmas, strict=True)]


def _pairs(found: RigCalibration, plain: RigCovariance | Rejected, by_frame: RigCovariance | Rejected) -> str:
    rows = []
    for i, j in itertools.combinations(range(len(found.names)), 2):
        motion = found.cams_from_rig[j] @ found.cams_from_rig[i].inverse()
        errors = epipolar_errors(found, i, j)
        sigmas = [
            None if isinstance(given, Rejected) else relative_uncertainty(found, given, i, j)
            for given in (plain, by_frame)
        ]
        rows.append([
            f"{found.names[i]} → {found.names[j]}", f"{1e3 * float(np.linalg.norm(motion.translation)):.3f} mm",
            *("" if one is None else f"± {1e3 * one.sigma_baseline:.3f}" for one in sigmas),
            f"{np.degrees(motion.rotation.angle):.3f}°",
            *("" if one is None else f"± {np.degrees(one.sigma_rotation.max()):.3f}" for one in sigmas),
            str(errors.frames if errors else 0), *(_epipolar(errors.rms_px, errors.worst_px, errors.vertical_px)
            if errors else ("", "", "")),
        ])  # fmt: skip
    head = ["", "baseline", "σ of corners", "σ of frames", "turn", "σ of corners", "σ of frames", "frames shared",
            "off the line (RMS)", "worst", "off the row (RMS)"]  # fmt: skip
    note = (
        '<p class="quiet">Off the line: how far corners lie from the epipolar lines of their partners, in both images. '
        "Off the row: the difference of rows after rectification; nothing where cameras look too far apart. The first "
        "σ takes all corners for independent, the second only frames.</p>"
    )
    return table(head, rows) + note


def _epipolar(*errors: float) -> tuple[str, ...]:
    return tuple(in_px(error) for error in errors)


def _lines_of_pairs(found: RigCalibration) -> str:
    """Figures of the pairs that share most frames."""
    pairs = [
        (errors.frames, i, j)
        for i, j in itertools.combinations(range(len(found.names)), 2)
        if (errors := epipolar_errors(found, i, j)) is not None
    ]
    most = sorted(pairs, key=lambda pair: -pair[0])[:_PAIRS_DRAWN]
    return side_by_side([figures.epipolar_figure(found, i, j) for _, i, j in most])


def _quality(made: RigAgain) -> str:
    found, held = made.found, made.ranked.held
    rows = [
        ["error on the frames it was made from (RMS)", f"{found.rms_px:.4f} px"],
        *([["of these, on frames that two cameras saw", f"{held.training_rms_px:.4f} px"],
           ["error on such frames that were held out", f"{held.rms_px:.4f} px"]] if held else
          [["error on frames that were held out", f"not known: {made.ranked.refused or 'too few frames'}"]]),
        ["noise of one coordinate of a corner (σ), each camera by its own", f"{found.sigma_px:.4f} px"],
        ["converged", "yes" if found.converged else "no"],
    ]  # fmt: skip
    sentence = str(made.file.provenance.get(WOULD_BRING, ""))
    return table([], rows) + (f"<p>{escape(sentence[:1].upper() + sentence[1:])}.</p>" if sentence else "")


def _cameras(found: RigCalibration, *covariances: RigCovariance | Rejected) -> Iterator[str]:
    for c, name in enumerate(found.names):
        one, camera = found.one_camera(c), found.cameras[c]
        known = [{} if isinstance(given, Rejected) else given.sigma_params[c] for given in covariances]
        rows = [
            [key, f"{value:.6g}", *(f"± {given[key]:.3g}" if key in given else "held" for given in known)]
            for key, value in zip(camera.model_info.param_names, camera.params.tolist(), strict=True)
        ]
        yield f"<h2>{escape(name)}</h2>"
        yield (
            f'<p class="quiet">{escape(camera.model)}, {camera.width} × {camera.height} px, {len(one.observations)} '
            f"photos, RMS {found.camera_rms_px[c]:.4f} px</p>"
        )
        yield side_by_side([coverage_figure(one), residual_field_figure(one)])
        yield table(["", "value", "σ of corners", "σ of frames"], rows)


def _worst(found: RigCalibration, photos: Mapping[tuple[str, str], ImageU8]) -> Iterator[str]:
    views = [view for view in worst_rig_views(found) if view in photos]
    if views:
        yield f"<h2>The worst photos</h2><p class='quiet'>Residuals are drawn {LONGER:.0f} times as long.</p>"
        yield side_by_side([
            '<figure><img alt="" src="data:image/jpeg;base64,'
            f'{photo_with_residuals(found.one_camera(found.names.index(camera)), name, photos[camera, name])}">'
            f"<figcaption>{escape(camera)}: {escape(name)}</figcaption></figure>"
            for camera, name in views
        ])  # fmt: skip


def _left_out(made: RigAgain) -> Iterator[str]:
    found = made.found
    rows = [
        [f"{name}: {view.name}", view.reason.replace("_", " "), view.detail]
        for c, name in enumerate(found.names)
        for view in (*made.seen[name].left_out, *found.rejected_views[c])
    ]
    if rows:
        yield "<h2>Photos that were left out</h2>"
        yield table(["", "reason", ""], rows, words=True)
    corners = sum(map(len, found.rejected_corners))
    if corners:
        yield f"<p>{corners} single corners were left out as well.</p>"
    for c, name in enumerate(found.names):
        if found.turned[c]:
            frames = _some(found.turned[c])
            yield f"<p>{escape(name)} read the board from its other end in {frames}; that was undone.</p>"


def _some(names: Sequence[str]) -> str:
    return escape(", ".join(names[:6]) + (", …" if len(names) > 6 else ""))
