from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from calib.board_turns import BoardTurn, board_turns
from calib.boards import Board, chessboard, circle_grid
from calib.rig import RigCalibration, RigConfig, calibrate_rig
from calib.rig_shapes import choose_rig_shape
from calib.rig_system import RigSystem
from calib.rig_uncertainty import RigCovariance, rig_covariance
from calib.rig_views import RigCamera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.calib.rigs_in_space import PAIR, photographed, poses_before_rig

EVEN, SQUARE = chessboard(8, 6, 0.03), circle_grid(7, 7, 0.03)
FREE = RigConfig(shape="free")


def photos(board: Board, rng: np.random.Generator, count: int = 14, by_m: float = 1.2e-3) -> list[RigCamera]:
    """Of a board that is lifted at one end, by two cameras; the last frame is seen by the first camera alone."""
    points = np.array(board.points3D)
    middle = points.mean(0)
    x, y = ((points - middle) / np.abs(points - middle).max())[:, :2].T
    bent = points + np.column_stack([0 * x, 0 * x, by_m * (x**3 + 0.7 * x * x + 0.5 * (x + y) ** 3)])
    poses = [pose @ Rigid3(Rotation3.identity(), -middle) for pose in poses_before_rig(count, rng)]
    one, two = photographed(*PAIR, bent, poses, rng, 0.05, least=20)
    return [one, dataclasses.replace(two, views=two.views[:-1], frames=two.frames[:-1])]


def read_from(camera: RigCamera, turns: tuple[BoardTurn, ...], chosen: dict[str, int]) -> RigCamera:
    """The same photos with the corners of each frame named after a turn of the board."""
    views = [
        dataclasses.replace(view, corner_ids=turns[chosen.get(frame, 0)].rows[view.corner_ids])
        for view, frame in zip(camera.views, camera.frames, strict=True)
    ]
    return dataclasses.replace(camera, views=tuple(views))


def calibrated(board: Board, cameras: list[RigCamera], turns: tuple[BoardTurn, ...]) -> RigCalibration:
    found = calibrate_rig(board.points3D, cameras, FREE, turns=turns)
    assert isinstance(found, RigCalibration)
    return found


@pytest.mark.parametrize("board", [EVEN, SQUARE], ids=["half turns", "quarter turns"])
@pytest.mark.parametrize("together", [True, False], ids=["by both cameras", "by each for itself"])
def test_frames_that_are_read_from_other_ends_give_the_rig_of_frames_that_are_not(board, together, rng):
    cameras, turns = photos(board, rng), board_turns(board)
    alike = calibrated(board, cameras, turns)
    chosen = [
        {f: int(rng.integers(len(turns))) if k % 3 == c else 0 for k, f in enumerate(cameras[0].frames)} for c in (0, 1)
    ]
    mixed = [read_from(one, turns, chosen[0 if together else c]) for c, one in enumerate(cameras)]
    found = calibrated(board, mixed, turns)
    assert found.rms_px == pytest.approx(alike.rms_px, rel=1e-6)
    for one, other in zip(found.cameras, alike.cameras, strict=True):
        np.testing.assert_allclose(one.params, other.params, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.cams_from_rig.translation, alike.cams_from_rig.translation, atol=1e-7)
    for c, one in enumerate(mixed):
        turned = {f for f in one.frames if chosen[0 if together else c].get(f)}
        assert set(found.turned[c]) == turned


def test_held_out_frames_that_are_read_from_both_ends_are_predicted_as_well(rng):
    turns = board_turns(EVEN)
    cameras = photos(EVEN, rng, 16)
    chosen = {frame: k % 2 for k, frame in enumerate(cameras[0].frames)}
    errors = []
    for some in (cameras, [read_from(one, turns, chosen) for one in cameras]):
        ranked = choose_rig_shape(EVEN.points3D, some, turns=turns, shapes=("flat", "free"), folds=3)
        assert isinstance(ranked, tuple)
        errors.append({row.kind: row.held_out_rms_px for row in ranked})
    assert errors[1]["free"] == pytest.approx(errors[0]["free"], rel=1e-4)
    assert errors[1]["free"] < 0.5 * errors[1]["flat"]


def test_what_a_frame_adds_is_the_problem_of_that_frame_alone(rng):
    found = calibrated(EVEN, photos(EVEN, rng, 8), ())
    system = found.system()
    parts, gradients = system.by_frame()
    for f in range(len(found.observations.frames)):
        some, left = found.observations.of_frames([f])
        alone = RigSystem(some, found.estimate.of_frames(left), found.columns, free_shape=True).normal_equations()
        H, W = alone.H[0], alone.W[0]
        reduced = alone.A - W.T @ np.linalg.inv(H) @ W
        np.testing.assert_allclose(parts[f], reduced[:-1, :-1], rtol=1e-6, atol=1e-9 * np.abs(reduced).max())
        np.testing.assert_allclose(gradients[f], reduced[:-1, -1], atol=1e-7 * np.abs(reduced[:-1, -1]).max() + 1e-9)


def test_a_point_that_one_frame_alone_tells_costs_the_rig_no_deviation_by_frames(rng):
    one, two = photos(EVEN, rng, 16, by_m=0.0)
    shown = [f for f in two.frames if all(0 in c.views[c.frames.index(f)].corner_ids for c in (one, two))][:1]
    rare = []
    for camera in (one, two):
        kept = [
            np.flatnonzero((v.corner_ids != 0) | (f in shown)) for v, f in zip(camera.views, camera.frames, strict=True)
        ]
        views = [
            dataclasses.replace(v, corner_ids=v.corner_ids[k], points2D=v.points2D[k])
            for v, k in zip(camera.views, kept, strict=True)
        ]
        rare.append(dataclasses.replace(camera, views=tuple(views)))
    found = calibrated(EVEN, rare, ())
    assert found.observations.shown[0] == 2
    known = rig_covariance(found, by_frame=True)
    assert isinstance(known, RigCovariance)
    assert np.all(np.isfinite(known.mounts))
    assert all(np.isfinite(sigma) for one in known.sigma_params for sigma in one.values())
    assert not np.all(np.isfinite(known.shared))
