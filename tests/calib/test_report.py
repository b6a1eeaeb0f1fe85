"""The report: what its figures count, and that the page stands on its own."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib import report_figures as figures
from calib import report_svg as svg
from calib.cli.calibrating import CameraPlan, calibrate_camera
from calib.cli.report_page import report_page, worst_views
from calib.cli.sightings import Sightings
from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_reject import RejectedView
from calib.uncertainty import covariance
from sfm.core.errors import Rejected
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen

BOARD = flat_board()


def views(count: int = 10):
    rng = np.random.default_rng(5)
    return seen(LENS, BOARD, poses_before(LENS, count, rng), rng)


@pytest.fixture(scope="module")
def found() -> Calibration:
    made = calibrate(BOARD, views(), CalibrationConfig(lens="opencv4", shape="paraboloid"))
    assert isinstance(made, Calibration)
    return made


def parts(drawing: str, name: str) -> list[ET.Element]:
    return list(ET.fromstring(drawing).iter("{http://www.w3.org/2000/svg}" + name))


def test_the_coverage_shows_every_corner_within_the_image(found):
    drawing = figures.coverage_figure(found)
    dots = parts(drawing, "circle")
    assert len(dots) == len(found.residuals)
    field = parts(drawing, "rect")[0]
    left, top = float(field.get("x")), float(field.get("y"))
    x = np.array([float(dot.get("cx")) for dot in dots])
    y = np.array([float(dot.get("cy")) for dot in dots])
    scale = svg.WIDTH / found.camera.width
    np.testing.assert_allclose(
        np.sort(x), np.sort(left + scale * found.observations.points2D[:, 0]), atol=0.06
    )  # fmt: skip
    np.testing.assert_allclose(np.sort(y), np.sort(top + scale * found.observations.points2D[:, 1]), atol=0.06)


def test_every_view_has_a_bar_as_high_as_its_error(found):
    drawing = figures.views_figure(found)
    bars = [bar for bar in parts(drawing, "rect") if len(bar)]
    assert [bar[0].text.split(":")[0] for bar in bars] == list(found.observations.names)
    heights = np.array([float(bar.get("height")) for bar in bars])
    np.testing.assert_allclose(heights / heights[0], found.view_rms_px / found.view_rms_px[0], atol=2e-3)


def test_means_over_cells_are_those_of_the_corners_in_them(rng):
    points2D = rng.uniform(0, [1280, 960], (400, 2))
    values = rng.normal(size=(400, 2))
    means, centers = figures.cell_means(points2D, values, LENS, 8)
    for mean, center in zip(means, centers, strict=True):
        inside = np.all(np.abs(points2D - center) <= 80, axis=1)
        np.testing.assert_allclose(mean, values[inside].mean(0), atol=1e-12)
    assert len(means) == 48  # 400 corners leave no cell of 8 by 6 with less than three


def test_the_board_figure_tells_the_bend_in_millimetres(found):
    drawing = figures.board_figure(found.shape)
    heights = [float(dot[0].text.split()[1]) for dot in parts(drawing, "circle") if len(dot)]
    np.testing.assert_allclose(heights, 1e3 * found.shape.displacements[:, 2], atol=6e-4)


@pytest.mark.parametrize("distance", [np.inf, 0.5])
def test_the_uncertainty_is_drawn_for_every_cell_with_a_ray(found, distance):
    given = covariance(found)
    assert not isinstance(given, Rejected)
    drawing = figures.uncertainty_figure(found, given, distance)
    assert len([cell for cell in parts(drawing, "rect") if len(cell)]) == 24 * 18


@pytest.mark.parametrize("name", ["residual_field", "residual_scatter", "tilts"])
def test_figures_are_well_formed_and_within_their_size(found, name):
    root = ET.fromstring(getattr(figures, f"{name}_figure")(found))
    _, _, width, height = map(float, root.get("viewBox").split())
    for dot in root.iter("{http://www.w3.org/2000/svg}circle"):
        assert 0 <= float(dot.get("cx")) <= width
        assert 0 <= float(dot.get("cy")) <= height


def test_arrows_of_the_residual_field_end_within_the_image(found):
    drawing = figures.residual_field_figure(found)
    (field, *_) = parts(drawing, "rect")
    left, top, width, height = (float(field.get(name)) for name in ("x", "y", "width", "height"))
    for line in parts(drawing, "line"):
        assert left - 0.1 <= float(line.get("x2")) <= left + width + 0.1
        assert top - 0.1 <= float(line.get("y2")) <= top + height + 0.1


@pytest.mark.parametrize("count", [1, 40, 60, 90, 200])
def test_a_title_ends_before_the_legend_in_a_wide_font(count):
    drawing = svg.figure(svg.Frame(0.0, 1.0, 0.0, 1.0), "n" * count, [], legend="<g/>")
    (title,) = parts(drawing, "text")
    size, fitted = float(title.get("font-size")), title.get("textLength")
    assert 11 <= size <= 14
    assert (float(fitted) if fitted else 0.6 * size * count) <= svg.WIDTH + 1


def test_a_bar_of_colours_says_that_there_is_more():
    frame = svg.Frame(0.0, 1.0, 0.0, 1.0)
    assert ">≥ 2<" in svg.color_legend(frame, 0.0, 2.0, "px", most=2.1)
    assert "≥" not in svg.color_legend(frame, 0.0, 2.0, "px", most=2.0)


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_round_numbers_lie_between_their_ends_in_even_steps(low, span):
    numbers = svg.round_numbers(low, low + span)
    assert 1 <= len(numbers) <= 8
    assert all(low - 1e-6 * span - 1e-9 <= x <= low + span * (1 + 1e-6) + 1e-9 for x in numbers)
    steps = np.diff(numbers)
    assert len(steps) == 0 or np.ptp(steps) <= 1e-6 * span + 1e-9


def test_colours_run_from_dark_to_light_and_stop_at_the_ends():
    lightness = [
        sum(int(svg.color_of(float(x), 0.0, 1.0)[k : k + 2], 16) for k in (1, 3, 5)) for x in np.linspace(0, 1, 9)
    ]
    assert lightness == sorted(lightness)
    assert svg.color_of(-5.0, 0.0, 1.0) == svg.color_of(0.0, 0.0, 1.0)
    assert svg.color_of(5.0, 0.0, 1.0) == svg.color_of(1.0, 0.0, 1.0)


def page_of(result, **more) -> str:
    return report_page("<camera>", result, **more)


@pytest.fixture(scope="module")
def result():
    left_out = (RejectedView("blind<&>.jpg", "no_board", "nothing seen"),)
    made = calibrate_camera(
        Sightings(None, BOARD, tuple(views()), left_out, "0"), CameraPlan(lens="opencv4", shape="flat")
    )
    assert not isinstance(made, Rejected)
    return made


def test_the_page_asks_nothing_of_the_network_and_names_are_text(result):
    page = page_of(result)
    addresses = set(re.findall(r"https?://[^\"' )]+", page))
    assert addresses == {"http://www.w3.org/2000/svg"}
    assert "<script" not in page
    assert "<camera>" not in page
    assert "blind&lt;&amp;&gt;.jpg" in page


def test_the_page_tells_the_figures_of_the_calibration(result):
    page = page_of(result)
    assert f"{result.found.rms_px:.4f} px" in page
    assert f"{result.held_out.rms_px:.4f} px" in page
    for name, sigma in result.covariances.deviations.items():
        assert f"<td>{name}</td>" in page
        assert f"± {sigma:.3g}" in page
    for finding in result.findings:
        assert finding.remedy[1:40] in page


def test_the_worst_photos_are_shown_where_they_can_be_read(result):
    names = worst_views(result.found)
    errors = dict(zip(result.found.observations.names, result.found.view_rms_px, strict=True))
    assert [errors[name] for name in names] == sorted(errors.values(), reverse=True)[:3]
    grey = np.full((960, 1280), 120, np.uint8)
    assert page_of(result).count("data:image/jpeg") == 0
    assert page_of(result, photos={names[0]: grey}).count("data:image/jpeg") == 1
    assert page_of(result, photos={names[0]: np.dstack([grey] * 3)}).count("data:image/jpeg") == 1
