from __future__ import annotations

import xml.etree.ElementTree as ET

from sfm.core.optim import Iteration
from sfm.viz.convergence import convergence_svg


def row(cost: float, accepted: bool = True) -> Iteration:
    return Iteration(cost, 0.0, 10.0 * cost, 1.0, 1e-4, 0.9, accepted)


def test_every_trial_has_a_mark_in_each_panel_and_rejected_ones_are_hollow():
    svg = ET.fromstring(convergence_svg([row(9.0), row(2.0), row(2.0, False), row(1.0)], "a < b & c"))
    marks = [element for element in svg if element.tag.endswith("circle")]
    assert len(marks) == 3 * 4
    assert sum(mark.get("fill") == "white" for mark in marks) == 3
    heights = [float(mark.get("cy", "nan")) for mark in marks[:4]]
    assert heights == sorted(heights)


def test_one_row_and_a_cost_of_zero_are_drawn_too():
    for table in ([row(3.0)], [row(1.0), row(0.0)]):
        assert "nan" not in convergence_svg(table, "")
