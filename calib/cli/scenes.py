"""Calibrations of a camera, or of a rig, as scenes for the viewer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib.boards import Board
from calib.cli.calibrating import CalibratedCamera
from calib.cli.rig_again import RigAgain
from calib.cli.rig_report import rig_remarks
from calib.report_figures import CameraResiduals
from sfm.core.geometry.rigid import Rigid3
from sfm.viz.rerun_boards import BoardPhoto, BoardScene, grid_lines

_WORST_SIGMAS = 4.0


def camera_scene(name: str, made: CalibratedCamera, board: Board | None) -> BoardScene:
    """The calibration as a scene whose world is the camera's frame."""
    found = made.found
    told = [f"{finding.cause.replace('_', ' ')}: {finding.detail}" for finding in made.findings]
    return BoardScene(
        cameras={name: found.camera},
        cams_from_world=Rigid3.identity((1,)),
        points3D=found.shape.points3D,
        lines=board_lines(board),
        worlds_from_board=found.cams_from_board,
        photos=tuple((photo,) for photo in _photos(name, found)),
        names=found.observations.names,
        worst_px=_WORST_SIGMAS * found.sigma_px,
        report=_report(
            name, f"{found.camera.model}, rms {found.rms_px:.4f} px, {len(found.observations)} photos", told
        ),
    )


def rig_scene(name: str, made: RigAgain) -> BoardScene:
    """The calibration of a rig as a scene whose world is the rig's frame; a moment is a frame."""
    found = made.found
    frames = found.observations.frames
    photos: list[list[BoardPhoto]] = [[] for _ in frames]
    for c, camera in enumerate(found.names):
        for frame, photo in zip(found.observations.frame_of[c], _photos(camera, found.one_camera(c)), strict=True):
            photos[frame].append(photo)
    shared = sum(len(some) > 1 for some in photos)
    facts = f"{len(found.names)} cameras, rms {found.rms_px:.4f} px, {len(frames)} frames, {shared} of them shared"
    return BoardScene(
        cameras=dict(zip(found.names, found.cameras, strict=True)),
        cams_from_world=found.cams_from_rig,
        points3D=found.shape.points3D,
        lines=board_lines(made.board),
        worlds_from_board=found.rigs_from_board,
        photos=tuple(map(tuple, photos)),
        names=frames,
        worst_px=_WORST_SIGMAS * found.sigma_px,
        report=_report(name, facts, [*found.fallbacks, *rig_remarks(found)]),
    )


def board_lines(board: Board | None) -> np.ndarray:
    """(L, 2) neighbours among the board's points; of tags their sides."""
    if board is None:
        return np.zeros((0, 2), np.int64)
    if board.kind == "aprilgrid":
        corners = 4 * np.arange(board.columns * board.rows)[:, None]
        return np.concatenate([np.stack([corners + k, corners + (k + 1) % 4], 2)[:, 0] for k in range(4)])
    return grid_lines(*board.grid)


def _photos(camera: str, found: CameraResiduals) -> list[BoardPhoto]:
    """What one camera saw, view by view."""
    o = found.observations
    return [
        BoardPhoto(camera, shown, o.points2D[a:b], found.residuals[a:b])
        for shown, a, b in zip(o.names, o.offsets[:-1], o.offsets[1:], strict=True)
    ]


def _report(name: str, facts: str, told: Sequence[str]) -> str:
    return f"# {name}\n\n{facts}\n\n" + "".join(f"- {words}\n" for words in told)
