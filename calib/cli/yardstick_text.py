"""What a splined lens says of a calibration, for a person and for a program."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from calib.yardstick import Yardstick
from sfm.core.errors import Rejected


def yardstick_lines(measured: Yardstick | Rejected | None) -> Iterator[str]:
    """For the screen; nothing where it was not asked."""
    if measured is None:
        return
    if isinstance(measured, Rejected):
        yield from ("", f"no splined lens as a yardstick: {measured.reason}: {measured.detail}".rstrip(": "))
        return
    yield from ("", f"what remains in the residuals, by {yardstick_words(measured)}")
    yield f"  lens    {measured.of_lens}"
    if measured.of_board:
        yield f"  board   {measured.of_board}"


def yardstick_words(measured: Yardstick) -> str:
    """What it is."""
    shape = ", every corner of the board free" if measured.shape == "free" else ""
    return f"a splined lens of {measured.coefficients} coefficients{shape}"


def yardstick_json(measured: Yardstick | Rejected | None) -> dict[str, Any] | None:
    """As plain values; null where it was not asked."""
    if measured is None:
        return None
    if isinstance(measured, Rejected):
        return {"refused": f"{measured.reason}: {measured.detail}"}
    return {
        "is_lens": measured.is_lens,
        "coefficients": measured.coefficients,
        "board_shape": measured.shape,
        "lens_holdout_rms_px": measured.lens_rms_px,
        "splined_holdout_rms_px": measured.splined_rms_px,
        "differs_px": measured.differs_px,
        "worst_px": measured.worst_px,
        "worst_at": list(measured.worst_at),
        "board_moves_camera_px": measured.board_px,
    }
