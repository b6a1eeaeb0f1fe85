"""Drawing primitives for the figures of a report: SVG as text, in the coordinates of what is drawn."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import TypeAlias
from xml.sax.saxutils import escape

import numpy as np

from sfm.core.arrays import FloatArray

WIDTH = 460.0
"""Of a figure's field, px on the screen."""
_LARGE, _SMALL = 14.0, 11.0
"""Sizes of titles, px."""
_WIDE = 0.6
"""A sign of a wide font over its size, in the mean of words."""
_MARGIN, _TOP, _LEGEND = 46.0, 26.0, 64.0
_STOPS = ((0x1B, 0x1F, 0x5A), (0x1F, 0x6F, 0x9F), (0x2A, 0xA8, 0x8B), (0xA9, 0xD0, 0x4B), (0xFD, 0xE8, 0x4A))
"""From little to much: dark to light, so that it can be told in grey as well."""
Place: TypeAlias = Sequence[float] | FloatArray
INK, PALE, ACCENT, WARNING = "#24292f", "#d0d7de", "#0b62c4", "#c2410c"


@dataclasses.dataclass(frozen=True, slots=True)
class Frame:
    """A rectangle of data [x0, x1] × [y0, y1], y down the screen unless `up`, and how large it is drawn.

    `ratio` is height over width on the screen; None where a unit is as long in y as in x.
    """

    x0: float
    x1: float
    y0: float
    y1: float
    up: bool = False
    ratio: float | None = None

    @property
    def height(self) -> float:
        """On the screen, px."""
        ratio = (self.y1 - self.y0) / (self.x1 - self.x0) if self.ratio is None else self.ratio
        return WIDTH * ratio

    @property
    def scale(self) -> float:
        """Px on the screen for a unit of x."""
        return WIDTH / (self.x1 - self.x0)

    def x(self, value: float) -> float:
        """On the screen."""
        return _MARGIN + (value - self.x0) * self.scale

    def y(self, value: float) -> float:
        """On the screen."""
        part = (value - self.y0) / (self.y1 - self.y0)
        return _TOP + self.height * (1 - part if self.up else part)


def figure(
    frame: Frame, title: str, parts: Iterable[str], *, across: str = "", down: str = "", legend: str = ""
) -> str:
    """The whole SVG: title above, what is drawn within the frame, words below, a legend at the right."""
    width, height = _MARGIN + WIDTH + (_LEGEND if legend else 12), _TOP + frame.height + (38 if across else 12)
    left, bottom = _MARGIN, _TOP + frame.height
    words = [_heading(title)]
    if across:
        words.append(text(left + WIDTH / 2, bottom + 32, across, anchor="middle", color="#57606a"))
    return "".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" '
        'font-family="system-ui, sans-serif" font-size="11" role="img">',
        f"<title>{escape(title)}</title>",
        f'<rect x="{left}" y="{_TOP}" width="{WIDTH}" height="{frame.height:.1f}" fill="#f6f8fa"/>',
        *parts,
        f'<rect x="{left}" y="{_TOP}" width="{WIDTH}" height="{frame.height:.1f}" fill="none" stroke="{INK}"/>',
        *words,
        legend,
        "</svg>",
    ])  # fmt: skip


def text(x: float, y: float, words: str, *, anchor: str = "start", size: int = 11, color: str = INK) -> str:
    """Words at a place of the screen."""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}" fill="{color}">{escape(words)}</text>'
    )


def _heading(title: str) -> str:
    """The title: at least as small as to end before the legend, whatever font the reader has."""
    width = _WIDE * len(title)
    size = min(_LARGE, max(_SMALL, WIDTH / width))
    fitted = f' textLength="{WIDTH:g}" lengthAdjust="spacingAndGlyphs"' if width * size > WIDTH + 0.5 else ""
    return f'<text x="{_MARGIN}" y="16.0" font-size="{size:.3g}" fill="{INK}"{fitted}>{escape(title)}</text>'


def dot(frame: Frame, x: float, y: float, radius: float, color: str, *, title: str = "", opacity: float = 1.0) -> str:
    """A filled circle of a radius on the screen; a title is shown where the pointer rests on it."""
    inner = f"<title>{escape(title)}</title>" if title else ""
    fade = f' fill-opacity="{opacity:g}"' if opacity < 1 else ""
    return f'<circle cx="{frame.x(x):.1f}" cy="{frame.y(y):.1f}" r="{radius:g}" fill="{color}"{fade}>{inner}</circle>'


def ring(frame: Frame, x: float, y: float, radius: float, color: str = PALE) -> str:
    """A circle whose radius is in units of x."""
    r = radius * frame.scale
    return f'<circle cx="{frame.x(x):.1f}" cy="{frame.y(y):.1f}" r="{r:.1f}" fill="none" stroke="{color}"/>'


def line(
    frame: Frame, start: Sequence[float] | FloatArray, end: Sequence[float] | FloatArray, color: str, width: float = 1.0
) -> str:
    """A straight line."""
    return (
        f'<line x1="{frame.x(start[0]):.1f}" y1="{frame.y(start[1]):.1f}" x2="{frame.x(end[0]):.1f}" '
        f'y2="{frame.y(end[1]):.1f}" stroke="{color}" stroke-width="{width:g}"/>'
    )


def arrow(frame: Frame, start: FloatArray, shift: FloatArray, color: str) -> str:
    """A line with a head, from `start` by `shift`, both in units of the frame."""
    end = start + shift
    length = math.hypot(*shift)
    if length * frame.scale < 1.5:
        return dot(frame, start[0], start[1], 1.0, color)
    along = shift / length * min(0.35 * length, 6 / frame.scale)
    across = np.array([-along[1], along[0]]) * 0.5
    return "".join([
        line(frame, start, end, color, 1.4), line(frame, end, end - along + across, color, 1.4),
        line(frame, end, end - along - across, color, 1.4),
    ])  # fmt: skip


def cells(frame: Frame, values: FloatArray, low: float, high: float, unit: str = "") -> list[str]:
    """Rectangles that cover the frame, row by row from y0, coloured by (Y, X) values; NaN stays bare."""
    rows, columns = values.shape
    xs, ys = (np.linspace(a, b, n + 1) for a, b, n in ((frame.x0, frame.x1, columns), (frame.y0, frame.y1, rows)))
    parts = []
    for r in range(rows):
        for c in range(columns):
            if np.isfinite(values[r, c]):
                left, top = frame.x(xs[c]), min(frame.y(ys[r]), frame.y(ys[r + 1]))
                width, height = frame.x(xs[c + 1]) - left, abs(frame.y(ys[r + 1]) - frame.y(ys[r]))
                parts.append(
                    f'<rect x="{left:.1f}" y="{top:.1f}" width="{width + 0.3:.1f}" height="{height + 0.3:.1f}" '
                    f'fill="{color_of(values[r, c], low, high)}"><title>{values[r, c]:.3g} {unit}</title></rect>'
                )
    return parts


def color_of(value: float, low: float, high: float) -> str:
    """Between the colours of `low` and `high`; what lies beyond has theirs."""
    part = min(max((value - low) / (high - low) if high > low else 0.0, 0.0), 1.0) * (len(_STOPS) - 1)
    k = min(int(part), len(_STOPS) - 2)
    mixed = (round(a + (b - a) * (part - k)) for a, b in zip(_STOPS[k], _STOPS[k + 1], strict=True))
    return "#" + "".join(f"{channel:02x}" for channel in mixed)


def color_legend(frame: Frame, low: float, high: float, unit: str, *, most: float = -math.inf) -> str:
    """A bar of the colours beside the frame, with its ends and middle in words.

    Args:
        most: the largest value that is shown; beyond `high` it has the colour of that, and the bar says so.
    """
    steps, x = 24, _MARGIN + WIDTH + 10
    parts = [
        f'<rect x="{x}" y="{_TOP + frame.height * (1 - (k + 1) / steps):.1f}" width="12" '
        f'height="{frame.height / steps + 0.4:.1f}" fill="{color_of(k + 0.5, 0.0, float(steps))}"/>'
        for k in range(steps)
    ]
    for part in (0.0, 0.5, 1.0):
        y = _TOP + frame.height * (1 - part)
        beyond = "≥ " if part == 1.0 and most > high else ""
        number = f"{beyond}{low + part * (high - low):.2g}"
        parts.append(text(x + 16, min(max(y + 4, _TOP + 9), _TOP + frame.height), number))
    parts.append(text(x, _TOP - 6, unit))
    return "".join(parts)


def ticks(frame: Frame, *, x: bool = True, y: bool = True) -> list[str]:
    """Numbers along the axes."""
    parts = []
    if x:
        parts += [
            text(frame.x(at), _TOP + frame.height + 14, f"{at:g}", anchor="middle")
            for at in round_numbers(frame.x0, frame.x1)
        ]
    if y:
        parts += [
            text(_MARGIN - 5, frame.y(at) + 4, f"{at:g}", anchor="end") for at in round_numbers(frame.y0, frame.y1)
        ]
    return parts


def round_numbers(low: float, high: float, about: int = 5) -> list[float]:
    """Some multiples of 1, 2 or 5 times a power of ten between `low` and `high`."""
    if not high > low:
        return [low]
    power = 10.0 ** math.floor(math.log10((high - low) / about))
    step = next(factor * power for factor in (1, 2, 5, 10) if (high - low) / (factor * power) <= about)
    return [round(k * step, 12) for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]
