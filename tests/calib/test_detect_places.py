"""Corners off the grid of their neighbours, against a judge that lets one go at a time."""

from __future__ import annotations

import numpy as np
import pytest

from calib import detect_neighbours
from calib.boards import aprilgrid, asymmetric_circle_grid, charuco, chessboard
from calib.detect_gates import Corners, DetectConfig, _judge_places
from calib.detect_neighbours import local_affines, predicted
from calib.detect_places import LEAST_BEND, LEAST_BEND_PX, misplaced

BOARDS = (chessboard(9, 6, 0.03), charuco(12, 9, 0.03, 0.02), aprilgrid(4, 4, 0.08, 0.024),
          asymmetric_circle_grid(4, 11, 0.02))  # fmt: skip


def one_by_one(places, points2D, radius_m, max_bend):
    """Lets the worst corner go, asks all anew, and so on."""
    kept = np.ones(len(places), bool)
    while kept.sum() > 4:
        known, pixels = places[kept], points2D[kept]
        wanted, gain = predicted(known, known, pixels)
        off = np.linalg.norm(wanted - pixels, axis=1) / gain
        scale = np.median(np.linalg.svd(local_affines(known, pixels), compute_uv=False)) * 2 * radius_m
        if off.max() <= max(max_bend * np.median(off), LEAST_BEND * scale, LEAST_BEND_PX):
            break
        kept[np.flatnonzero(kept)[np.argmax(off)]] = False
    return ~kept


def shown(places, rng):
    """Pixels of a board aslant before a lens that bends lines."""
    u = (places - places.mean(axis=0)) / np.ptp(places)
    pixels = rng.uniform(300, 1500) * u @ (np.eye(2) + 0.2 * rng.normal(size=(2, 2)))
    bent = (1 - rng.uniform(0, 0.3) * np.square(u).sum(1)) / (1 + 0.3 * u @ rng.normal(size=2))
    return pixels * bent[:, None] + 600 + rng.normal(0, 0.1, pixels.shape)


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.spec)
def test_the_worst_go_together_as_they_would_one_by_one(board, rng):
    gone = 0
    for cluster in (False, True) * 3:
        places = board.points3D[:, :2]
        pixels, count = shown(places, rng), len(places) // 6
        first = places[rng.integers(len(places))]
        nearest = np.argsort(np.linalg.norm(places - first, axis=1))[:count]
        wrong = nearest if cluster else rng.choice(len(places), count, replace=False)
        pixels[wrong] += rng.normal(0, rng.uniform(2, 40), (count, 2))
        found = misplaced(places, pixels, board.clear_radius_m, 6.0)
        np.testing.assert_array_equal(found, one_by_one(places, pixels, board.clear_radius_m, 6.0))
        gone += found.sum()
    assert gone > 5


def test_asking_neighbours_costs_a_few_rounds_however_many_corners_are_wrong(rng, monkeypatch):
    board, asked = chessboard(30, 20, 0.02), []
    places = board.points3D[:, :2]
    pixels = 5000 * places + 500 + rng.normal(0, 0.1, places.shape)
    wrong = rng.choice(len(places), 40, replace=False)
    pixels[wrong] += rng.choice([-1, 1], (40, 2)) * rng.uniform(20, 40, (40, 2))
    nothing = np.full(len(places), np.nan)
    corners = Corners(np.arange(len(places)), pixels, pixels, np.tile(np.eye(2), (len(places), 1, 1)),
                      np.full((len(places), 11), np.nan), nothing)  # fmt: skip
    original = detect_neighbours._neighbourhoods
    monkeypatch.setattr(
        detect_neighbours,
        "_neighbourhoods",
        lambda targets, *rest: asked.append(len(targets)) or original(targets, *rest),
    )
    _judge_places(board, corners, DetectConfig())
    assert set(corners.reasons) == set(wrong.tolist())
    assert sum(asked) < 3 * len(places)


def test_corners_on_a_line_are_not_judged():
    places = chessboard(9, 3, 0.03).points3D[:9, :2]
    assert not misplaced(places, 1000 * places + [5, 7], 0.015, 6.0).any()


def test_affines_of_some_corners_are_those_of_all(rng):
    places = chessboard(9, 6, 0.03).points3D[:, :2]
    pixels, some = shown(places, rng), np.array([3, 0, 50])
    np.testing.assert_array_equal(local_affines(places, pixels, some), local_affines(places, pixels)[some])
