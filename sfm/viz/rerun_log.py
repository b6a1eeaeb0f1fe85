"""A model as a Rerun scene.

    /                        view coordinates: x right, y down until a model is aligned; static
    world/points             coloured points; static
    world/cameras/<id>       pose, frustum and undistorted thumbnail of every image; static
    current                  one camera at a time on the timeline "image", with its picture and keypoints
    report                   a few lines about the model; static

What does not change is static, which keeps the number of chunks, and with it size and loading time, small.
File names are never entity paths; they are stored beside the frusta as `name`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sfm.core.arrays import ImageU8, Points2D
from sfm.core.cameras import Camera
from sfm.core.errors import SfmError
from sfm.core.scene import Reconstruction
from sfm.viz.figures import choose_view, default_frustum_size
from sfm.viz.rerun_viewer import as_jpeg, present_scene
from sfm.viz.thumbnails import thumbnail

MAX_POINTS = 200_000
"""More points than this make the file large and the viewer slow without showing more."""

_FRUSTUM_SIZE_PX, _CURRENT_SIZE_PX = 512, 1024

ReadImage = Callable[[str], ImageU8]


def log_reconstruction(
    reconstruction: Reconstruction,
    read_image: ReadImage,
    *,
    save: Path | None = None,
    web: bool = False,
    spawn: bool = False,
    announce: Callable[[str], object] = lambda address: None,
) -> int:
    """Writes the scene, and shows it if asked, as `present_scene` does; returns its size in bytes.

    Args:
        read_image: gives the photo of an image's name in the orientation of its pixels; a photo that it
            cannot give (`SfmError` or `OSError`) is left out.
    """

    def log(rr: Any, recording: Any) -> None:
        _log_model(rr, recording, reconstruction)
        for row in range(len(reconstruction.image_names)):
            _log_image(rr, recording, reconstruction, row, read_image)

    arranged = partial(_blueprint, reconstruction)
    return present_scene(log, arranged, save=save, web=web, spawn=spawn, announce=announce)


def _log_model(rr: Any, recording: Any, model: Reconstruction) -> None:
    """What does not belong to one image: axes, points, a few figures."""
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
    step = max(1, -(-len(model.points3D) // MAX_POINTS))
    shown = model.points3D[::step]
    recording.log(
        "world/points",
        rr.Points3D(shown.astype(np.float32), colors=model.colors[::step], radii=rr.Radius.ui_points(1.5)),
        static=True,
    )
    recording.log("report", rr.TextDocument(summary_markdown(model), media_type=rr.MediaType.MARKDOWN), static=True)


def summary_markdown(model: Reconstruction) -> str:
    """A few lines about the model."""
    points, observations = len(model.tracks), len(model.tracks.image_ids)
    known = model.errors[model.errors >= 0]
    lines = [
        f"- {len(model.image_names)} images, {len(model.cameras)} cameras",
        f"- {points} points, {observations} observations",
        f"- mean track length {observations / points:.2f}" if points else "- no points",
    ]
    if len(known):
        lines.append(f"- mean reprojection error {known.mean():.3f} px")
    return "\n".join(["# Model", "", *lines, ""])


def _log_image(rr: Any, recording: Any, model: Reconstruction, row: int, read_image: ReadImage) -> None:
    """The frusta of one image: its static one, and that of its moment on the timeline."""
    camera = model.cameras[int(model.image_camera_ids[row])]
    entity = f"world/cameras/{int(model.image_ids[row])}"
    pose = _transform(rr, model, row)
    photo = _photo(read_image, model.image_names[row])
    size = default_frustum_size(model)
    picture, small = _picture(photo, camera, _FRUSTUM_SIZE_PX)
    recording.log(entity, pose, rr.AnyValues(name=model.image_names[row]), static=True)
    recording.log(f"{entity}/image", _pinhole(rr, small, size), *_encoded(rr, picture), static=True)

    picture, small = _picture(photo, camera, _CURRENT_SIZE_PX)
    recording.set_time("image", sequence=row)
    recording.log("current", pose)
    recording.log("current/image", _pinhole(rr, small, 1.5 * size), *_encoded(rr, picture))
    pixels, colors = observed_keypoints(model, row, small)
    recording.log("current/image/keypoints", rr.Points2D(pixels, colors=colors, radii=rr.Radius.ui_points(1.5)))
    recording.log("current/name", rr.TextLog(model.image_names[row]))


def observed_keypoints(model: Reconstruction, row: int, target: Camera) -> tuple[Points2D, np.ndarray]:
    """Keypoints of an image that see a point, as pixels of `target`, and their colours from blue to red.

    The colour is the residual, projected − observed, in px of the photo: blue at 0, red from 2 px on.
    """
    camera = model.cameras[int(model.image_camera_ids[row])]
    seen = model.image_rows == row
    points = model.cams_from_world[row] @ model.points3D[model.tracks.track_ids[seen]]
    observed = model.observations[seen]
    projected, in_front = camera.project(points)
    residuals = np.where(in_front, np.linalg.norm(projected - observed, axis=1), np.inf)
    rays, has_ray = camera.unproject(observed)
    pixels, inside = target.project(rays)
    shown = has_ray & inside
    return pixels[shown], residual_colors(residuals[shown])


def residual_colors(residuals_px: np.ndarray, worst_px: float = 2.0) -> np.ndarray:
    """RGB (N, 3) from blue at 0 over green to red at `worst_px` and beyond."""
    share = np.clip(residuals_px / worst_px, 0, 1)
    hue = np.stack([2 * share - 0.5, 1.3 - 2 * np.abs(share - 0.5), 1.5 - 3 * share], axis=1)
    return (255 * np.clip(hue, 0, 1)).astype(np.uint8)


def _photo(read_image: ReadImage, name: str) -> ImageU8 | None:
    try:
        return read_image(name)
    except (SfmError, OSError):
        return None


def _picture(photo: ImageU8 | None, camera: Camera, size_px: int) -> tuple[ImageU8 | None, Camera]:
    """The undistorted thumbnail and its camera; without a photo the camera alone."""
    if photo is None:
        return None, thumbnail(np.zeros((camera.height, camera.width), np.uint8), camera, max_size=size_px)[1]
    return thumbnail(photo, camera, max_size=size_px)


def _transform(rr: Any, model: Reconstruction, row: int) -> Any:
    world_from_cam = model.cams_from_world[row].inverse()
    w, x, y, z = world_from_cam.rotation.wxyz
    return rr.Transform3D(translation=world_from_cam.translation, quaternion=rr.Quaternion(xyzw=[x, y, z, w]))


def _pinhole(rr: Any, camera: Camera, image_plane_distance: float) -> Any:
    return rr.Pinhole(
        focal_length=camera.focal_lengths,
        principal_point=camera.principal_point,
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=image_plane_distance,
    )


def _encoded(rr: Any, picture: ImageU8 | None) -> list[Any]:
    """The picture in a list; an empty one without a picture."""
    return [] if picture is None else [as_jpeg(rr, picture)]


def _blueprint(model: Reconstruction, rrb: Any) -> Any:
    """The scene large on the left, the current image and the figures beside it, the timeline below."""
    eye = None
    if len(model.image_names):
        view = choose_view(model)
        eye = rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=view.position, look_target=view.target, eye_up=view.up
        )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/", contents=["/world/**", "/current/**"], name="model", eye_controls=eye),
            rrb.Vertical(
                rrb.Spatial2DView(origin="/current/image", name="current image"),
                rrb.TextLogView(origin="/current/name", name="name"),
                rrb.TextDocumentView(origin="/report", name="figures"),
                row_shares=[4, 1, 1],
            ),
            column_shares=[2, 1],
        ),
        rrb.TimePanel(timeline="image", state="collapsed"),
        collapse_panels=True,
    )
