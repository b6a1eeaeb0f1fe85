"""What pages about calibrations are made of: HTML that asks nothing of the network."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape

import cv2
import numpy as np

from calib.report_figures import CameraResiduals
from sfm.core.arrays import ImageU8

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #24292f; max-width: 1180px; margin: 2em auto; padding: 0 1em }
h1 { font-size: 1.6em; margin-bottom: 0 } h2 { font-size: 1.2em; margin-top: 2em }
table { border-collapse: collapse } td, th { padding: .2em .9em .2em 0; text-align: right; white-space: nowrap }
td:first-child, th:first-child { text-align: left } td.words { text-align: left; white-space: normal }
tr + tr td { border-top: 1px solid #eaeef2 } .figures { display: flex; flex-wrap: wrap; gap: 1.2em; align-items: start }
.finding { border-left: 4px solid #c2410c; padding: .1em .9em; margin: .6em 0; background: #fff7f0 }
.good { border-left-color: #2a8a5b; background: #f2fbf6 } .quiet { color: #57606a } svg, img { max-width: 100% }
"""
_PHOTO_PX = 560
LONGER = 40.0
"""Times that residuals are drawn longer on photos."""


def html_page(name: str, parts: Iterable[str]) -> str:
    """The whole document."""
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{escape(name)}</title>'
        f"<style>{_STYLE}</style><body>{''.join(parts)}</body></html>\n"
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]], *, words: bool = False) -> str:
    """A table of texts; columns are numbers but for the first, or else `words`."""
    cell = '<td class="words">' if words else "<td>"
    lines = ["<tr>" + "".join(f"<th>{escape(name)}</th>" for name in head) + "</tr>"] if head else []
    lines += ["<tr>" + "".join(f"{cell}{escape(value)}</td>" for value in row) + "</tr>" for row in rows]
    return f"<table>{''.join(lines)}</table>"


def side_by_side(parts: Sequence[str]) -> str:
    """Figures in a row, as many as there is room for."""
    return f'<div class="figures">{"".join(parts)}</div>'


def finding_box(words: str, remedy: str = "") -> str:
    """Something that speaks against the result, and what would mend it."""
    mend = f'<br><span class="quiet">{escape(sentence(remedy))}</span>' if remedy else ""
    return f'<div class="finding">{escape(sentence(words))}{mend}</div>'


def sentence(words: str) -> str:
    """With a capital and a full stop."""
    return words[:1].upper() + words[1:] + "."


def in_px(value: float) -> str:
    """A length; nothing where it is not known."""
    return f"{value:.4f} px" if np.isfinite(value) else ""


def photo_with_residuals(found: CameraResiduals, name: str, photo: ImageU8) -> str:
    """A photo with its residuals as base64 of a JPEG."""
    scale = min(_PHOTO_PX / photo.shape[1], 1.0)
    small = cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    picture = cv2.cvtColor(small, cv2.COLOR_GRAY2BGR) if small.ndim == 2 else np.ascontiguousarray(small[:, :, ::-1])
    mine = found.observations.view_of == found.observations.names.index(name)
    for at, residual in zip(found.observations.points2D[mine], found.residuals[mine], strict=True):
        start, end = (at - 0.5) * scale, (at - 0.5 + LONGER * residual) * scale
        first, last = ((round(float(x)), round(float(y))) for x, y in (start, end))
        cv2.line(picture, first, last, (12, 65, 234), 1, cv2.LINE_AA)
        cv2.circle(picture, first, 2, (196, 98, 11), -1, cv2.LINE_AA)
    return base64.b64encode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()).decode()
