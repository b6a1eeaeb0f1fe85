"""How an adjustment went, drawn as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.sax.saxutils import escape

from sfm.core.optim.levenberg_marquardt import Iteration

_WIDTH, _HEIGHT, _LEFT, _TOP, _GAP = 720.0, 220.0, 90.0, 34.0, 70.0
_LEAST = 1e-12
_PANELS = ("cost above its end, as a part of it", "largest entry of the gradient", "damping")


def convergence_svg(table: Sequence[Iteration], title: str) -> str:
    """Cost, gradient and damping of each trial, on logarithmic axes; rejected trials are hollow."""
    last = table[-1].cost
    columns = (
        [max(row.cost / last - 1, _LEAST) if last > 0 else _LEAST for row in table],
        [max(row.gradient_max, 1e-300) for row in table],
        [row.damping for row in table],
    )
    height = _TOP + len(_PANELS) * (_HEIGHT + _GAP)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH + _LEFT + 30}" height="{height}" '
        f'font-family="sans-serif" font-size="12">',
        '<rect width="100%" height="100%" fill="white"/>',
        f'<text x="{_LEFT}" y="20" font-size="15">{escape(title)}</text>',
    ]
    for k, (name, values) in enumerate(zip(_PANELS, columns, strict=True)):
        parts += _panel(name, values, [row.accepted for row in table], _TOP + k * (_HEIGHT + _GAP) + 20)
    return "\n".join([*parts, "</svg>"]) + "\n"


def _panel(name: str, values: Sequence[float], accepted: Sequence[bool], top: float) -> list[str]:
    logs = [math.log10(value) for value in values]
    low = math.floor(min(logs))
    high = max(math.ceil(max(logs)), low + 1)

    def x(k: int) -> float:
        return _LEFT + _WIDTH * k / max(len(values) - 1, 1)

    def y(log: float) -> float:
        return top + _HEIGHT * (high - log) / (high - low)

    parts = [
        f'<text x="{_LEFT}" y="{top - 6}">{escape(name)}</text>',
        f'<rect x="{_LEFT}" y="{top}" width="{_WIDTH}" height="{_HEIGHT}" fill="none" stroke="#999"/>',
    ]
    for power in range(low, high + 1, max(1, (high - low) // 6)):
        at = y(float(power))
        parts.append(f'<line x1="{_LEFT}" x2="{_LEFT + _WIDTH}" y1="{at:.1f}" y2="{at:.1f}" stroke="#eee"/>')
        parts.append(f'<text x="{_LEFT - 8}" y="{at + 4:.1f}" text-anchor="end">1e{power}</text>')
    parts += [
        f'<text x="{x(k):.1f}" y="{top + _HEIGHT + 16}" text-anchor="middle">{k}</text>'
        for k in range(0, len(values), max(1, len(values) // 10))
    ]
    line = " ".join(f"{x(k):.1f},{y(log):.1f}" for k, log in enumerate(logs))
    parts.append(f'<polyline points="{line}" fill="none" stroke="#005ac8" stroke-width="1.5"/>')
    for k, log in enumerate(logs):
        fill = "#005ac8" if accepted[k] else "white"
        parts.append(f'<circle cx="{x(k):.1f}" cy="{y(log):.1f}" r="3" fill="{fill}" stroke="#005ac8"/>')
    return parts
