"""Cost against time of both sides of `bench_bundle`, as a table and drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

Curve: TypeAlias = list[tuple[float, float]]
"""Seconds since the call, and the cost reached by then."""

_EXCESSES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
_LEAST_EXCESS = 1e-7
"""Ceres prints costs to seven digits."""
_COLORS = {"ours": (0, 90, 200), "ceres": (210, 60, 0)}


def excess(curve: Curve, best: float) -> list[tuple[float, float]]:
    """Seconds, and the cost above `best` as a part of it."""
    return [(seconds, max(cost / best - 1, _LEAST_EXCESS)) for seconds, cost in curve]


def best_of(curves: dict[str, Curve]) -> float:
    """The least cost of all sides."""
    return min(cost for curve in curves.values() for _, cost in curve)


def seconds_to(curve: Curve, best: float, within: float) -> float:
    """When the cost has come within this part of `best`; inf where it never does."""
    return next((seconds for seconds, cost in curve if cost <= best * (1 + within)), math.inf)


def curve_table(curves: dict[str, Curve]) -> str:
    """Each trial of each side, and when each came within some parts of the least cost."""
    best = best_of(curves)
    lines = []
    for side, curve in curves.items():
        lines.append(f"    {side}: trial, seconds, cost, above the least cost")
        lines += [f"      {k:4} {s:10.4f} {c:16.8e} {c / best - 1:9.1e}" for k, (s, c) in enumerate(curve)]
    lines.append("    seconds until within …  " + "".join(f"{part:>10.0e}" for part in _EXCESSES))
    for side, curve in curves.items():
        times = [seconds_to(curve, best, part) for part in _EXCESSES]
        lines.append(f"      {side:20}" + "".join(f"{t:10.4f}" if math.isfinite(t) else f"{'-':>10}" for t in times))
    return "\n".join(lines)


def draw(named: Sequence[tuple[str, dict[str, Curve]]], path: Path) -> None:
    """One panel for each problem, both axes logarithmic."""
    import cv2

    if not named:
        return
    panels = [_panel(name, curves) for name, curves in named]
    columns = min(len(panels), 3)
    panels += [np.full_like(panels[0], 255)] * (-len(panels) % columns)
    bands = [np.hstack(panels[k : k + columns]) for k in range(0, len(panels), columns)]
    cv2.imwrite(str(path), np.vstack(bands)[:, :, ::-1])


def _panel(name: str, curves: dict[str, Curve], width: int = 560, height: int = 400) -> np.ndarray:
    """Lines over decades of time and of the part above the least cost."""
    import cv2

    image = np.full((height, width, 3), 255, np.uint8)
    left, right, top, bottom = 70, width - 15, 30, height - 45
    logs = {side: np.log10(np.maximum(excess(curve, best_of(curves)), 1e-12)) for side, curve in curves.items()}
    stacked = np.concatenate(list(logs.values()))
    low, high = np.floor(stacked.min(axis=0)), np.ceil(stacked.max(axis=0) + 1e-9)
    high = np.maximum(high, low + 1)

    def place(point: np.ndarray) -> tuple[int, int]:
        x, y = (point - low) / (high - low)
        return round(left + x * (right - left)), round(bottom - y * (bottom - top))

    def write(text: str, x: int, y: int, color: tuple[int, int, int] = (0, 0, 0)) -> None:
        cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.4, color, 1, cv2.LINE_AA)

    for decade in range(int(low[0]), int(high[0]) + 1):
        x, _ = place(np.array([decade, low[1]]))
        cv2.line(image, (x, top), (x, bottom), (225, 225, 225), 1)
        write(f"1e{decade} s", x - 15, bottom + 16)
    for decade in range(int(low[1]), int(high[1]) + 1):
        _, y = place(np.array([low[0], decade]))
        cv2.line(image, (left, y), (right, y), (225, 225, 225), 1)
        write(f"1e{decade}", 20, y + 4)
    write(name, left, 18)
    write("cost above the least, as a part of it, against seconds since the call", left, height - 8)
    for k, (side, points) in enumerate(logs.items()):
        corners = np.array([place(point) for point in points], np.int32)
        cv2.polylines(image, [corners], False, _COLORS[side], 1, cv2.LINE_AA)
        for corner in corners:
            cv2.circle(image, tuple(map(int, corner)), 2, _COLORS[side], -1, cv2.LINE_AA)
        write(side, right - 60, top + 16 + 16 * k, _COLORS[side])
    return image
