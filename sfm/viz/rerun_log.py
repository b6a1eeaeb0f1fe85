"""A model as a Rerun scene: the only module that imports rerun.

    /                        view coordinates: x right, y down until a model is aligned; static
    world/points             coloured points; static
    world/cameras/<id>       pose, frustum and undistorted thumbnail of every image; static
    current                  one camera at a time on the timeline "image", with its picture and keypoints
    report                   a few lines about the model; static

What does not change is static, which keeps the number of chunks, and with it size and loading time, small.
File names are never entity paths; they are stored beside the frusta as `name`.

Rerun's SDK serves on all interfaces, and its viewer counts events for its makers unless told otherwise. Here a scene
is always written to a file first, and the viewer is started on that file with `--bind 127.0.0.1`. The statistics
are switched off by the environment: both the SDK and the viewer stay silent if `CI` is set and
`FORCE_RERUN_ANALYTICS` is not (found in 0.41; there is no other switch but a file in the user's home). The web
viewer has no switch and is served by ourselves (see `web_viewer`).
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import subprocess
import sys
import tempfile
import webbrowser
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from sfm.core.arrays import ImageU8, Points2D
from sfm.core.cameras import Camera
from sfm.core.errors import MissingDependencyError, SfmError
from sfm.core.scene import Reconstruction
from sfm.viz.figures import choose_view, default_frustum_size
from sfm.viz.thumbnails import thumbnail
from sfm.viz.web_viewer import LOOPBACK, scene_server, viewer_files

if TYPE_CHECKING:
    import rerun as rr

APPLICATION = "parallax"
MAX_POINTS = 200_000
"""More points than this make the file large and the viewer slow without showing more."""

_FRUSTUM_SIZE_PX, _CURRENT_SIZE_PX, _JPEG_QUALITY = 512, 1024, 80

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
    """Writes the scene, and shows it if asked; returns when the viewer is closed.

    Args:
        read_image: gives the photo of an image's name in the orientation of its pixels; a photo that it
            cannot give (`SfmError` or `OSError`) is left out.
        save: file to keep the scene in, replaced if it is there; with none, it lives as long as the viewer.
        web: in the browser, from a server on this machine that nothing else can reach.
        spawn: in Rerun's own window.
        announce: is told the address of the page where `web` is to be seen.
    Returns:
        Size of the scene in bytes.
    Raises:
        MissingDependencyError: rerun is not installed.
        SfmError: the viewer cannot be started.
    """
    with contextlib.ExitStack() as cleanup:
        if save is None:
            folder = cleanup.enter_context(tempfile.TemporaryDirectory(prefix="parallax_view_"))
            save = Path(folder) / "scene.rrd"
        write_scene(reconstruction, read_image, save)
        size = save.stat().st_size
        if web or spawn:
            show_scene(save, web=web, announce=announce)
    return size


def write_scene(reconstruction: Reconstruction, read_image: ReadImage, path: Path) -> None:
    """Writes the scene to an .rrd file, in one step as far as anyone who looks at `path` can tell."""
    with _silent_environment():
        rr = _rerun()
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.partial")
        recording = rr.RecordingStream(APPLICATION, send_properties=True)
        try:
            recording.save(partial, default_blueprint=_blueprint(reconstruction))
            _log_model(rr, recording, reconstruction)
            for row in range(len(reconstruction.image_names)):
                _log_image(rr, recording, reconstruction, row, read_image)
            recording.disconnect()
            os.replace(partial, path)
        finally:
            recording.disconnect()
            partial.unlink(missing_ok=True)


def show_scene(path: Path, *, web: bool, announce: Callable[[str], object] = lambda address: None) -> None:
    """Runs the viewer on a scene until it is closed or the user interrupts.

    Args:
        announce: is told the address of the page, if `web`.
    Raises:
        MissingDependencyError: rerun is not installed.
        SfmError: the viewer ended with an error, for instance because there is no display.
    """
    with _silent_environment(), contextlib.suppress(KeyboardInterrupt):
        if web:
            _serve(path, announce)
        else:
            _run_viewer(viewer_command(path))


def _serve(path: Path, announce: Callable[[str], object]) -> None:
    with scene_server(path, viewer_files(_launcher())) as (server, address):
        announce(address)
        webbrowser.open(address)
        server.serve_forever()


def _run_viewer(command: list[str]) -> None:
    viewer = subprocess.Popen(command)
    try:
        code = viewer.wait()
    except BaseException:
        viewer.terminate()
        viewer.wait()
        raise
    if code != 0:
        raise SfmError(
            f"Rerun's viewer ended with exit code {code}",
            remedy="without a display, use --web or keep the scene with --save and open it elsewhere",
        )


def viewer_command(path: Path) -> list[str]:
    """The command line of Rerun's own window, bound to this machine alone."""
    return [*_launcher(), "--bind", LOOPBACK, "--port", "auto", str(path)]


def _launcher() -> list[str]:
    """The program that rerun-sdk carries; not its wrapper in Python, which would outlive a signal."""
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise _missing()
    folder = Path(spec.origin).parent
    programs = [folder / "Rerun.app/Contents/MacOS/Rerun", folder / "rerun.exe", folder / "rerun"]
    program = next((program for program in programs if program.is_file()), None)
    return [str(program)] if program else [sys.executable, "-m", "rerun_cli"]


@contextlib.contextmanager
def _silent_environment() -> Iterator[None]:
    """Rerun's statistics are off within, here and in programs started from here."""
    names = ("CI", "FORCE_RERUN_ANALYTICS")
    before = {name: os.environ.get(name) for name in names}
    os.environ["CI"] = "1"
    os.environ.pop("FORCE_RERUN_ANALYTICS", None)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise _missing() from error
    return rerun


def _missing() -> MissingDependencyError:
    return MissingDependencyError("the viewer needs rerun-sdk", remedy="pip install 'parallax[viz]'")


def _log_model(rr: Any, recording: rr.RecordingStream, model: Reconstruction) -> None:
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


def _log_image(rr: Any, recording: rr.RecordingStream, model: Reconstruction, row: int, read_image: ReadImage) -> None:
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
    """The picture as JPEG, in a list; an empty one without a picture."""
    if picture is None:
        return []
    bgr = picture[..., ::-1] if picture.ndim == 3 else picture
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return [rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")]


def _blueprint(model: Reconstruction) -> Any:
    """The scene large on the left, the current image and the figures beside it, the timeline below."""
    import rerun.blueprint as rrb

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
