from __future__ import annotations

import contextlib
import dataclasses
import os
from itertools import chain
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import FormatError, InputError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import Frame, Reconstruction, Rig, Tracks
from sfm.io.colmap_model import model_format, read_model, write_model

BINARY = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")


def assert_pycolmap_agrees(theirs: pycolmap.Reconstruction, ours: Reconstruction, *, names: bool = True) -> None:
    assert sorted(theirs.cameras) == list(ours.cameras)
    for camera_id, camera in ours.cameras.items():
        other = theirs.cameras[camera_id]
        assert (other.model_name, other.width, other.height) == (camera.model, camera.width, camera.height)
        np.testing.assert_array_equal(other.params, camera.params)
    assert sorted(theirs.images) == ours.image_ids.tolist()
    for row, image_id in enumerate(ours.image_ids.tolist()):
        image = theirs.images[image_id]
        assert image.name == ours.image_names[row] or not names
        assert image.camera_id == ours.image_camera_ids[row]
        pose = image.cam_from_world()
        np.testing.assert_allclose(pose.matrix(), ours.cams_from_world[row].matrix, atol=1e-13)
        keypoints = ours.keypoints[ours.keypoint_offsets[row] : ours.keypoint_offsets[row + 1]]
        np.testing.assert_array_equal(np.array([p.xy for p in image.points2D]).reshape(-1, 2), keypoints)
    assert sorted(theirs.points3D) == sorted(ours.point_ids.tolist())
    for p, point_id in enumerate(ours.point_ids.tolist()):
        point = theirs.points3D[point_id]
        np.testing.assert_array_equal(point.xyz, ours.points3D[p])
        np.testing.assert_array_equal(point.color, ours.colors[p])
        assert point.error == ours.errors[p]
        track = slice(ours.tracks.offsets[p], ours.tracks.offsets[p + 1])
        expected = zip(ours.tracks.image_ids[track], ours.tracks.feature_ids[track], strict=True)
        assert [(e.image_id, e.point2D_idx) for e in point.track.elements] == [(int(i), int(f)) for i, f in expected]


@pytest.mark.parametrize("text", [False, True])
def test_a_model_reads_back_as_it_was_written(tmp_path, make_reconstruction, assert_same_model, text: bool) -> None:
    model = make_reconstruction()
    write_model(model, tmp_path / "model", text=text)
    assert_same_model(read_model(tmp_path / "model"), model)
    assert model_format(tmp_path / "model") == ("txt" if text else "bin")


@pytest.mark.parametrize("text", [False, True])
def test_pycolmap_opens_what_we_write(tmp_path, make_reconstruction, text: bool) -> None:
    model = make_reconstruction(images=7)
    write_model(model, tmp_path, text=text)
    # pycolmap reads a name in a text model only up to the first space.
    assert_pycolmap_agrees(pycolmap.Reconstruction(tmp_path), model, names=not text)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_we_open_what_pycolmap_writes_with_its_rigs(rig_model: Path, kind: str) -> None:
    ours, theirs = read_model(rig_model / kind), pycolmap.Reconstruction(rig_model / "bin")
    assert_pycolmap_agrees(theirs, ours)
    assert [rig.rig_id for rig in ours.rigs] == sorted(theirs.rigs)
    assert [frame.frame_id for frame in ours.frames] == sorted(theirs.frames)
    for rig in ours.rigs:
        other = theirs.rigs[rig.rig_id]
        assert rig.ref_camera_id == other.ref_sensor_id.id
        for sensor, pose in other.non_ref_sensors.items():
            np.testing.assert_allclose(rig.sensors_from_rig[sensor.id].matrix, pose.matrix(), atol=1e-13)
    for frame in ours.frames:
        assert len(frame.image_ids) == 2
        assert set(frame.image_ids.values()) == {d.id for d in theirs.frames[frame.frame_id].data_ids}


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_a_rig_model_of_pycolmap_is_written_back_byte_by_byte(tmp_path: Path, rig_model: Path, kind: str) -> None:
    write_model(read_model(rig_model / kind), tmp_path)
    for name in BINARY:
        assert (tmp_path / name).read_bytes() == (rig_model / "bin" / name).read_bytes(), name


def test_pycolmap_opens_the_rigs_that_we_write_as_text(tmp_path: Path, rig_model: Path) -> None:
    model = read_model(rig_model / "bin")
    write_model(model, tmp_path, text=True)
    theirs = pycolmap.Reconstruction(tmp_path)
    assert_pycolmap_agrees(theirs, model)
    assert theirs.num_rigs() == 2
    assert theirs.num_frames() == 6


@pytest.mark.parametrize("text", [False, True])
def test_a_rig_whose_poses_are_unknown_survives(tmp_path, make_reconstruction, text: bool) -> None:
    model = make_reconstruction(images=1)
    camera_ids = list(model.cameras)
    reference = int(model.image_camera_ids[0])
    others = dict.fromkeys([c for c in camera_ids if c != reference][:2])
    frame = Frame(7, 3, model.cams_from_world[0], {reference: int(model.image_ids[0])})
    model = dataclasses.replace(model, rigs=(Rig(3, reference, others),), frames=(frame,))
    write_model(model, tmp_path, text=text)
    again = read_model(tmp_path)
    assert dict(again.rigs[0].sensors_from_rig) == others
    assert again.frames[0].frame_id == 7


def test_trivial_rigs_and_frames_read_as_none(tmp_path, make_reconstruction) -> None:
    write_model(make_reconstruction(), tmp_path)
    again = read_model(tmp_path)
    assert again.rigs == ()
    assert again.frames == ()


@pytest.mark.parametrize("text", [False, True])
def test_a_model_of_an_older_program_has_no_rigs(tmp_path, make_reconstruction, assert_same_model, text) -> None:
    model = make_reconstruction()
    write_model(model, tmp_path, text=text)
    for name in ("rigs", "frames"):
        (tmp_path / f"{name}.{'txt' if text else 'bin'}").unlink()
    assert_same_model(read_model(tmp_path), model)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("images", [0, 3])
def test_models_without_points_or_images(tmp_path, make_reconstruction, assert_same_model, images, text) -> None:
    model = make_reconstruction(0, images=images)
    write_model(model, tmp_path, text=text)
    assert_same_model(read_model(tmp_path), model)
    theirs = pycolmap.Reconstruction(tmp_path)
    assert (theirs.num_images(), theirs.num_points3D()) == (images, 0)


def test_the_same_model_gives_the_same_bytes_whatever_the_order_of_its_dicts(tmp_path, make_reconstruction) -> None:
    model = make_reconstruction()
    shuffled = dataclasses.replace(model, cameras=dict(reversed(model.cameras.items())))
    for text in (False, True):
        write_model(model, tmp_path / "a", text=text)
        write_model(shuffled, tmp_path / "b", text=text)
        for name in os.listdir(tmp_path / "a"):
            assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_images_in_any_order_are_sorted_by_id(tmp_path, make_reconstruction, assert_same_model) -> None:
    model = make_reconstruction()
    write_model(model, tmp_path, text=True)
    lines = (tmp_path / "images.txt").read_text().splitlines()
    header, body = lines[:2], lines[2:]
    pairs = [body[k : k + 2] for k in range(0, len(body), 2)]
    (tmp_path / "images.txt").write_text("\n".join([*header, *chain(*reversed(pairs)), ""]))
    assert_same_model(read_model(tmp_path), model)


def test_a_folder_holds_one_model_after_writing(tmp_path, make_reconstruction, assert_same_model) -> None:
    (tmp_path / "project.ini").write_text("the user's own")
    write_model(make_reconstruction(seed=1), tmp_path)
    model = make_reconstruction(seed=2)
    write_model(model, tmp_path, text=True)
    assert sorted(os.listdir(tmp_path)) == sorted([*(name.replace("bin", "txt") for name in BINARY), "project.ini"])
    assert_same_model(read_model(tmp_path), model)


def test_a_folder_without_a_model_is_an_input_error(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "missing"):
        with pytest.raises(InputError, match="no COLMAP model") as error:
            read_model(folder)
        assert "sparse/0" in str(error.value)


@pytest.mark.parametrize("name", BINARY)
def test_a_binary_file_cut_anywhere_is_a_format_error(tmp_path, make_reconstruction, rig_model, name: str) -> None:
    write_model(read_model(rig_model / "bin"), tmp_path)
    whole = (tmp_path / name).read_bytes()
    cuts = {*range(40), *np.linspace(40, len(whole) - 1, 40).astype(int).tolist()}
    for cut in sorted(cuts):
        (tmp_path / name).write_bytes(whole[:cut])
        with pytest.raises(FormatError) as error:
            read_model(tmp_path)
        assert name in str(error.value)


@pytest.mark.parametrize("name", BINARY)
def test_garbage_is_a_format_error(tmp_path, make_reconstruction, rng, name: str) -> None:
    write_model(make_reconstruction(), tmp_path)
    whole = (tmp_path / name).read_bytes()
    for garbage in (b"", b"# a text file\n" * 20, rng.bytes(500), b"\xff" * 300, whole + b"\0"):
        (tmp_path / name).write_bytes(garbage)
        with pytest.raises(FormatError) as error:
            read_model(tmp_path)
        assert name in str(error.value)


def test_flipped_bytes_never_crash(tmp_path, make_reconstruction, rng) -> None:
    write_model(make_reconstruction(4), tmp_path)
    for name in BINARY:
        whole = (tmp_path / name).read_bytes()
        for _ in range(20):
            damaged = bytearray(whole)
            damaged[rng.integers(len(whole))] ^= int(rng.integers(1, 256))
            (tmp_path / name).write_bytes(damaged)
            with contextlib.suppress(FormatError):
                read_model(tmp_path)
        (tmp_path / name).write_bytes(whole)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("cameras.txt", "1 PINHOLE 640 480 500 500 320"),
        ("cameras.txt", "1 NO_SUCH_MODEL 640 480 500"),
        ("cameras.txt", "one PINHOLE 640 480 500 500 320 240"),
        ("cameras.txt", "1"),
        ("images.txt", "1 1 0 0 0 0 0 0 2"),
        ("images.txt", "1 1 0 0 0 0 0 zero 2 a.jpg"),
        ("images.txt", "9999 1 0 0 0 0 0 0 2 a.jpg\n1 2 3 4"),
        ("points3D.txt", "1 0 0 0 1 2 3 0 5"),
        ("points3D.txt", "1 0 0"),
        ("points3D.txt", "1 0 0 0 1 2 300 0"),
        ("rigs.txt", "1 2 CAMERA 1 CAMERA"),
        ("rigs.txt", "1 2 CAMERA 1 CAMERA 2 1 1 0 0 0 0 0"),
        ("rigs.txt", "1 1 IMU 1"),
        ("frames.txt", "1 1 1 0 0 0 0 0 0 2 CAMERA 1 1"),
        ("frames.txt", "1 1 1 0 0"),
    ],
)
def test_a_damaged_line_of_text_is_named(tmp_path, make_reconstruction, name: str, line: str) -> None:
    write_model(make_reconstruction(2), tmp_path, text=True)
    lines = (tmp_path / name).read_text().splitlines()
    (tmp_path / name).write_text("\n".join([*lines, line]) + "\n")
    with pytest.raises(FormatError) as error:
        read_model(tmp_path)
    assert name in str(error.value)
    number = len(lines) + 1 + line.count("\n")
    assert f"line {number} " in str(error.value)


def test_text_may_have_comments_empty_lines_and_carriage_returns(tmp_path, make_reconstruction, assert_same_model):
    model = make_reconstruction(3)
    write_model(model, tmp_path, text=True)
    for name in ("cameras.txt", "images.txt", "points3D.txt", "rigs.txt", "frames.txt"):
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_bytes(("# more\n\n" + text).replace("\n", "\r\n").encode())
    assert_same_model(read_model(tmp_path), model)


def test_bytes_that_are_no_text_are_a_format_error(tmp_path, make_reconstruction) -> None:
    write_model(make_reconstruction(3), tmp_path, text=True)
    (tmp_path / "points3D.txt").write_bytes(b"\x89PNG\xff\xfe\n")
    with pytest.raises(FormatError, match=r"points3D.txt: is no text file"):
        read_model(tmp_path)


def test_files_that_contradict_each_other_are_refused(tmp_path, make_reconstruction) -> None:
    large, small = make_reconstruction(30), make_reconstruction(2)
    write_model(large, tmp_path / "a")
    write_model(small, tmp_path / "b")
    (tmp_path / "a" / "points3D.bin").rename(tmp_path / "b" / "points3D.bin")
    with pytest.raises(FormatError, match="a track names an image or a keypoint that is not there"):
        read_model(tmp_path / "b")
    write_model(small, tmp_path / "b")
    (tmp_path / "b" / "cameras.bin").write_bytes(bytes(8))
    with pytest.raises(FormatError, match="cameras that are absent"):
        read_model(tmp_path / "b")


@pytest.mark.parametrize("text", [False, True])
def test_a_camera_that_colmap_lacks_is_refused_and_leaves_no_file(tmp_path, make_reconstruction, text: bool) -> None:
    model = make_reconstruction()
    cameras = dict(model.cameras) | {2: Camera("DOUBLE_SPHERE", 640, 480, np.arange(6.0))}
    with pytest.raises(FormatError, match=r"no camera model DOUBLE_SPHERE .* --fit OPENCV_FISHEYE"):
        write_model(dataclasses.replace(model, cameras=cameras), tmp_path / "model", text=text)
    assert not list(tmp_path.iterdir())


def test_a_track_to_nowhere_is_not_written(tmp_path, make_reconstruction) -> None:
    model = make_reconstruction(3)
    for image_ids, feature_ids in (
        (model.tracks.image_ids, model.tracks.feature_ids + 5000),
        (model.tracks.image_ids, -1 - model.tracks.feature_ids),
    ):
        bad = dataclasses.replace(model, tracks=Tracks(model.tracks.offsets, image_ids, feature_ids))
        with pytest.raises(ValueError, match="not there"):
            write_model(bad, tmp_path)
    assert os.listdir(tmp_path) == []


def test_poses_that_moved_without_their_frames_are_not_written(tmp_path: Path, rig_model: Path) -> None:
    model = read_model(rig_model / "bin")
    moved = dataclasses.replace(model, cams_from_world=model.cams_from_world @ Rigid3.exp(np.full((12, 6), 0.1)))
    with pytest.raises(ValueError, match="is not that of its frame"):
        write_model(moved, tmp_path)


def test_frames_that_do_not_fit_the_images_are_refused(tmp_path: Path, rig_model: Path) -> None:
    model = read_model(rig_model / "bin")
    for change, cause in (
        ({"rigs": model.rigs[:1]}, "is of rig 2, which is not there"),
        ({"rigs": tuple(Rig(rig.rig_id, rig.ref_camera_id) for rig in model.rigs)}, "which is not in its rig"),
        ({"frames": model.frames[1:]}, "is in no frame"),
    ):
        with pytest.raises(ValueError, match=cause):
            write_model(dataclasses.replace(model, **change), tmp_path)
    assert os.listdir(tmp_path) == []


def test_a_model_whose_images_alone_were_moved_is_refused(tmp_path, make_reconstruction) -> None:
    model = make_reconstruction()
    write_model(model, tmp_path)
    moved = dataclasses.replace(model, cams_from_world=model.cams_from_world @ Rigid3.exp(np.full((5, 6), 0.1)))
    write_model(moved, tmp_path / "moved")
    (tmp_path / "moved" / "images.bin").replace(tmp_path / "images.bin")
    with pytest.raises(FormatError, match="is not that of its frame"):
        read_model(tmp_path)


def test_a_name_with_a_line_break_is_not_written_as_text(tmp_path, make_reconstruction) -> None:
    model = dataclasses.replace(make_reconstruction(1, images=2), image_names=("a", "b\nc"))
    with pytest.raises(ValueError, match="cannot be written as text"):
        write_model(model, tmp_path, text=True)


def test_sparse_image_ids_take_the_search_instead_of_the_table(tmp_path, make_reconstruction, assert_same_model):
    model = make_reconstruction(4)
    tracks = Tracks(model.tracks.offsets, model.tracks.image_ids * np.int32(2_000_000), model.tracks.feature_ids)
    model = dataclasses.replace(model, image_ids=model.image_ids * np.int32(2_000_000), tracks=tracks)
    write_model(model, tmp_path)
    assert_same_model(read_model(tmp_path), model)
