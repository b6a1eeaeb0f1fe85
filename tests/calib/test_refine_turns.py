from __future__ import annotations

import dataclasses
import itertools
import tracemalloc

import numpy as np
import pytest

import calib.refine
from calib.board_turns import BoardTurn, board_turns
from calib.boards import Board, chessboard, circle_grid
from calib.check import CameraCheck, check_camera, known_shape
from calib.refine import Calibration, CalibrationConfig, calibrate
from calib.refine_ends import Quadratics, most_likely_turns
from calib.refine_turns import read_alike
from calib.refine_views import BoardView
from calib.uncertainty_holdout import HeldOut, hold_out
from calib.uncertainty_lenses import choose_lens
from tests.calib.boards_in_space import LENS, poses_before, seen

EVEN, SQUARE = chessboard(8, 6, 0.03), circle_grid(7, 7, 0.03)
CONFIG = CalibrationConfig(lens="opencv4", shape="free")


def bent(board: Board, by_m: float) -> np.ndarray:
    """Lifted at one end and one corner, and somewhat curved; the middle of the board is the origin."""
    points = np.array(board.points3D)
    points -= (points.min(0) + points.max(0)) / 2
    x, y = (points / points.max(0)[0])[:, :2].T
    return points + np.column_stack([0 * x, 0 * x, by_m * (x**3 + 0.7 * x * x + 0.5 * (x + y) ** 3)])


def read_from(view: BoardView, board: Board, turn: int) -> BoardView:
    """The same photo with the corners named after a turn of the board."""
    ids = board_turns(board)[turn].rows[view.corner_ids]
    order = np.argsort(ids)
    return dataclasses.replace(view, corner_ids=ids[order], points2D=view.points2D[order])


def photos(board: Board, by_m: float, count: int, rng: np.random.Generator) -> list[BoardView]:
    views = seen(LENS, bent(board, by_m), poses_before(LENS, count, rng), rng, 0.05)
    return [view for view in views if len(view.corner_ids) > 20]


def calibrated(board: Board, views: list[BoardView], config: CalibrationConfig = CONFIG) -> Calibration:
    found = calibrate(board.points3D, views, dataclasses.replace(config, turns=board_turns(board)))
    assert isinstance(found, Calibration)
    return found


@pytest.mark.parametrize("share", [0.2, 0.5])
@pytest.mark.parametrize("board", [EVEN, SQUARE], ids=["half turns", "quarter turns"])
def test_views_that_are_read_from_other_ends_give_the_camera_of_views_that_are_not(board, share, rng):
    views = photos(board, 5e-4, 16, rng)
    alike = calibrate(board.points3D, views, CONFIG)
    assert isinstance(alike, Calibration)
    turns = np.where(rng.random(len(views)) < share, rng.integers(1, len(board_turns(board)), len(views)), 0)
    mixed = [read_from(view, board, turn) for view, turn in zip(views, turns.tolist(), strict=True)]
    found = calibrated(board, mixed)
    assert found.rejected_views == ()
    assert found.rms_px == pytest.approx(alike.rms_px, rel=1e-6)
    np.testing.assert_allclose(found.camera.params, alike.camera.params, rtol=1e-5, atol=1e-5)
    spoilt = calibrate(board.points3D, mixed, CONFIG)
    assert isinstance(spoilt, Calibration)
    assert spoilt.rejected_views or spoilt.rms_px > 1.3 * found.rms_px


def test_views_that_were_turned_are_named(rng):
    views = photos(EVEN, 5e-4, 12, rng)
    mixed = [read_from(view, EVEN, int(v in (2, 7))) for v, view in enumerate(views)]
    assert calibrated(EVEN, mixed).turned_views == (views[2].name, views[7].name)


def test_single_corners_that_are_far_off_do_not_hide_which_views_are_turned(rng):
    views, wrong = photos(EVEN, 5e-4, 12, rng), set()
    for v in (1, 4, 9):
        points2D = views[v].points2D.copy()
        points2D[5] += [4.0, -3.0]
        views[v] = dataclasses.replace(views[v], points2D=points2D)
        wrong.add((views[v].name, int(views[v].corner_ids[5])))
    mixed = [read_from(view, EVEN, int(v in (2, 7))) for v, view in enumerate(views)]
    found = calibrated(EVEN, mixed)
    assert found.turned_views == (views[2].name, views[7].name)
    assert wrong <= set(found.rejected_corners)


@pytest.mark.parametrize("shape", ["flat", "scale", "paraboloid"])
def test_where_turns_change_nothing_of_the_shape_views_stay_as_they_are(shape, rng):
    views = photos(EVEN, 5e-4, 10, rng)
    mixed = [read_from(view, EVEN, v % 2) for v, view in enumerate(views)]
    config = dataclasses.replace(CONFIG, shape=shape)
    found, plain = calibrated(EVEN, mixed, config), calibrate(EVEN.points3D, mixed, config)
    assert isinstance(plain, Calibration)
    assert found.cost == plain.cost
    assert found.turned_views == ()


def test_a_square_board_that_is_bent_one_way_is_read_alike_up_to_what_its_bend_does_not_tell(rng):
    """Half a turn changes nothing of a paraboloid: of its four turns two are told apart."""
    points = np.array(SQUARE.points3D)
    points -= (points.min(0) + points.max(0)) / 2
    points[:, 2] += 1e-3 * (1 - (points[:, 0] / points[:, 0].max()) ** 2)
    views = [view for view in seen(LENS, points, poses_before(LENS, 14, rng), rng, 0.05) if len(view.corner_ids) > 20]
    config = dataclasses.replace(CONFIG, shape="paraboloid")
    alike = calibrate(SQUARE.points3D, views, config)
    assert isinstance(alike, Calibration)
    mixed = [read_from(view, SQUARE, {2: 1, 5: 2, 7: 3}.get(v, 0)) for v, view in enumerate(views)]
    found = calibrated(SQUARE, mixed, config)
    assert found.turned_views == (views[2].name, views[7].name)
    np.testing.assert_allclose(found.camera.params, alike.camera.params, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("shape", ["paraboloid", "free"])
def test_telling_ends_apart_takes_little_memory(shape, rng):
    board = chessboard(10, 10, 0.03)
    views, config = photos(board, 5e-4, 24, rng), dataclasses.replace(CONFIG, shape=shape)
    peaks = []
    for turns in ((), board_turns(board)):
        tracemalloc.start()
        assert calibrate(board.points3D, views, dataclasses.replace(config, turns=turns))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0] + 10e6


def test_ends_are_told_apart_once_for_a_lens_and_not_for_its_folds(rng, monkeypatch):
    asked = []
    monkeypatch.setattr(calib.refine, "read_alike", lambda fit, *rest: asked.append(fit) or read_alike(fit, *rest))
    views = photos(SQUARE, 5e-4, 14, rng)
    config = dataclasses.replace(CONFIG, shape="paraboloid", turns=board_turns(SQUARE))
    assert choose_lens(SQUARE.points3D, views, config, lenses=("radial", "opencv4"), folds=5)
    assert sum(len(fit.config.turns) > 1 for fit in asked) == 2


def test_photos_of_a_flat_board_stay_as_they_were_read(rng):
    for _ in range(5):
        assert calibrated(EVEN, photos(EVEN, 0.0, 12, rng)).turned_views == ()


def test_a_view_that_is_held_out_is_read_from_the_end_that_suits_it(rng):
    views = photos(EVEN, 5e-4, 16, rng)
    mixed = [read_from(view, EVEN, int(v % 3 == 0)) for v, view in enumerate(views)]
    turns = board_turns(EVEN)
    alike, found = (held_out(calibrated(EVEN, some), turns) for some in (views, mixed))
    assert found == pytest.approx(alike, rel=1e-5)
    assert held_out(calibrate_as_read(mixed), ()) > 1.5 * found


def held_out(found: Calibration, turns: tuple[BoardTurn, ...]) -> float:
    config = dataclasses.replace(CONFIG, turns=turns)
    held = hold_out(EVEN.points3D, found, config, rng=np.random.default_rng(0))
    assert isinstance(held, HeldOut)
    return held.rms_px


def test_a_camera_is_checked_by_photos_that_are_read_from_either_end(rng):
    views = photos(EVEN, 5e-4, 8, rng)
    mixed = [read_from(view, EVEN, int(v % 3 == 0)) for v, view in enumerate(views)]
    shape = known_shape(bent(EVEN, 5e-4))
    alike = check_camera(LENS, shape, views, limit_px=0.1)
    found = check_camera(LENS, shape, mixed, limit_px=0.1, turns=board_turns(EVEN))
    spoilt = check_camera(LENS, shape, mixed, limit_px=0.1)
    assert isinstance(alike, CameraCheck)
    assert isinstance(found, CameraCheck)
    assert isinstance(spoilt, CameraCheck)
    assert not found.failed
    assert found.rms_px == pytest.approx(alike.rms_px, rel=1e-9)
    assert spoilt.rms_px > 2 * found.rms_px


def test_a_flat_board_is_checked_as_it_was_read(rng):
    views = photos(EVEN, 0.0, 8, rng)
    shape = known_shape(EVEN.points3D)
    found, plain = (check_camera(LENS, shape, views, limit_px=0.1, turns=some) for some in (board_turns(EVEN), ()))
    assert isinstance(found, CameraCheck)
    assert isinstance(plain, CameraCheck)
    np.testing.assert_array_equal(found.found.observations.rows, plain.found.observations.rows)
    assert found.rms_px == plain.rms_px


def calibrate_as_read(views: list[BoardView]) -> Calibration:
    found = calibrate(EVEN.points3D, views, dataclasses.replace(CONFIG, reject=False))
    assert isinstance(found, Calibration)
    return found


def test_the_choice_of_turns_is_that_of_trying_all(rng):
    """Signs of one coefficient: of five views, each as it agrees with the sum of the others."""
    for _ in range(20):
        A = rng.uniform(0.5, 2.0, (5, 1, 1))
        b = rng.choice([-1.0, 1.0], (5, 1)) * rng.uniform(20, 40, (5, 1))
        quadratics = Quadratics(A, b, np.array([[[1.0]], [[-1.0]]]), np.array([[0.1]]))
        found = most_likely_turns(quadratics, np.array([[0, 1], [1, 0]]))
        assert found is not None
        choices = np.array(list(itertools.product((0, 1), repeat=5)))
        sums = np.abs(((1 - 2 * choices) * b[:, 0]).sum(1))
        best = choices[sums.argmax()]
        np.testing.assert_array_equal(found, best if best.sum() < 3 else 1 - best)
