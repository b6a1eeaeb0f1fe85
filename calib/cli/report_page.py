"""The report of a calibration: one HTML page that asks nothing of the network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape

import numpy as np

from calib import __version__
from calib import report_figures as figures
from calib.cli.calibrating import CalibratedCamera
from calib.cli.report_html import (
    LONGER,
    finding_box,
    html_page,
    in_px,
    photo_with_residuals,
    sentence,
    side_by_side,
    table,
)
from calib.cli.yardstick_text import yardstick_words
from calib.diagnose import Finding
from calib.refine import Calibration
from calib.uncertainty import rms_uncertainty
from calib.yardstick import Yardstick
from calib.yardstick_figure import lens_difference_figure
from sfm.core.arrays import ImageU8
from sfm.core.errors import Rejected

_WORST_VIEWS = 3


def report_page(
    name: str, result: CalibratedCamera, *, photos: Mapping[str, ImageU8] | None = None, distance: float | None = None
) -> str:
    """The page.

    Args:
        name: what the camera is called.
        photos: of the views that `worst_views` names, grey or RGB.
        distance: a range, in metres, at which uncertainty is drawn beside that of what is infinitely far; by default
            the median one of the boards.
    """
    found = result.found
    parts = [
        f"<h1>{escape(name)}</h1>",
        f'<p class="quiet">{escape(_in_short(found))}</p>',
        *_findings(result.findings),
        "<h2>How good it is</h2>", _quality(result), *_would_bring(result),
        "<h2>Parameters</h2>", _parameters(result),
        *_ranked(result),
        "<h2>Where the photos showed the board</h2>",
        side_by_side([figures.coverage_figure(found), figures.tilts_figure(found)]),
        "<h2>How certain a pixel is</h2>", _uncertainty(result, distance),
        "<h2>What the model does not explain</h2>",
        side_by_side([figures.residual_field_figure(found), figures.residual_scatter_figure(found)]),
        side_by_side([figures.views_figure(found), figures.board_figure(found.shape)]),
        *_yardstick(result),
        *_worst(found, photos or {}),
        *_left_out(result),
        f'<p class="quiet">Parallax calib {__version__}. Pixels: the centre of the first is at (½, ½).</p>',
    ]  # fmt: skip
    return html_page(name, parts)


def worst_views(found: Calibration) -> list[str]:
    """Names of the views with the largest errors, whose photos the page shows."""
    order = np.argsort(-found.view_rms_px, kind="stable")[:_WORST_VIEWS]
    return [found.observations.names[v] for v in order]


def _in_short(found: Calibration) -> str:
    camera = found.camera
    return (
        f"{camera.model}, {camera.width} × {camera.height} px, from {len(found.residuals)} corners of "
        f"{len(found.observations)} photos"
    )


def _findings(findings: Sequence[Finding]) -> Iterator[str]:
    if not findings:
        yield '<div class="finding good">Nothing was found that speaks against this calibration.</div>'
    for finding in findings:
        yield finding_box(f"{finding.cause.replace('_', ' ')}: {finding.detail}", finding.remedy)


def _quality(result: CalibratedCamera) -> str:
    found, held, halves = result.found, result.held_out, result.halves
    rows = [
        ("error on the photos it was made from (RMS)", f"{found.rms_px:.4f} px"),
        ("noise of one coordinate of a corner (σ)", f"{found.sigma_px:.4f} px"),
    ]
    for words, given in (
        ("error on photos that were held out", held),
        ("difference between the cameras of two halves of the photos (median of several halvings)", halves),
    ):
        known = f"not known: {given.detail or given.reason}" if isinstance(given, Rejected) else in_px(given.rms_px)
        rows.append((words, known))
    for words, covariances in (
        ("uncertainty of a pixel far away, over the image, by photos (σ)", result.by_view),
        ("the same, were all corners independent: a lower bound", result.covariances),
    ):
        refused = isinstance(covariances, Rejected)
        rows.append((words, "not known" if refused else in_px(rms_uncertainty(found, covariances))))
    rows.append(("converged", "yes" if found.converged else "no"))
    return table([], [[label, value] for label, value in rows])


def _would_bring(result: CalibratedCamera) -> list[str]:
    return [f"<p>{escape(sentence[:1].upper() + sentence[1:])}.</p>" for sentence in result.would_bring]


def _parameters(result: CalibratedCamera) -> str:
    found = result.found
    plain, by_view = (
        {} if isinstance(given, Rejected) else given.deviations for given in (result.covariances, result.by_view)
    )
    rows = []
    for name, value in zip(found.camera.model_info.param_names, found.camera.params.tolist(), strict=True):
        sigmas = [f"± {given[name]:.3g}" if name in given else "held" for given in (plain, by_view)]
        rows.append([name, f"{value:.6g}", *sigmas])
    note = (
        '<p class="quiet">The first σ takes all corners for independent and is a lower bound; the second takes only '
        "photos for independent.</p>"
    )
    return table(["", "value", "σ of corners", "σ of photos"], rows) + note


def _ranked(result: CalibratedCamera) -> Iterator[str]:
    if result.lenses:
        yield "<h2>Lens models, by their error on photos that were held out</h2>"
        yield table(["", "training", "held out", "differs over the image by"], [
            [lens.lens, *([in_px(lens.rms_px), in_px(lens.held_out_rms_px), in_px(lens.differs_px)] if not lens.refused
             else ["", "", f"refused: {lens.refused}"])] for lens in result.lenses
        ])  # fmt: skip
    if result.shapes:
        yield "<h2>Shapes of the board, likewise</h2>"
        yield table(["", "training", "held out", "uncertainty of the camera, at least", ""], [
            [shape.kind, in_px(shape.rms_px), in_px(shape.held.rms_px if shape.held else np.nan),
             in_px(shape.camera_bound_px), shape.refused] for shape in result.shapes
        ])  # fmt: skip


def _uncertainty(result: CalibratedCamera, distance: float | None) -> str:
    given = result.doubts
    if isinstance(given, Rejected):
        return f"<p>Not known: {escape(given.detail or given.reason)}.</p>"
    found = result.found
    near = float(np.median(found.cams_from_board.translation[:, 2])) if distance is None else distance
    return side_by_side([
        figures.uncertainty_figure(found, given),
        figures.uncertainty_figure(found, given, near, f"{near:.3g} m away"),
    ])  # fmt: skip


def _yardstick(result: CalibratedCamera) -> Iterator[str]:
    measured = result.yardstick
    if isinstance(measured, Yardstick):
        yield f"<h2>Whether that is the lens or the board</h2><p>Judged by {escape(yardstick_words(measured))}.</p>"
        rows = [["lens", sentence(measured.of_lens)], ["board", sentence(measured.of_board)]]
        yield table([], [row for row in rows if row[1] != "."], words=True)
        yield side_by_side([lens_difference_figure(result.found.camera, measured)])


def _worst(found: Calibration, photos: Mapping[str, ImageU8]) -> Iterator[str]:
    names = [name for name in worst_views(found) if name in photos]
    if names:
        yield f"<h2>The worst photos</h2><p class='quiet'>Residuals are drawn {LONGER:.0f} times as long.</p>"
        drawn = [photo_with_residuals(found, name, photos[name]) for name in names]
        yield side_by_side([
            f'<figure><img alt="" src="data:image/jpeg;base64,{picture}">'
            f"<figcaption>{escape(name)}</figcaption></figure>"
            for name, picture in zip(names, drawn, strict=True)
        ])  # fmt: skip


def _left_out(result: CalibratedCamera) -> Iterator[str]:
    if result.left_out:
        yield "<h2>Photos that were left out</h2>"
        rows = [[view.name, view.reason.replace("_", " "), view.detail] for view in result.left_out]
        yield table(["", "reason", ""], rows, words=True)
    if corners := len(result.found.rejected_corners):
        yield f"<p>{corners} single corners were left out as well.</p>"
