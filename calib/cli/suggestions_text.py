"""Suggested views in words and as plain values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from calib.next_views import SuggestedView


def suggestion_lines(suggested: Sequence[SuggestedView]) -> Iterator[str]:
    """Where to hold the board next."""
    if not suggested:
        return
    yield from ("", f"photos that would help most (uncertainty of a pixel now {suggested[0].before_px:.2g} px)")
    for k, view in enumerate(suggested):
        yield f"  {k + 1}. {view.words}: {view.after_px:.2g} px left"


def suggestions_json(suggested: Sequence[SuggestedView]) -> list[dict[str, Any]]:
    """As plain values; `cam_from_board` as a unit quaternion w, x, y, z and a translation in metres."""
    return [
        {
            "words": view.words,
            "uncertainty_before_px": view.before_px,
            "uncertainty_after_px": view.after_px,
            "rotation": view.cam_from_board.rotation.wxyz.tolist(),
            "translation": view.cam_from_board.translation.tolist(),
            "points2D": view.points2D.tolist(),
        }
        for view in suggested
    ]
