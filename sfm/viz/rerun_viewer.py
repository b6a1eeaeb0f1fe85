"""Recordings and Rerun's viewer, of which nothing leaves this machine: the only module that imports rerun.

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

from sfm.core.arrays import ImageU8
from sfm.core.errors import MissingDependencyError, SfmError
from sfm.viz.web_viewer import LOOPBACK, scene_server, viewer_files

if TYPE_CHECKING:
    import rerun as rr

APPLICATION = "parallax"
_JPEG_QUALITY = 80

LogScene = Callable[[Any, "rr.RecordingStream"], None]
"""Is given the module and the recording to log to."""


def present_scene(
    log: LogScene,
    blueprint: Callable[[Any], Any],
    *,
    save: Path | None = None,
    web: bool = False,
    spawn: bool = False,
    announce: Callable[[str], object] = lambda address: None,
) -> int:
    """Writes a scene, and shows it if asked; returns when the viewer is closed.

    Args:
        blueprint: makes the arrangement of views, from `rerun.blueprint`.
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
        save_scene(log, blueprint, save)
        size = save.stat().st_size
        if web or spawn:
            show_scene(save, web=web, announce=announce)
    return size


def save_scene(log: LogScene, blueprint: Callable[[Any], Any], path: Path) -> None:
    """Writes a scene to an .rrd file, in one step as far as anyone who looks at `path` can tell."""
    with _silent_environment():
        rr, rrb = _rerun()
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.partial")
        recording = rr.RecordingStream(APPLICATION, send_properties=True)
        try:
            recording.save(partial, default_blueprint=blueprint(rrb))
            log(rr, recording)
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


def _rerun() -> tuple[Any, Any]:
    try:
        import rerun
        import rerun.blueprint
    except ImportError as error:
        raise _missing() from error
    return rerun, rerun.blueprint


def _missing() -> MissingDependencyError:
    return MissingDependencyError("the viewer needs rerun-sdk", remedy="pip install 'parallax[viz]'")


def as_jpeg(rr: Any, picture: ImageU8) -> Any:
    """A grey or RGB picture as Rerun's encoded image."""
    bgr = picture[..., ::-1] if picture.ndim == 3 else picture
    _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")
