from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import ExitCode, ImageError, MissingDependencyError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Reconstruction, Tracks
from sfm.viz import rerun_log, rerun_viewer


def two_views() -> Reconstruction:
    """Two cameras beside each other that see 30 points, the last of them with a residual of 3 px in the first."""
    rng = np.random.default_rng(0)
    camera = Camera("SIMPLE_RADIAL", 320, 240, np.array([300.0, 160, 120, -0.05]))
    poses = Rigid3(Rotation3.identity((2,)), np.array([[0.0, 0, 0], [-0.5, 0, 0]]))
    points = np.c_[rng.uniform(-1, 1, (30, 2)), rng.uniform(4, 6, 30)]
    keypoints = np.concatenate([camera.project(poses[k] @ points)[0] for k in (0, 1)])
    keypoints[29] += [3, 0]
    return Reconstruction(
        cameras={1: camera},
        image_ids=np.array([3, 7], dtype=np.int32),
        image_names=("left/a b.jpg", "right/ü.jpg"),
        image_camera_ids=np.array([1, 1], dtype=np.int32),
        cams_from_world=poses,
        keypoint_offsets=np.array([0, 30, 60]),
        keypoints=keypoints,
        points3D=points,
        point_ids=np.arange(30),
        colors=rng.integers(0, 255, (30, 3)).astype(np.uint8),
        errors=np.full(30, 0.25),
        tracks=Tracks(np.arange(0, 61, 2), np.tile(np.int32([3, 7]), 30), np.repeat(np.arange(30, dtype=np.int32), 2)),
    )


def grey_photo(name: str) -> np.ndarray:
    return np.full((240, 320, 3), 90, np.uint8)


def rerun_program(path: Path) -> str:
    return rerun_viewer.viewer_command(path)[0]


def test_keypoints_are_coloured_by_residual() -> None:
    model = two_views()
    camera = Camera("PINHOLE", 320, 240, np.array([300.0, 300, 160, 120]))
    pixels, colors = rerun_log.observed_keypoints(model, 0, camera)
    assert len(pixels) == len(colors) == 30
    ideal, _ = camera.project(model.points3D)
    np.testing.assert_allclose(pixels[:29], ideal[:29], atol=1e-6)
    assert (colors[:29] == rerun_log.residual_colors(np.zeros(1))).all()
    assert (colors[29] == rerun_log.residual_colors(np.array([9.0]))[0]).all()


def test_residual_colours_go_from_blue_over_green_to_red() -> None:
    blue, green, red, beyond = rerun_log.residual_colors(np.array([0.0, 1.0, 2.0, np.inf])).astype(int)
    assert blue[2] > 200 > 100 > blue[0]
    assert green[1] > 200
    assert green[1] > max(green[0], green[2])
    assert red[0] > 200 > 100 > red[2]
    assert (beyond == red).all()


def test_summary_names_the_figures() -> None:
    text = rerun_log.summary_markdown(two_views())
    assert "2 images, 1 cameras" in text
    assert "30 points, 60 observations" in text
    assert "track length 2.00" in text
    assert "0.250 px" in text


def test_the_statistics_are_off_within_and_the_environment_is_as_before_afterwards(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    monkeypatch.delenv("CI", raising=False)
    with rerun_viewer._silent_environment():
        assert os.environ["CI"] == "1"
        assert "FORCE_RERUN_ANALYTICS" not in os.environ
    assert os.environ["FORCE_RERUN_ANALYTICS"] == "1"
    assert "CI" not in os.environ


def test_without_rerun_the_error_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'parallax\[viz\]'") as caught:
        rerun_log.log_reconstruction(two_views(), grey_photo, save=tmp_path / "scene.rrd")
    assert caught.value.exit_code == ExitCode.MISSING_DEPENDENCY
    assert list(tmp_path.iterdir()) == []


def test_importing_the_module_does_not_import_rerun() -> None:
    code = "import sys, sfm.viz.rerun_log; sys.exit('rerun' in sys.modules)"
    root = Path(rerun_log.__file__).parents[2]
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, "PYTHONPATH": str(root)})


def test_no_other_module_of_the_product_imports_rerun() -> None:
    root = Path(rerun_log.__file__).parents[2]
    importers = [
        path.name
        for package in ("sfm", "calib", "stereo")
        for path in (root / package).rglob("*.py")
        if any(line.strip().startswith(("import rerun", "from rerun")) for line in path.read_text().splitlines())
    ]
    assert importers == ["rerun_viewer.py"]


# What follows needs rerun itself.


def test_the_names_of_rerun_that_are_used_exist() -> None:
    rr = pytest.importorskip("rerun")
    rrb = pytest.importorskip("rerun.blueprint")
    parameters = {
        rr.RecordingStream: {"application_id", "send_properties"},
        rr.RecordingStream.save: {"path", "default_blueprint"},
        rr.RecordingStream.log: {"entity_path", "entity", "extra", "static"},
        rr.RecordingStream.set_time: {"timeline", "sequence"},
        rr.RecordingStream.flush: set(),
        rr.RecordingStream.disconnect: set(),
        rr.Points3D: {"positions", "colors", "radii"},
        rr.Points2D: {"positions", "colors", "radii"},
        rr.Transform3D: {"translation", "quaternion"},
        rr.Quaternion: {"xyzw"},
        rr.Pinhole: {"focal_length", "principal_point", "resolution", "camera_xyz", "image_plane_distance"},
        rr.EncodedImage: {"contents", "media_type"},
        rr.TextDocument: {"text", "media_type"},
        rr.TextLog: {"text"},
        rr.Radius.ui_points: set(),
        rrb.Blueprint: {"parts", "collapse_panels"},
        rrb.Horizontal: {"column_shares"},
        rrb.Vertical: {"row_shares"},
        rrb.Spatial3DView: {"origin", "contents", "name", "eye_controls"},
        rrb.Spatial2DView: {"origin", "name"},
        rrb.TextLogView: {"origin", "name"},
        rrb.TextDocumentView: {"origin", "name"},
        rrb.EyeControls3D: {"kind", "position", "look_target", "eye_up"},
        rrb.TimePanel: {"timeline", "state"},
    }
    for function, names in parameters.items():
        assert names <= set(inspect.signature(function).parameters), function
    for value in (
        rr.AnyValues,
        rr.MediaType.MARKDOWN,
        rr.ViewCoordinates.RDF,
        rr.ViewCoordinates.RIGHT_HAND_Y_DOWN,
        rrb.Eye3DKind.Orbital,
    ):
        assert value is not None


def test_the_viewer_is_bound_to_this_machine_alone() -> None:
    pytest.importorskip("rerun_cli")
    command = rerun_viewer.viewer_command(Path("scene.rrd"))
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert Path(command[0]).is_file()
    assert command[-1] == "scene.rrd"
    shown = subprocess.run([command[0], "--help"], capture_output=True, text=True, check=True, env={"CI": "1"}).stdout
    for option in ("--bind", "--port", "auto", "--serve-web", "--web-viewer-port"):
        assert option in shown


def test_a_scene_is_a_valid_file_with_all_entities(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    target = tmp_path / "scene.rrd"

    def read_image(name: str) -> np.ndarray:
        if "ü" in name:
            raise ImageError("gone", path=name)
        return grey_photo(name)

    size = rerun_log.log_reconstruction(two_views(), read_image, save=target)
    assert size == target.stat().st_size > 2000
    assert [path.name for path in tmp_path.iterdir()] == ["scene.rrd"]
    environment = {**os.environ, "CI": "1"}
    program = rerun_program(target)
    subprocess.run([program, "rrd", "verify", str(target)], check=True, capture_output=True, env=environment)
    stats = subprocess.run(
        [program, "rrd", "stats", str(target)], check=True, capture_output=True, text=True, env=environment
    ).stdout
    for entity in ("/world/points", "/world/cameras/3/image", "/world/cameras/7/image", "/current/image/keypoints"):
        assert f"{entity}:" in stats


def test_a_model_without_images_or_points_can_be_written(tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    model = Reconstruction(
        cameras={},
        image_ids=np.zeros(0, np.int32),
        image_names=(),
        image_camera_ids=np.zeros(0, np.int32),
        cams_from_world=Rigid3.identity((0,)),
        keypoint_offsets=np.zeros(1, np.int64),
        keypoints=np.zeros((0, 2)),
        points3D=np.zeros((0, 3)),
        point_ids=np.zeros(0, np.int64),
        colors=np.zeros((0, 3), np.uint8),
        errors=np.zeros(0),
        tracks=Tracks.empty(),
    )
    assert rerun_log.log_reconstruction(model, grey_photo, save=tmp_path / "empty.rrd") > 0
