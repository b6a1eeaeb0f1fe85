"""The scene of a calibration: its grid, and that it is a valid file with all entities."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import ImageError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.viz import rerun_boards, rerun_viewer
from sfm.viz.rerun_boards import BoardPhoto, BoardScene, grid_lines

CAMERA = Camera("PINHOLE", 320, 240, np.array([300.0, 300, 160, 120]))


def scene() -> BoardScene:
    rng = np.random.default_rng(0)
    board = np.array([[x, y, 0.0] for y in range(3) for x in range(4)]) * 0.03
    turns = Rotation3.exp(0.1 * rng.normal(size=(2, 3)))
    poses = Rigid3(turns, np.array([[0.0, 0, 0.5], [0.1, 0, 0.6]]))

    def photo(camera: str, moment: int) -> BoardPhoto:
        return BoardPhoto(
            camera, f"{moment}.jpg", CAMERA.project(poses[moment] @ board)[0], 0.1 * rng.normal(size=(12, 2))
        )

    return BoardScene(
        cameras={"left": CAMERA, "right eye": CAMERA},
        cams_from_world=Rigid3.identity((2,)),
        points3D=board,
        lines=grid_lines(4, 3),
        worlds_from_board=poses,
        photos=((photo("left", 0), photo("right eye", 0)), (photo("left", 1),)),
        names=("0", "1"),
        worst_px=0.3,
        report="# Two cameras",
    )


def test_lines_of_a_grid_join_all_neighbours_and_nothing_else():
    lines = grid_lines(4, 3)
    places = np.stack([np.arange(12) % 4, np.arange(12) // 4], 1)
    distances = np.abs(places[lines[:, 0]] - places[lines[:, 1]]).sum(1)
    assert len(lines) == len({tuple(line) for line in lines.tolist()}) == 3 * 3 + 4 * 2
    np.testing.assert_array_equal(distances, 1)


def test_a_scene_of_boards_is_a_valid_file_with_all_entities(tmp_path: Path):
    pytest.importorskip("rerun")
    target = tmp_path / "boards.rrd"

    def read_photo(camera: str, name: str) -> np.ndarray:
        if camera != "left":
            raise ImageError("gone", path=name)
        return np.full((240, 320), 90, np.uint8)

    assert rerun_boards.log_boards(scene(), read_photo, save=target) == target.stat().st_size > 2000
    environment = {**os.environ, "CI": "1"}
    program = rerun_viewer.viewer_command(target)[0]
    subprocess.run([program, "rrd", "verify", str(target)], check=True, capture_output=True, env=environment)
    stats = subprocess.run(
        [program, "rrd", "stats", str(target)], check=True, capture_output=True, text=True, env=environment
    ).stdout
    for entity in ("/boards", "/cameras/1/image", "/current/board", "/current/0/image/residuals", "/current/1/image"):
        assert f"{entity}:" in stats
