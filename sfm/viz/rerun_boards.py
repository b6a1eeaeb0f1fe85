"""Boards before the cameras that photographed them, as a Rerun scene.

    /                       view coordinates: those of the first camera, x right, y down; static
    cameras/<name>          pose and frustum; static
    boards                  all boards as grids of lines, coloured by their error; static
    current/board           the board of one moment on the timeline "photo"
    current/<name>/image    its photo, corners coloured by their residual, and the residuals, drawn longer
    report                  a few lines about the calibration; static

Photos are shown as they are: pixels are where the lens put them, so frusta are those of the ideal camera only.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64

from sfm.core.arrays import ImageU8, Points2D, Points3D, Value, readonly
from sfm.core.cameras import Camera
from sfm.core.errors import SfmError
from sfm.core.geometry.rigid import Rigid3
from sfm.viz.rerun_log import residual_colors
from sfm.viz.rerun_viewer import as_jpeg, present_scene

_PHOTO_PX = 1024
RESIDUALS_LONGER = 40.0


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BoardPhoto(Value):
    """What one camera saw of the board at one moment.

    Attributes:
        camera: name of it.
        photo: the name to read the photo by.
        points2D: (k, 2) corners, px; residuals: (k, 2) projected − observed.
    """

    camera: str
    photo: str
    points2D: Points2D
    residuals: Float64[np.ndarray, "k 2"]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class BoardScene(Value):
    """Cameras and boards in one frame.

    Attributes:
        cameras: by name; cams_from_world: batch (C,) in the same order.
        lines: (L, 2) rows of points3D, the grid of the board as pairs of neighbours.
        points3D: (P, 3) of the board in its own frame.
        worlds_from_board: batch (V,), one for each moment.
        photos: of each moment; names: of the moments.
        worst_px: residual that is drawn red.
    """

    cameras: dict[str, Camera]
    cams_from_world: Rigid3
    points3D: Points3D
    lines: np.ndarray
    worlds_from_board: Rigid3
    photos: tuple[tuple[BoardPhoto, ...], ...]
    names: tuple[str, ...]
    worst_px: float
    report: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "points3D", readonly(self.points3D, (None, 3)))


def log_boards(
    scene: BoardScene,
    read_photo: Callable[[str, str], ImageU8],
    *,
    save: Path | None = None,
    web: bool = False,
    spawn: bool = False,
    announce: Callable[[str], object] = lambda address: None,
) -> int:
    """Writes the scene, and shows it if asked, as `present_scene` does; returns its size in bytes.

    Args:
        read_photo: gives the photo of a camera by its name; one that it cannot give (`SfmError`) is left out.
    """
    log = partial(_log, scene, read_photo)
    return present_scene(log, partial(_blueprint, scene), save=save, web=web, spawn=spawn, announce=announce)


def grid_lines(columns: int, rows: int) -> np.ndarray:
    """(L, 2) neighbours among points that are numbered row by row."""
    number = np.arange(columns * rows).reshape(rows, columns)
    across = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], 1)
    down = np.stack([number[:-1].ravel(), number[1:].ravel()], 1)
    return np.concatenate([across, down])


def _log(scene: BoardScene, read_photo: Callable[[str, str], ImageU8], rr: Any, recording: Any) -> None:
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
    recording.log("report", rr.TextDocument(scene.report, media_type=rr.MediaType.MARKDOWN), static=True)
    reach = _reach(scene)
    for k, (name, camera) in enumerate(scene.cameras.items()):
        world_from_cam = scene.cams_from_world[k].inverse()
        w, x, y, z = world_from_cam.rotation.wxyz
        pose = rr.Transform3D(translation=world_from_cam.translation, quaternion=rr.Quaternion(xyzw=[x, y, z, w]))
        recording.log(f"cameras/{k}", pose, rr.AnyValues(name=name), static=True)
        recording.log(
            f"cameras/{k}/image",
            rr.Pinhole(
                focal_length=camera.focal_lengths, principal_point=camera.principal_point,
                resolution=[camera.width, camera.height], camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=0.3 * reach,
            ),
            static=True,
        )  # fmt: skip
    grids = [_grid(scene, v) for v in range(len(scene.names))]
    errors = np.array([_error(photos) for photos in scene.photos])
    colors = residual_colors(errors, scene.worst_px)
    strips = np.concatenate(grids) if grids else np.zeros((0, 2, 3))
    each = np.repeat(colors, [len(grid) for grid in grids], axis=0)
    recording.log("boards", rr.LineStrips3D(strips, colors=each, radii=rr.Radius.ui_points(0.6)), static=True)
    numbers = {name: k for k, name in enumerate(scene.cameras)}
    for v, photos in enumerate(scene.photos):
        recording.set_time("photo", sequence=v)
        recording.log("current/board", rr.LineStrips3D(grids[v], colors=[240, 120, 20], radii=rr.Radius.ui_points(2)))
        recording.log("current/name", rr.TextLog(f"{scene.names[v]}: {errors[v]:.3f} px"))
        seen = {photo.camera: photo for photo in photos}
        for name, k in numbers.items():
            if name in seen:
                _log_photo(rr, recording, f"current/{k}/image", seen[name], read_photo, scene.worst_px)
            else:
                recording.log(f"current/{k}/image", rr.Clear(recursive=True))


def _log_photo(
    rr: Any, recording: Any, entity: str, shown: BoardPhoto, read_photo: Callable[[str, str], ImageU8], worst_px: float
) -> None:
    scale = 1.0
    try:
        picture = read_photo(shown.camera, shown.photo)
        scale = min(1.0, _PHOTO_PX / max(picture.shape[:2]))
        recording.log(entity, as_jpeg(rr, cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)))
    except (SfmError, OSError):
        recording.log(entity, rr.Clear(recursive=False))
    lengths = np.hypot(*shown.residuals.T)
    points, colors = shown.points2D * scale, residual_colors(lengths, worst_px)
    ends = points + RESIDUALS_LONGER * scale * shown.residuals
    recording.log(f"{entity}/corners", rr.Points2D(points, colors=colors, radii=rr.Radius.ui_points(2.0)))
    recording.log(f"{entity}/residuals", rr.LineStrips2D(np.stack([points, ends], 1), colors=colors))


def _grid(scene: BoardScene, moment: int) -> np.ndarray:
    """(L, 2, 3) the lines of the board at a moment, in the world."""
    return (scene.worlds_from_board[moment] @ scene.points3D)[scene.lines]


def _error(photos: Sequence[BoardPhoto]) -> float:
    squares = np.concatenate([np.zeros(0), *(np.sum(photo.residuals**2, 1) for photo in photos)])
    return float(np.sqrt(np.mean(squares))) if len(squares) else 0.0


def _reach(scene: BoardScene) -> float:
    """Typical size of a board: frusta are drawn in proportion."""
    return float(np.linalg.norm(np.ptp(scene.points3D, axis=0)))


def _blueprint(scene: BoardScene, rrb: Any) -> Any:
    """The scene at the left, photos of the moment and the figures at the right, the timeline below."""
    photos = [
        rrb.Spatial2DView(origin=f"/current/{k}/image", name=name) for k, name in enumerate(list(scene.cameras)[:4])
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(
                origin="/", contents=["/cameras/**", "/boards", "/current/board"], name="boards and cameras"
            ),
            rrb.Vertical(*photos, rrb.TextLogView(origin="/current/name"), rrb.TextDocumentView(origin="/report")),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="photo", state="collapsed"),
        collapse_panels=True,
    )
