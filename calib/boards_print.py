"""A board as a page to print: PDF or SVG, vectors at true scale.

Beside the board are its description, the name of its `board.toml` in one word, and a ruler by which a print is
checked: printers scale pages unless they are told not to. The same word stands in the file's metadata.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import zlib
from collections.abc import Iterable
from typing import TypeAlias
from xml.sax.saxutils import escape

import numpy as np

from calib.boards import Board
from calib.boards_artwork import Artwork, artwork

PAPERS_M = {
    "a4": (0.210, 0.297),
    "letter": (0.2159, 0.2794),
    "a3": (0.297, 0.420),
    "a2": (0.420, 0.594),
    "a1": (0.594, 0.841),
    "a0": (0.841, 1.189),
}
"""Width and height upright, the smaller first."""
PAGE_MARGIN_M = 0.005
"""Most printers leave this much of the paper blank."""
FOOTER_M = 0.012
"""Height of the strip with ruler and description."""

_LONGEST_RULER_M = 0.2
_POINTS_PER_M = 72 / 0.0254
_TEXT_M = 0.003
_Rectangle: TypeAlias = np.ndarray | tuple[float, float, float, float]

_QUARTER = 4 / 3 * (math.sqrt(2) - 1)
"""Length of the handles of a cubic curve that draws a quarter of a circle; it is off by 0.03 % of the radius."""


@dataclasses.dataclass(frozen=True, slots=True)
class Page:
    """Where a board is printed: size of the paper and the top left corner of the artwork, in metres."""

    width_m: float
    height_m: float
    left_m: float
    top_m: float

    @property
    def ruler_m(self) -> float:
        """Length of the ruler: whole centimetres, as many as fit."""
        return min(_LONGEST_RULER_M, math.floor((self.width_m - 2 * PAGE_MARGIN_M) * 100 + 1e-9) / 100)


def lay_out(board: Board, paper: str = "") -> Page:
    """The page for a board, upright or across.

    Args:
        paper: a name of `PAPERS_M`; without one the smallest that holds the board, or else as large as it must be.
    Raises:
        ValueError: the board does not fit, or the paper is unknown.
    """
    drawn = artwork(board)
    need = (drawn.width_m + 2 * PAGE_MARGIN_M, drawn.height_m + 2 * PAGE_MARGIN_M + FOOTER_M)
    if paper and paper.lower() not in PAPERS_M:
        raise ValueError(f"unknown paper {paper!r}; known are {', '.join(PAPERS_M)}")
    for name in [paper.lower()] if paper else PAPERS_M:
        short, long = PAPERS_M[name]
        for width, height in ((short, long), (long, short)):
            if need[0] <= width + 1e-9 and need[1] <= height + 1e-9:
                return _centred(drawn, width, height)
    if paper:
        raise ValueError(f"the board needs {1000 * need[0]:.0f} x {1000 * need[1]:.0f} mm, more than {paper}")
    return _centred(drawn, *need)


def _centred(drawn: Artwork, width: float, height: float) -> Page:
    return Page(width, height, (width - drawn.width_m) / 2, (height - FOOTER_M - drawn.height_m) / 2)


def board_svg(board: Board, page: Page) -> str:
    """The page as SVG whose user unit is the millimetre."""
    drawn = artwork(board)
    width, height = _mm(page.width_m), _mm(page.height_m)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}">',
        f"<title>{escape(board.spec)}</title>",
        f'<rect width="{width}" height="{height}" fill="white"/>',
        f'<g id="board" shape-rendering="crispEdges" transform="translate({_mm(page.left_m)} {_mm(page.top_m)})">',
        *_svg_rectangles(drawn.black, "black"),
        *_svg_rectangles(drawn.white, "white"),
        *(f'<circle cx="{_mm(x)}" cy="{_mm(y)}" r="{_mm(r)}"/>' for x, y, r in drawn.circles),
        "</g>",
        '<g id="ruler" font-family="Helvetica, Arial, sans-serif" font-size="3">',
        *_svg_rectangles(_ruler(page), "black"),
        *(f'<text x="{_mm(x)}" y="{_mm(y)}">{escape(text)}</text>' for x, y, text in _captions(board, page)),
        "</g>",
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def board_pdf(board: Board, page: Page) -> bytes:
    """The page as PDF 1.6; viewers are asked not to scale it when it is printed."""
    drawn = artwork(board)
    scale = _POINTS_PER_M / 1000  # the content is in millimetres, y down
    size = [page.width_m * _POINTS_PER_M, page.height_m * _POINTS_PER_M]
    content = [f"{scale:.12g} 0 0 {-scale:.12g} 0 {size[1]:.9g} cm"]
    content += ["q", f"1 0 0 1 {_mm(page.left_m)} {_mm(page.top_m)} cm"]
    content += ["0 g", *_pdf_rectangles(drawn.black), "1 g", *_pdf_rectangles(drawn.white), "0 g"]
    content += [_pdf_circle(*circle) for circle in drawn.circles]
    content += ["Q", *_pdf_rectangles(_ruler(page))]
    content += [
        f"BT /F1 {_mm(_TEXT_M)} Tf 1 0 0 -1 {_mm(x)} {_mm(y)} Tm ({_pdf_text(text)}) Tj ET"
        for x, y, text in _captions(board, page)
    ]
    return _pdf_file("\n".join(content).encode("latin-1"), size, board.spec)


def _mm(metres: float) -> str:
    return f"{1000 * metres:.7f}".rstrip("0").rstrip(".")


def _ruler(page: Page) -> list[tuple[float, float, float, float]]:
    """The base line and a tick for each millimetre, 0.15 mm wide and centred on it, longer at 5 and 10 mm."""
    left, top = PAGE_MARGIN_M, page.height_m - PAGE_MARGIN_M - 0.007
    thin = 0.00015
    ticks = [
        (left + k * 1e-3 - thin / 2, top, thin, 0.004 if k % 10 == 0 else 0.003 if k % 5 == 0 else 0.002)
        for k in range(round(page.ruler_m * 1000) + 1)
    ]
    return [(left, top - thin / 2, page.ruler_m, thin), *ticks]


def _captions(board: Board, page: Page) -> list[tuple[float, float, str]]:
    """Base line and words: what the board is, and the figures of the ruler."""
    left, bottom = PAGE_MARGIN_M, page.height_m - PAGE_MARGIN_M
    said = f"{board.spec}   print at 100 %, then measure: this ruler is {1000 * page.ruler_m:.0f} mm long"
    figures = [(left + k * 0.01, bottom, str(10 * k)) for k in range(0, round(page.ruler_m * 100) + 1, 2)]
    return [(left, bottom - 0.0085, said), *figures[:-1], (figures[-1][0] - 0.002, *figures[-1][1:])]


def _svg_rectangles(rectangles: Iterable[_Rectangle], colour: str) -> list[str]:
    return [
        f'<rect x="{_mm(x)}" y="{_mm(y)}" width="{_mm(w)}" height="{_mm(h)}" fill="{colour}"/>'
        for x, y, w, h in rectangles
    ]


def _pdf_rectangles(rectangles: Iterable[_Rectangle]) -> list[str]:
    return [f"{_mm(x)} {_mm(y)} {_mm(w)} {_mm(h)} re f" for x, y, w, h in rectangles]


def _pdf_circle(x: float, y: float, radius: float) -> str:
    """Four cubic curves, from the right by way of the bottom."""
    handle = _QUARTER * radius
    around = [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 0)]
    words = [f"{_mm(x + radius)} {_mm(y)} m"]
    for (ax, ay), (bx, by) in itertools.pairwise(around):
        first = (x + radius * ax + handle * bx, y + radius * ay + handle * by)
        second = (x + radius * bx + handle * ax, y + radius * by + handle * ay)
        last = (x + radius * bx, y + radius * by)
        words.append(" ".join(_mm(value) for point in (first, second, last) for value in point) + " c")
    return " ".join([*words, "f"])


def _pdf_text(text: str) -> str:
    return text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")


def _pdf_file(content: bytes, size: list[float], title: str) -> bytes:
    """A document of one page: objects, their table, and where the table is."""
    packed = zlib.compress(content, 9)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {size[0]:.9g} {size[1]:.9g}] /Contents 4 0 R "
        f"/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        f"<< /Length {len(packed)} /Filter /FlateDecode >>\nstream\n".encode() + packed + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        f"<< /Title (Calibration board) /Subject ({_pdf_text(title)}) /Producer (Parallax) >>".encode(),
    ]
    document = bytearray(b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n")
    places = []
    for number, body in enumerate(objects, 1):
        places.append(len(document))
        document += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    start = len(document)
    document += f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n".encode()
    document += b"".join(f"{place:010d} 00000 n \n".encode() for place in places)
    document += f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R /Info 6 0 R >>\nstartxref\n{start}\n%%EOF\n".encode()
    return bytes(document)
