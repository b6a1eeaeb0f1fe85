"""`calib report` and `calib view` of a rig: made again from its file, drawn where it stands, and told as it is."""

from __future__ import annotations

import dataclasses
import html
import json
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from calib import report_rig_figures as figures
from calib import report_svg as svg
from calib.boards import chessboard
from calib.cli import main
from calib.cli.photos import detection_json
from calib.cli.rig_again import RigAgain, rig_again, sources_of
from calib.cli.rig_page import place_sigmas, rig_page, turn_sigmas, worst_rig_views
from calib.cli.rigging import lens_of
from calib.cli.scenes import rig_scene
from calib.detect import Detection
from calib.rig_epipolar import distances_of_partners, epipolar_errors
from calib.rig_uncertainty import RigCovariance, relative_uncertainty, rig_covariance
from sfm.core.cameras import Camera
from sfm.core.errors import ConfigError, ExitCode
from sfm.core.events import SILENT, Note
from sfm.core.geometry.rigid import Rigid3
from sfm.io.camera_files import write_camera_toml
from sfm.io.rig_files import read_rig_file
from tests.calib.boards_in_space import LENS
from tests.calib.rigs_in_space import THREE, photographed, poses_before_rig

BOARD = chessboard(9, 6, 0.03)
NAMES = ("cam0", "cam1", "cam2")


def write_rig_corners(folder: Path, seed: int) -> None:
    """cam0.json … as `calib detect -o` writes them, of twelve frames; frame 3 only the first camera saw."""
    rng = np.random.default_rng(seed)
    points = BOARD.points3D - BOARD.points3D.mean(axis=0)
    for one in photographed(*THREE, points, poses_before_rig(12, rng), rng):
        images = {}
        for frame, view in zip(one.frames, one.views, strict=True):
            if frame != "03" or one.name == "cam0":
                even = np.tile(0.01 * np.eye(2), (len(view.corner_ids), 1, 1))
                found = Detection(f"{frame}.png", view.width, view.height, view.corner_ids, view.points2D, even)
                images[f"{frame}.png"] = detection_json(found)
        told = {"board": BOARD.spec, "points3D": BOARD.points3D.tolist(), "pixel_center": 0.5, "images": images}
        folder.mkdir(exist_ok=True)
        (folder / f"{one.name}.json").write_text(json.dumps(told))


def words_for(folder: Path) -> list[str]:
    return [f"{name}={folder / name}.json" for name in NAMES]


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory) -> Path:
    """Corners of three cameras, the last of them a fisheye and the first given, and their rig file."""
    folder = tmp_path_factory.mktemp("rig")
    write_rig_corners(folder, 4)
    write_rig_corners(folder / "other", 5)
    write_camera_toml(folder / "first.toml", LENS)
    words = ["--board", BOARD.spec, "--shape", "flat", "--model", "opencv,cam2=fisheye"]
    words += ["--camera", f"cam0={folder / 'first.toml'}", "-o", str(folder / "rig.toml")]
    assert main(["rig", *words_for(folder), *words]) == ExitCode.OK
    return folder


@pytest.fixture(scope="module")
def made(calibrated) -> RigAgain:
    return rig_again(calibrated / "rig.toml", words_for(calibrated), "", threads=1, observer=SILENT)


@pytest.fixture(scope="module")
def covariances(made) -> RigCovariance:
    found = rig_covariance(made.found)
    assert isinstance(found, RigCovariance)
    return found


def parts(drawing: str, name: str) -> list[ET.Element]:
    return list(ET.fromstring(drawing).iter("{http://www.w3.org/2000/svg}" + name))


def test_a_rig_made_again_is_that_of_its_file(calibrated):
    notes = []
    words = words_for(calibrated)[::-1]  # names count, not the order
    made = rig_again(calibrated / "rig.toml", words, "", threads=1, observer=notes.append)
    file = read_rig_file(calibrated / "rig.toml")
    assert not [event for event in notes if isinstance(event, Note)]
    np.testing.assert_array_equal(made.found.cameras[0].params, LENS.params)
    assert made.found.alone[2].calibration is not None
    assert made.found.alone[2].calibration.lens == "fisheye"
    for mine, theirs in zip(made.found.cameras, file.rig.cameras, strict=True):
        np.testing.assert_allclose(mine.params, theirs.params, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(made.found.cams_from_rig.matrix, file.rig.cams_from_rig.matrix, atol=1e-9)


def test_photos_of_another_rig_are_noted(calibrated):
    notes = []
    rig_again(calibrated / "rig.toml", words_for(calibrated / "other"), "", threads=1, observer=notes.append)
    (told,) = [event.message for event in notes if isinstance(event, Note)]
    assert "another rig" in told
    assert re.search(r"cam\d differs by [\d.e-]+ px", told)


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["right", "left"], {"left": "left", "right": "right"}),
        (["a/one", "a/two"], {"left": "a/one", "right": "a/two"}),
        (["right=x", "left=y"], {"left": "y", "right": "x"}),
        (["p/left*.jpg", "p/right*.jpg"], {"left": "p/left*.jpg", "right": "p/right*.jpg"}),
    ],
)
def test_folders_go_to_the_cameras_that_they_are_called_by(words, found):
    assert sources_of(words, ("left", "right"), Path("rig.toml")) == found


@pytest.mark.parametrize("words", [["left"], ["a", "b", "c"], ["left", "b"], ["a=left", "b=right"]])
def test_folders_of_other_cameras_are_a_mistake_that_names_what_is_needed(words):
    with pytest.raises(ConfigError, match="has the cameras left, right") as caught:
        sources_of(words, ("left", "right"), Path("rig.toml"))
    assert "left=DIR right=DIR" in str(caught.value)


def test_one_folder_with_a_folder_for_each_camera_will_do(tmp_path):
    for name in NAMES:
        (tmp_path / name).mkdir()
    assert sources_of([str(tmp_path)], NAMES, Path("rig.toml")) == {name: str(tmp_path / name) for name in NAMES}


@pytest.mark.parametrize(
    ("model", "params", "lens"),
    [
        ("OPENCV", [500, 500, 320, 240, 0.1, 0, 0, 0], "opencv4"),
        ("FULL_OPENCV", [500, 500, 320, 240, 0.1, 0, 0, 0, 0.1, 0, 0, 0], "opencv5"),
        ("FULL_OPENCV", [500, 500, 320, 240, 0.1, 0, 0, 0, 0.1, 0, 0.2, 0], "opencv8"),
        ("EUCM", [500, 500, 320, 240, 0.5, 1.2], "division"),
        ("EUCM", [500, 500, 320, 240, 0.6, 1.2], "eucm"),
    ],
)
def test_the_lens_of_a_camera_is_the_leanest_that_it_may_have_come_from(model, params, lens):
    assert lens_of(Camera(model, 640, 480, np.array(params, np.float64))) == lens


def test_every_view_has_a_cell_and_missing_ones_have_none(made):
    cells = [cell for cell in parts(figures.frames_figure(made.found), "rect") if len(cell)]
    assert len(cells) == sum(len(one.names) for one in made.found.observations.cameras)
    told = sorted(float(cell[0].text.split()[0]) for cell in cells)
    errors = np.concatenate([made.found.one_camera(c).view_rms_px for c in range(3)])
    np.testing.assert_allclose(told, np.sort(errors), rtol=6e-3)


def test_distances_are_those_from_the_curve_of_all_depths(made):
    found = made.found
    pixels, apart = distances_of_partners(found, 0, 2)
    motion = found.cams_from_rig[2] @ found.cams_from_rig[0].inverse()
    keys = [found.observations.frame_of[c][(o := found.observations.cameras[c]).view_of] * 100 + o.rows for c in (0, 2)]
    _, at, _ = np.intersect1d(*keys, return_indices=True)
    assert len(at) == len(pixels)
    for n in range(0, len(at), 29):
        ray, _ = found.cameras[0].unproject(found.observations.cameras[0].points2D[at[n : n + 1]])
        depths = np.geomspace(0.3, 2.0, 4001)[:, None]
        curve, _ = found.cameras[2].project(motion @ (depths * ray))
        nearest = np.min(np.linalg.norm(curve - pixels[n], axis=1))
        assert abs(apart[n]) == pytest.approx(nearest, abs=0.02)


def test_lines_are_drawn_for_every_pair_with_their_corners(made):
    drawing = figures.epipolar_figure(made.found, 0, 1)
    _, apart = distances_of_partners(made.found, 0, 1)
    errors = epipolar_errors(made.found, 0, 1)
    assert errors is not None
    assert len(parts(drawing, "circle")) == errors.corners == len(apart)
    assert f"{np.sqrt(np.mean(apart**2)):.3f} px (rms)" in drawing


@pytest.mark.parametrize(("side", "axes"), [("above", (0, 2)), ("the right", (2, 1))])
def test_cameras_are_drawn_where_they_stand(made, side, axes):
    drawing = figures.rig_figure(made.found, side)
    # Three lines from apex to end, end to end, end to apex: the apex is where the first one ends.
    lines = [line for line in parts(drawing, "line") if line.get("stroke") != svg.PALE]
    apexes = np.array([[float(line.get("x2")), float(line.get("y2"))] for line in lines[::3]])
    centers = made.found.cams_from_rig.center[:, list(axes)]
    if side == "above":
        centers = centers * [1, -1]
    drawn, true = apexes - apexes[0], centers - centers[0]
    scale = np.linalg.norm(drawn) / np.linalg.norm(true)
    np.testing.assert_allclose(drawn, scale * true, atol=0.2)


def test_boards_are_drawn_once_for_each_frame(made):
    lines = parts(figures.boards_figure(made.found, "above"), "line")
    assert len(lines) == 4 * 12 + 3 * 3
    assert sum(line.get("stroke") == svg.PALE for line in lines) == 4


def test_a_camera_of_more_than_180_degrees_and_one_place_for_all_can_be_drawn(made):
    wide = Camera("OPENCV_FISHEYE", 640, 480, np.array([150.0, 150, 320, 240, 0, 0, 0, 0]))
    odd = dataclasses.replace(made.found, cameras=(wide,) * 3, cams_from_rig=Rigid3.identity((3,)))
    for side in ("above", "the right"):
        root = ET.fromstring(figures.rig_figure(odd, side))
        assert all(np.isfinite(float(line.get("x1"))) for line in root.iter("{http://www.w3.org/2000/svg}line"))


def test_sigmas_of_places_and_turns_are_those_of_drawn_poses(made, covariances, rng):
    known = relative_uncertainty(made.found, covariances, 0, 2)
    pose, deltas = known.cam2_from_cam1, rng.multivariate_normal(np.zeros(6), known.covariance, 4000)
    drawn = [Rigid3.exp(delta) @ pose for delta in deltas]
    np.testing.assert_allclose(place_sigmas(known), np.std([one.center for one in drawn], axis=0), rtol=0.06)
    back = pose.rotation.inverse()
    turns = np.array([(one.rotation.inverse() @ back.inverse()).log() for one in drawn])
    np.testing.assert_allclose(turn_sigmas(known), turns.std(axis=0), rtol=0.06)


def test_the_page_tells_baselines_with_both_sigmas_and_asks_nothing_of_the_network(made, covariances):
    page = rig_page("<rig>", made)
    assert set(re.findall(r"https?://[^\"' )]+", page)) == {"http://www.w3.org/2000/svg"}
    assert "<rig>" not in page
    by_frame = rig_covariance(made.found, by_frame=True)
    assert isinstance(by_frame, RigCovariance)
    text = html.unescape(re.sub(r"<[^>]+>", " ", page))
    for i, j in ((0, 1), (0, 2), (1, 2)):
        one, two = (relative_uncertainty(made.found, given, i, j) for given in (covariances, by_frame))
        told = f"cam{i} → cam{j} +{1e3 * one.baseline:.3f} mm +± {1e3 * one.sigma_baseline:.3f} +"
        assert re.search(f"{told}± {1e3 * two.sigma_baseline:.3f}", text)
    assert f"{made.found.rms_px:.4f} px" in text
    assert text.count("held") > 8  # the eight parameters of the camera that was given
    assert page.count("<svg") == 2 + 3 + 1 + 2 + 6 + 1  # rig, pairs, frames, boards, cameras, shape


def test_what_another_shape_would_bring_stands_on_the_page(made):
    facts = {**made.file.provenance, "would_bring": "a free board would bring <more>"}
    page = rig_page("rig", dataclasses.replace(made, file=dataclasses.replace(made.file, provenance=facts)))
    assert "<p>A free board would bring &lt;more&gt;.</p>" in page


def test_the_worst_photos_are_shown_where_they_can_be_read(made):
    views = worst_rig_views(made.found)
    errors = [made.found.one_camera(c).view_rms_px.max() for c in range(3)]
    camera, name = views[0]
    c = NAMES.index(camera)
    assert made.found.one_camera(c).view_rms_px[made.found.observations.cameras[c].names.index(name)] == max(errors)
    grey = np.full((960, 1280), 120, np.uint8)
    assert rig_page("rig", made).count("data:image/jpeg") == 0
    assert rig_page("rig", made, photos={views[0]: grey}).count("data:image/jpeg") == 1


def test_the_scene_has_cameras_and_boards_where_the_calibration_has_them(made):
    scene, found = rig_scene("rig", made), made.found
    assert list(scene.cameras) == list(NAMES)
    assert sum(map(len, scene.photos)) == sum(len(one.names) for one in found.observations.cameras)
    for v, photos in enumerate(scene.photos):
        for photo in photos:
            c = NAMES.index(photo.camera)
            o = found.observations.cameras[c]
            rows = o.rows[o.view_of == o.names.index(photo.photo)]
            corners = scene.cams_from_world[c] @ (scene.worlds_from_board[v] @ scene.points3D[rows])
            projected, _ = scene.cameras[photo.camera].project(corners)
            np.testing.assert_allclose(projected - photo.points2D, photo.residuals, atol=1e-9)


def test_commands_take_a_rig_as_they_take_a_camera(calibrated, capsys):
    page = calibrated / "rig.html"
    assert main(["report", str(calibrated / "rig.toml"), *words_for(calibrated), "-o", str(page)]) == ExitCode.OK
    assert capsys.readouterr().out.strip() == str(page)
    assert "How the cameras stand" in page.read_text()
    pytest.importorskip("rerun")
    scene = calibrated / "rig.rrd"
    assert main(["view", str(calibrated / "rig.toml"), *words_for(calibrated), "--save", str(scene)]) == ExitCode.OK
    assert scene.stat().st_size > 5000


def test_a_range_is_refused_for_a_rig(calibrated, capsys):
    words = [str(calibrated / "rig.toml"), *words_for(calibrated), "--range", "2", "-o", str(calibrated / "r.html")]
    assert main(["report", *words]) == ExitCode.USAGE
    assert "--range is for one camera" in capsys.readouterr().err
