"""Suggested views, drawn: the image with its uncertainty, corners seen so far, and where to hold the board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from xml.sax.saxutils import escape

import numpy as np
from jaxtyping import Float64

from calib.boards import Board
from calib.next_views import SuggestedView
from sfm.core.arrays import Points2D
from sfm.core.cameras import Camera

_WIDTH, _BORDER, _LINE = 760.0, 16.0, 20.0
_COLOURS = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#8c564b", "#e377c2")


def suggestions_svg(
    camera: Camera, board: Board | None, seen: Points2D, deviations: Float64[np.ndarray, "Y X"] | None,
    suggested: Sequence[SuggestedView],
) -> str:  # fmt: skip
    """One SVG.

    Args:
        seen: corners of the photos so far, px.
        deviations: uncertainty over cells of the image, px; darker cells are less certain.
    """
    scale = _WIDTH / camera.width
    height = camera.height * scale
    total = height + 2 * _BORDER + _LINE * (len(suggested) + 2)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH + 2 * _BORDER:.0f}" height="{total:.0f}" '
        'font-family="sans-serif" font-size="13">',
        '<rect width="100%" height="100%" fill="white"/>',
        f'<g transform="translate({_BORDER} {_BORDER})">',
        *(_cells(deviations, _WIDTH, height) if deviations is not None else ()),
        f'<rect width="{_WIDTH:.1f}" height="{height:.1f}" fill="none" stroke="#444"/>',
        *(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.3" fill="#666"/>' for x, y in seen * scale),
    ]
    for k, view in enumerate(suggested):
        parts += _held_board(board, view.points2D * scale, _COLOURS[k % len(_COLOURS)], str(k + 1))
    parts.append("</g>")
    top = height + 2 * _BORDER + 6
    for k, line in enumerate(_legend(deviations, suggested)):
        colour = _COLOURS[(k - 1) % len(_COLOURS)] if k else "#444"
        parts.append(f'<text x="{_BORDER}" y="{top + _LINE * k:.1f}" fill="{colour}">{escape(line)}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def _legend(deviations: np.ndarray | None, suggested: Sequence[SuggestedView]) -> Iterator[str]:
    shade = ""
    if deviations is not None and np.isfinite(deviations).any():
        shade = f"; shade: uncertainty of a pixel, up to {np.nanmax(deviations):.2g} px"
    yield f"dots: corners so far{shade}"
    for k, view in enumerate(suggested):
        yield f"{k + 1}: {view.words} ({view.before_px:.2g} → {view.after_px:.2g} px)"


def _cells(deviations: np.ndarray, width: float, height: float) -> Iterator[str]:
    down, across = deviations.shape
    most = np.nanmax(deviations) if np.isfinite(deviations).any() else 1.0
    for row in range(down):
        for column in range(across):
            value = deviations[row, column]
            shade = 0.75 * value / most if np.isfinite(value) else 1.0
            place = f'x="{column * width / across:.1f}" y="{row * height / down:.1f}"'
            size = f'width="{width / across + 0.5:.1f}" height="{height / down + 0.5:.1f}"'
            yield f'<rect {place} {size} fill="#f0a030" fill-opacity="{shade:.2f}"/>'


def _held_board(board: Board | None, points: Points2D, colour: str, number: str) -> Iterator[str]:
    """Rows and columns of the corners as lines, and a number in the middle."""
    for line in _lines(board, len(points)):
        joined = " ".join(f"{x:.1f},{y:.1f}" for x, y in points[line])
        yield f'<polyline points="{joined}" fill="none" stroke="{colour}" stroke-width="1.2"/>'
    x, y = points.mean(axis=0)
    yield f'<circle cx="{x:.1f}" cy="{y:.1f}" r="13" fill="white" stroke="{colour}" stroke-width="2"/>'
    yield (
        f'<text x="{x:.1f}" y="{y + 5:.1f}" text-anchor="middle" font-size="15" font-weight="bold" '
        f'fill="{colour}">{number}</text>'
    )


def _lines(board: Board | None, count: int) -> Iterator[np.ndarray]:
    """Runs of corners to join."""
    numbers = np.arange(count)
    if board is None or board.kind == "aprilgrid":  # tag by tag
        yield from (np.append(tag, tag[0]) for tag in numbers[: count // 4 * 4].reshape(-1, 4))
        return
    columns, rows = board.grid
    grid = numbers.reshape(rows, columns)
    yield from grid
    yield from grid.T
