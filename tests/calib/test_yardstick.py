"""A splined lens as the yardstick: it follows any smooth lens, and does not take the board for one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_views import BoardView
from calib.uncertainty_holdout import hold_out
from calib.yardstick import Yardstick, measure_lens
from calib.yardstick_spline import Knots, SplinedLens, SplinedSystem
from sfm.core.errors import Rejected
from sfm.core.optim.levenberg_marquardt import StopRules, minimize
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen, with_corners

BOARD = flat_board(7, 5, 0.04)
CONFIG = CalibrationConfig(lens="opencv4", shape="flat", reject=False)
NOISE_PX = 0.05


def views_of_lens(
    seed: int, wave_px: float = 0.0, bend_m: float = 0.0, count: int = 12, reach: float = 0.35
) -> list[BoardView]:
    """Photos by a lens with waves over its image, that no lens model of ours has, of a board that may be crooked."""
    rng = np.random.default_rng(seed)
    crooked = BOARD + bend_m * np.random.default_rng(3).normal(size=BOARD.shape)
    views = seen(LENS, crooked, poses_before(LENS, count, rng, reach=reach), rng, NOISE_PX)
    return [with_corners(view, view.points2D + waves(view.points2D, wave_px)) for view in views]


def waves(points2D: np.ndarray, wave_px: float) -> np.ndarray:
    u, v = points2D.T / 1280
    return wave_px * np.stack([np.sin(9 * u + 4 * v), np.cos(8 * v - 5 * u)], 1)


def measured(views: list[BoardView], config: CalibrationConfig = CONFIG, seed: int = 0) -> Yardstick:
    found = calibrate(BOARD, views, config)
    assert isinstance(found, Calibration), found
    held = hold_out(BOARD, found, config, folds=3, rng=np.random.default_rng(seed))
    assert not isinstance(held, Rejected), held
    result = measure_lens(BOARD, found, config, held.rms_px, folds=3, rng=np.random.default_rng(seed))
    assert isinstance(result, Yardstick), result
    return result


@pytest.fixture(scope="module")
def wavy() -> Yardstick:
    return measured(views_of_lens(1, wave_px=0.3))


def test_weights_of_knots_sum_to_one_and_their_derivatives_are_those_of_differences(rng):
    knots, step = Knots(1280, 960), 1e-4
    points2D = rng.uniform([-50, -40], [1330, 1000], (200, 2))
    coefficients = rng.normal(size=knots.count)

    def value(points):
        at, w, _, _ = knots.weights(points)
        return np.sum(w * coefficients[at], axis=1)

    at, w, by_x, by_y = knots.weights(points2D)
    np.testing.assert_allclose(w.sum(1), 1.0, atol=1e-12)
    assert at.min() >= 0
    assert at.max() < knots.count
    for k, derivative in enumerate((by_x, by_y)):
        apart = step * np.eye(2)[k]
        numeric = (value(points2D + apart) - value(points2D - apart)) / (2 * step)
        np.testing.assert_allclose(np.sum(derivative * coefficients[at], axis=1), numeric, atol=1e-7)


def test_straight_displacements_cost_nothing_but_their_length():
    knots = Knots(640, 480, 4, 3)
    j, i = np.divmod(np.arange(knots.count), 7)
    for straight in (np.ones(knots.count), i - 3.0, 2.0 * j + i):
        assert straight @ knots.penalty() @ straight == pytest.approx(straight @ straight / 9)


def splined(rng: np.random.Generator, size: float = 2.0) -> SplinedLens:
    lens = SplinedLens.of(LENS, 4, 3)
    return dataclasses.replace(lens, coefficients=size * rng.normal(size=lens.coefficients.shape))


def test_derivatives_by_points_of_the_scene_are_those_of_differences(rng):
    lens, step = splined(rng, 30.0), 1e-6
    points = np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)])
    _, by_point, seen_ = lens.project(points)
    assert np.all(seen_)
    for k in range(3):
        apart = step * np.eye(3)[k]
        numeric = (lens.project(points + apart)[0] - lens.project(points - apart)[0]) / (2 * step)
        np.testing.assert_allclose(by_point[:, :, k], numeric, atol=2e-4)


def test_a_step_of_the_sparse_system_solves_the_dense_normal_equations(rng):
    """The slow twin: derivatives by differences of all that is estimated, one matrix, nothing eliminated."""
    found = calibrate(BOARD, views_of_lens(4, count=5), dataclasses.replace(CONFIG, shape="paraboloid"))
    assert isinstance(found, Calibration)
    system = SplinedSystem(found.observations, splined(rng), found.estimate, found.sigma_px)
    system.linearize()
    knots, views, m = system.lens.knots, len(found.observations), system.lens.knots.count
    whitened = lambda point: point.residuals.ravel() / found.sigma_px  # noqa: E731
    J, step = np.empty((2 * len(found.residuals), 2 * m + 3 + 6 * views)), 1e-5
    for k in range(J.shape[1]):
        x = np.zeros(J.shape[1])
        x[k] = step
        ends = [system._moved(s * x[: 2 * m + 3], s * x[2 * m + 3 :].reshape(views, 6)) for s in (1, -1)]
        J[:, k] = (whitened(ends[0]) - whitened(ends[1])) / (2 * step)
    H, g = J.T @ J, J.T @ (system.residuals.ravel() / found.sigma_px)
    for k in range(2):
        part = slice(k * m, (k + 1) * m)
        H[part, part] += knots.penalty() / 64
        g[part] += knots.penalty() / 64 @ system.lens.coefficients[:, k] / found.sigma_px
    damping = 1e-3
    expected = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
    before = system.lens.coefficients
    trial = system.try_step(damping)
    assert trial is not None
    assert trial.step_norm == pytest.approx(np.linalg.norm(expected), rel=1e-4)
    assert trial.predicted_decrease == pytest.approx(
        0.5 * (damping * expected**2 @ np.diag(H) - g @ expected), rel=1e-4
    )  # fmt: skip
    system.accept()
    moved = (system.lens.coefficients - before) / found.sigma_px
    np.testing.assert_allclose(moved.T.ravel(), expected[: 2 * m], atol=1e-3 * np.abs(expected[: 2 * m]).max())


def test_the_cost_falls_to_a_minimum_and_then_stays(rng):
    found = calibrate(BOARD, views_of_lens(4, wave_px=0.3), CONFIG)
    assert isinstance(found, Calibration)
    system = SplinedSystem(found.observations, SplinedLens.of(found.camera), found.estimate, found.sigma_px)
    before = system.cost
    minimize(system, StopRules(max_iterations=60, relative_cost_tolerance=1e-12, gradient_tolerance=0.0))
    assert system.cost < 0.5 * before
    trial = (system.linearize(), system.try_step(0.0))[1]
    assert trial is not None
    assert trial.predicted_decrease < 1e-8 * system.cost


def test_a_lens_that_no_model_follows_is_found_out_with_its_size(wavy):
    assert wavy.is_lens
    assert wavy.splined_rms_px < 0.75 * wavy.lens_rms_px
    assert 0.15 < wavy.differs_px < 0.5
    assert wavy.differs_px < wavy.worst_px
    assert "opencv4 is off by" in wavy.of_lens


def test_a_right_lens_before_a_flat_board_is_not_suspected():
    result = measured(views_of_lens(2))
    assert not result.is_lens
    assert result.differs_px < 0.05
    assert "no error of the lens shows" in result.of_lens


def test_a_crooked_board_is_not_taken_for_the_lens():
    result = measured(views_of_lens(2, bend_m=3e-4))
    assert result.shape == "free"
    assert not result.is_lens
    assert result.lens_rms_px < 0.5 * result.held_out_px
    assert result.board_px > 2 * result.differs_px


def test_where_no_corner_was_nothing_is_said_and_nothing_goes_wrong():
    result = measured(views_of_lens(5, wave_px=0.3, reach=0.05))
    bare = np.isnan(result.differences)
    assert 0.1 < np.mean(bare) < 0.9
    assert np.isfinite(result.differs_px)
    x, y = result.worst_at
    assert not bare[int(y / 960 * bare.shape[0]), int(x / 1280 * bare.shape[1])]


def test_the_same_seed_gives_the_same_bits(wavy):
    again = measured(views_of_lens(1, wave_px=0.3))
    assert again.splined_rms_px == wavy.splined_rms_px
    np.testing.assert_array_equal(again.differences, wavy.differences)


def test_views_too_few_to_hold_any_out_are_told():
    views = views_of_lens(1, count=3)
    found = calibrate(BOARD, views, CONFIG)
    assert isinstance(found, Calibration)
    result = measure_lens(BOARD, found, CONFIG, rng=np.random.default_rng(0))
    assert isinstance(result, Rejected)
    assert result.reason == "too_few_views"


def test_corners_without_errors_accuse_no_lens():
    rng = np.random.default_rng(0)
    views = seen(LENS, BOARD, poses_before(LENS, 8, rng), rng, 0.0)
    found = calibrate(BOARD, views, CONFIG)
    assert isinstance(found, Calibration)
    result = measure_lens(BOARD, found, CONFIG, folds=2, rng=np.random.default_rng(0))
    assert isinstance(result, Rejected) or result.differs_px < 1e-6


def test_what_is_better_by_chance_only_stays_open(wavy):
    words = [dataclasses.replace(wavy, is_lens=False, splined_rms_px=f * wavy.lens_rms_px).of_lens for f in (0.9, 1.0)]
    assert words[0].startswith("open: ")
    assert words[1].startswith("no error of the lens shows: ")
