from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.board_turns import turn_of
from calib.refine_copies import SeenBefore, without_near_copies
from calib.refine_views import BoardView
from tests.calib.boards_in_space import LENS, flat_board, poses_before, seen, with_corners

BOARD = flat_board(6, 4, 0.04)


@pytest.fixture
def views(rng):
    return seen(LENS, BOARD, poses_before(LENS, 12, rng, reach=0.15), rng)


def again(view: BoardView, rng, noise_px: float, name: str = "again") -> BoardView:
    moved = view.points2D + noise_px * rng.normal(size=view.points2D.shape)
    return dataclasses.replace(with_corners(view, moved), name=name)


def reasons(left_out):
    return [(view.name, view.reason) for view in left_out]


def test_a_photo_that_was_saved_anew_counts_once_and_is_named(views, rng):
    copies = [again(views[4], rng, 0.03), dataclasses.replace(views[2], name="copy")]
    kept, left_out = without_near_copies([*views, *copies])
    assert [view.name for view in kept] == [view.name for view in views]
    assert reasons(left_out) == [("again", "nearly_same_as view04"), ("copy", "copy_of view02")]
    assert "nearly the same corners, 0.0" in left_out[0].detail


def test_a_copy_of_a_copy_is_told_by_the_photo_that_stays(views, rng):
    near = again(views[0], rng, 0.03)
    _, left_out = without_near_copies([views[0], near, dataclasses.replace(near, name="third")])
    assert reasons(left_out) == [("again", "nearly_same_as view00"), ("third", "copy_of view00")]


def test_a_copy_that_lost_a_corner_or_has_a_wrong_one_is_a_copy(views, rng):
    near = again(views[0], rng, 0.03)
    fewer = BoardView("fewer", near.width, near.height, near.corner_ids[1:], near.points2D[1:])
    wrong = with_corners(dataclasses.replace(near, name="wrong"), near.points2D + 5.0 * (near.corner_ids == 7)[:, None])
    kept, left_out = without_near_copies([views[0], fewer, wrong])
    assert len(kept) == 1
    assert [view.name for view in left_out] == ["fewer", "wrong"]


def test_a_copy_that_was_read_from_the_other_end_is_a_copy(views, rng):
    turn = turn_of(BOARD, 2)
    assert turn is not None
    full = next(view for view in views if len(view.corner_ids) == len(BOARD))
    near = again(full, rng, 0.03)
    turned = BoardView("turned", near.width, near.height, turn.rows, near.points2D)
    assert len(without_near_copies([full, turned])[0]) == 2
    assert len(without_near_copies([full, turned], (turn,))[0]) == 1


@pytest.mark.parametrize("step_px", [0.5, 1.0, 3.0])
def test_photos_of_slow_motion_stay(views, rng, step_px):
    frames = [
        dataclasses.replace(with_corners(views[0], views[0].points2D + [k * step_px, 0]), name=f"{k}") for k in range(9)
    ]
    assert len(without_near_copies(frames)[0]) == 9


def test_parts_of_a_board_that_share_corners_stay(views):
    one = views[0]
    half = BoardView("half", one.width, one.height, one.corner_ids[:12], one.points2D[:12])
    assert len(without_near_copies([one, half])[0]) == 2


def test_photos_of_another_size_are_no_copies(views, rng):
    smaller = dataclasses.replace(again(views[0], rng, 0.03), width=views[0].width - 1)
    assert len(without_near_copies([views[0], smaller])[0]) == 2


def test_what_is_found_in_cells_is_what_comparing_all_with_all_finds(rng):
    """Views close to one another, beside the slow and obvious way."""
    base = seen(LENS, BOARD, poses_before(LENS, 4, rng, reach=0.1), rng)
    crowd = [
        dataclasses.replace(with_corners(view, view.points2D + rng.uniform(-0.4, 0.4, 2)), name=f"{view.name}.{k}")
        for k in range(12) for view in base
    ]  # fmt: skip
    before, kept = SeenBefore(), []
    for view in crowd:
        shifts = [np.linalg.norm(view.points2D[0] - other.points2D[0]) for other in kept if
                  np.array_equal(other.corner_ids, view.corner_ids)]  # fmt: skip
        found = before.same(view)
        assert (found is not None) == (min(shifts, default=9.0) <= 0.2)
        if found is None:
            before.add(view)
            kept.append(view)
    assert 4 < len(kept) < len(crowd)


def test_a_view_without_corners_is_like_none():
    nothing = BoardView("nothing", 64, 48, np.zeros(0, np.int64), np.zeros((0, 2)))
    before = SeenBefore()
    before.add(nothing)
    assert before.same(nothing) is None
