"""Where in the image a calibrated lens departs from a splined one, as SVG."""

from __future__ import annotations

from calib import report_svg as svg
from calib.report_figures import image_frame
from calib.yardstick import Yardstick
from sfm.core.cameras import Camera


def lens_difference_figure(camera: Camera, measured: Yardstick) -> str:
    """Differences between the two in cells that have shown a corner; the others stay bare."""
    frame, high = image_frame(camera), measured.worst_px
    return svg.figure(
        frame, f"{measured.lens} beside a splined lens: {measured.differs_px:.2g} px (rms), most {high:.2g} px",
        [*svg.cells(frame, measured.differences, 0.0, high, "px"), *svg.ticks(frame)], across="px",
        legend=svg.color_legend(frame, 0.0, high, "px"),
    )  # fmt: skip
