from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sfm.core.cameras import COLMAP_MODELS, Camera
from sfm.core.errors import FormatError, InputError, Rejected, WorkspaceLockedError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import DescriptorKind, Features, Matches, PairKind, TwoViewGeometry
from sfm.io.bookkeeping import Decision, ImageSource
from sfm.io.database import Database
from sfm.io.database_images import ImageRow
from sfm.io.database_pairs import pair_id, pair_of

CAMERA = Camera("SIMPLE_RADIAL", 640, 480, np.array([500.0, 320.0, 240.0, 0.1]), has_prior_focal_length=True)


def random_features(count: int, rng: np.random.Generator, width: int = 128) -> Features:
    return Features(
        rng.uniform(0, 640, (count, 2)),
        rng.uniform(1, 9, count).astype(np.float32),
        rng.uniform(-3, 3, count).astype(np.float32),
        rng.integers(0, 256, (count, width), np.uint8),
    )


def as_stored(features: Features) -> Features:
    """The features as they come back from the database: keypoints rounded to float32."""
    return dataclasses.replace(features, points2D=features.points2D.astype(np.float32).astype(np.float64))


def calibrated(rng: np.random.Generator, matches: int = 6) -> TwoViewGeometry:
    return TwoViewGeometry(
        PairKind.CALIBRATED,
        rng.integers(0, 9, (matches, 2), np.int32),
        Rigid3.exp(rng.normal(size=6)),
        E=rng.normal(size=(3, 3)),
        F=rng.normal(size=(3, 3)),
        H=rng.normal(size=(3, 3)),
        tri_angle=float(rng.uniform()),
    )


def assert_same_geometry(actual: TwoViewGeometry | Rejected, expected: TwoViewGeometry) -> None:
    assert isinstance(actual, TwoViewGeometry)
    assert (actual.kind, actual.tri_angle) == (expected.kind, expected.tri_angle)
    np.testing.assert_array_equal(actual.matches, expected.matches)
    for name in ("E", "F", "H"):
        if getattr(expected, name) is None:
            assert getattr(actual, name) is None
        else:
            np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name))
    if expected.cam2_from_cam1 is None:
        assert actual.cam2_from_cam1 is None
    else:
        assert actual.cam2_from_cam1 is not None
        np.testing.assert_array_equal(actual.cam2_from_cam1.matrix, expected.cam2_from_cam1.matrix)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "ein Ordner" / "dätabase #1%.db"


@pytest.fixture
def database(path: Path):
    with Database.open(path) as database:
        camera_id = database.add_camera(CAMERA)
        for name in ("a b.jpg", "sub/ö.jpg", "c.jpg"):
            database.add_image(name, camera_id)
        yield database


# Cameras and images


def test_cameras_of_every_model_read_back(path: Path, rng: np.random.Generator) -> None:
    with Database.open(path) as database:
        for model in COLMAP_MODELS:
            params = rng.uniform(0, 999, len(model.param_names))
            camera_id = database.add_camera(Camera(model.name, 640, 480, params, bool(model.model_id % 2)))
            camera = database.cameras()[camera_id]
            assert (camera.model, camera.width, camera.height) == (model.name, 640, 480)
            assert camera.has_prior_focal_length == bool(model.model_id % 2)
            np.testing.assert_array_equal(camera.params, params)


def test_a_camera_that_colmap_lacks_is_refused_before_anything_is_written(database: Database) -> None:
    with pytest.raises(FormatError, match="no camera model DOUBLE_SPHERE"):
        database.add_camera(Camera("DOUBLE_SPHERE", 10, 20, np.arange(6.0)))
    assert list(database.cameras()) == [1]


def test_a_camera_can_be_replaced(database: Database) -> None:
    database.update_camera(1, Camera("PINHOLE", 10, 20, np.arange(4.0)))
    assert database.cameras()[1].model == "PINHOLE"
    with pytest.raises(ValueError, match="no camera 9"):
        database.update_camera(9, CAMERA)


def test_images_are_listed_by_id_and_unique_by_name(database: Database) -> None:
    assert database.images() == (ImageRow(1, "a b.jpg", 1), ImageRow(2, "sub/ö.jpg", 1), ImageRow(3, "c.jpg", 1))
    with pytest.raises(ValueError, match="UNIQUE"):
        database.add_image("c.jpg", 1)
    with pytest.raises(ValueError, match="no camera 7"):
        database.add_image("d.jpg", 7)
    assert len(database.images()) == 3


def test_an_image_can_change_its_camera(database: Database, path: Path) -> None:
    other = database.add_camera(Camera("PINHOLE", 640, 480, np.arange(4.0)))
    for row in database.images():
        database.assign_camera(row.image_id, other)
    database.delete_unused_cameras()
    assert list(database.cameras()) == [other]
    database.close()
    theirs = pycolmap.Database.open(path)
    assert {frame.rig_id for frame in theirs.read_all_frames()} == {other}
    assert [rig.ref_sensor_id.id for rig in theirs.read_all_rigs()] == [other]
    theirs.close()


def test_sources_are_kept(database: Database) -> None:
    source = ImageSource("00ff", 123, 2**62, 6)
    database.write_source(2, source)
    assert database.sources() == {2: source}


def test_deleting_an_image_takes_all_that_hangs_on_it(database: Database, path: Path, rng) -> None:
    for image_id in (1, 2, 3):
        database.write_features(image_id, random_features(5, rng))
        database.write_source(image_id, ImageSource("x", 1, 1))
    for pair in ((1, 2), (1, 3), (2, 3)):
        database.write_matches(*pair, Matches(np.zeros((1, 2), np.int32)))
        database.write_geometry(*pair, calibrated(rng))
    database.delete_image(2)
    assert [row.image_id for row in database.images()] == [1, 3]
    assert database.matched_pairs() == database.verified_pairs() == ((1, 3),)
    assert list(database.feature_counts()) == list(database.sources()) == [1, 3]
    assert database.add_image("new.jpg", 1) == 4  # an id never comes back
    database.close()
    theirs = pycolmap.Database.open(path)
    assert sorted(frame.frame_id for frame in theirs.read_all_frames()) == [1, 3, 4]
    theirs.close()


# Features


def test_features_read_back_as_stored_to_the_last_bit(database: Database, rng) -> None:
    features = random_features(50, rng)
    assert not np.array_equal(as_stored(features).points2D, features.points2D)
    for written in (features, as_stored(features)):
        database.write_features(1, written)
        read = database.read_features(1)
        for name in ("points2D", "scales", "orientations", "descriptors"):
            np.testing.assert_array_equal(getattr(read, name), getattr(as_stored(features), name))
        np.testing.assert_array_equal(database.read_keypoints(1), read.points2D)
        np.testing.assert_array_equal(database.read_keypoint_scales(1), read.scales)
        assert read.points2D.dtype == np.float64


def test_pairs_that_only_a_watermark_holds_are_not_linked(database: Database) -> None:
    matches = np.zeros((20, 2), np.int32)
    database.write_geometry(1, 2, TwoViewGeometry(PairKind.PLANAR, matches))
    database.write_geometry(1, 3, TwoViewGeometry(PairKind.WATERMARK, matches))
    database.write_geometry(2, 3, Rejected("too_few_matches", "3 of 15"))
    assert database.linked_pairs() == ((1, 2),)


@pytest.mark.parametrize("kind", list(DescriptorKind))
def test_the_kind_of_descriptors_is_kept_and_colmap_takes_none_but_sift_for_its_own(
    database: Database, rng, kind
) -> None:
    features = random_features(5, rng, 61 if kind == DescriptorKind.BINARY else 128)
    database.write_features(2, dataclasses.replace(features, kind=kind))
    read = database.read_features(2)
    assert read.kind == kind
    assert np.array_equal(read.descriptors, features.descriptors)
    database.close()
    with contextlib.closing(pycolmap.Database.open(database.path)) as theirs:
        descriptors = theirs.read_descriptors(2)
    assert (descriptors.type == pycolmap.FeatureExtractorType.SIFT) == (kind == DescriptorKind.SIFT)
    assert np.array_equal(descriptors.data, features.descriptors)


def test_an_image_without_features_is_not_one_without_extraction(database: Database, rng) -> None:
    database.write_features(2, random_features(0, rng))
    assert database.feature_counts() == {2: 0}
    assert database.read_features(2).descriptors.shape == (0, 128)
    for read in (database.read_features, database.read_keypoints):
        with pytest.raises(ValueError, match="image 1 has no features"):
            read(1)


def test_features_can_be_cleared_one_by_one_or_all(database: Database, rng) -> None:
    for image_id in (1, 2, 3):
        database.write_features(image_id, random_features(2, rng))
    database.clear_features(2)
    assert list(database.feature_counts()) == [1, 3]
    database.clear_features()
    assert database.feature_counts() == {}


def test_keypoints_of_two_and_six_columns_are_read(database: Database, path: Path, rng) -> None:
    scale, angle = 3.0, 0.4
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    affine = np.array([[5, 6, c, -s, s, c]], np.float32)
    theirs = pycolmap.Database.open(path)
    theirs.write_keypoints(1, affine)
    theirs.write_keypoints(2, affine[:, :2])
    for image_id in (1, 2):
        descriptors = rng.integers(0, 256, (1, 128), np.uint8)
        theirs.write_descriptors(image_id, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, descriptors))
    theirs.close()
    features = database.read_features(1)
    np.testing.assert_allclose([features.scales[0], features.orientations[0]], [scale, angle], rtol=1e-6)
    assert database.read_features(2).scales.tolist() == [0]
    np.testing.assert_array_equal(features.points2D, [[5, 6]])


# Pairs


def test_the_key_of_a_pair_is_colmaps(database: Database, path: Path) -> None:
    assert pair_id(2, 1) == pair_id(1, 2) == 2147483649
    assert pair_of(pair_id(7, 2**31 - 2)) == (7, 2**31 - 2)
    for wrong in ((3, 3), (-1, 2), (1, 2**31)):
        with pytest.raises(ValueError, match="do not make a pair"):
            pair_id(*wrong)


@pytest.mark.parametrize("pair", [(1, 2), (2, 1)])
def test_matches_read_back_in_either_order(database: Database, rng, pair) -> None:
    indices = rng.integers(0, 9, (7, 2), np.int32)
    database.write_matches(*pair, Matches(indices))
    np.testing.assert_array_equal(database.read_matches(*pair).indices, indices)
    np.testing.assert_array_equal(database.read_matches(*reversed(pair)).indices, indices[:, ::-1])


def test_pairs_without_matches_count_as_matched(database: Database) -> None:
    database.write_matches(1, 3, Matches(np.zeros((0, 2), np.int32)))
    assert database.matched_pairs() == ((1, 3),)
    assert database.match_counts() == {(1, 3): 0}
    assert len(database.read_matches(1, 3)) == 0
    with pytest.raises(ValueError, match="were not matched"):
        database.read_matches(1, 2)
    database.clear_matches((3, 1))
    assert database.matched_pairs() == ()


def test_geometries_read_back_to_the_last_bit(database: Database, rng) -> None:
    expected = {
        (1, 2): calibrated(rng),
        (1, 3): TwoViewGeometry(PairKind.UNCALIBRATED, np.ones((4, 2), np.int32), F=rng.normal(size=(3, 3))),
        (2, 3): TwoViewGeometry(
            PairKind.PANORAMIC, np.ones((1, 2), np.int32), Rigid3(Rigid3.exp(np.ones(6)).rotation, np.zeros(3))
        ),
    }
    for pair, geometry in reversed(expected.items()):
        database.write_geometry(*pair, geometry)
    graph = database.read_view_graph()
    assert list(graph.pairs) == list(expected)
    for pair, geometry in expected.items():
        assert_same_geometry(graph.pairs[pair], geometry)
        assert_same_geometry(database.read_geometry(*pair), geometry)


def test_rejected_pairs_are_remembered_with_their_reason(database: Database, rng) -> None:
    database.write_geometry(1, 2, Rejected("too_few_inliers", "11 of 15 needed"))
    database.write_geometry(2, 3, calibrated(rng))
    assert database.verified_pairs() == ((1, 2), (2, 3))
    assert list(database.read_view_graph().pairs) == [(2, 3)]
    assert database.rejected_pairs() == {(1, 2): Rejected("too_few_inliers", "11 of 15 needed")}
    assert database.read_geometry(1, 2) == Rejected("too_few_inliers", "11 of 15 needed")
    database.write_geometry(1, 2, calibrated(rng))
    assert database.rejected_pairs() == {}
    database.clear_geometries((1, 2))
    with pytest.raises(ValueError, match="were not verified"):
        database.read_geometry(1, 2)
    with pytest.raises(ValueError, match="from the lower image id"):
        database.write_geometry(2, 1, calibrated(rng))
    database.clear_geometries()
    assert database.verified_pairs() == ()


# Stages, ledger, notes


def test_stage_keys_say_what_is_finished(database: Database) -> None:
    database.set_stage_keys("features", {"a": "1", "b": "2"})
    database.set_stage_keys("features", {"b": "3"})
    database.set_stage_keys("matching", {"a": "9"})
    assert database.stage_keys("features") == {"a": "1", "b": "3"}
    database.clear_stage("features", ["a", "never there"])
    assert database.stage_keys("features") == {"b": "3"}
    database.clear_stage("features")
    assert database.stage_keys("features") == {}
    assert database.stage_keys("matching") == {"a": "9"}


def test_the_ledger_gives_decisions_back_in_order(database: Database) -> None:
    few = Decision("features", "a.jpg", "keypoints", 12.0, 50.0, "skipped", "too few")
    seen = Decision("mapping", "a.jpg", "inliers", 40.0, 30.0, "registered")
    other = Decision("mapping", "b.jpg", "usable", None, None, "skipped")
    database.record(few, other)
    database.record(seen)
    assert database.ledger() == (few, other, seen)
    assert database.ledger("a.jpg") == (few, seen)
    assert database.ledger(stage="mapping") == (other, seen)
    assert database.ledger("a.jpg", stage="mapping") == (seen,)
    database.clear_ledger("mapping", ["a.jpg"])
    assert database.ledger() == (few, other)
    database.clear_ledger("mapping")
    assert database.ledger() == (few,)


def test_notes_are_kept(database: Database) -> None:
    database.set_meta("seed", "0")
    assert database.meta() == {"schema_version": "1", "seed": "0"}


# With pycolmap


def test_pycolmap_reads_what_we_write(database: Database, path: Path, rng) -> None:
    features, matches, geometry = (
        random_features(9, rng),
        Matches(rng.integers(0, 9, (7, 2), np.int32)),
        calibrated(rng),
    )
    for image_id in (1, 2):
        database.write_features(image_id, features)
    database.write_matches(1, 2, matches)
    database.write_geometry(1, 2, geometry)
    database.write_geometry(1, 3, Rejected("too_few_matches"))
    database.close()
    theirs = pycolmap.Database.open(path)
    (camera,) = theirs.read_all_cameras()
    assert (camera.model_name, camera.has_prior_focal_length) == ("SIMPLE_RADIAL", True)
    np.testing.assert_array_equal(camera.params, CAMERA.params)
    assert [image.name for image in theirs.read_all_images()] == ["a b.jpg", "sub/ö.jpg", "c.jpg"]
    assert [image.frame_id for image in theirs.read_all_images()] == [1, 2, 3]
    assert theirs.read_all_rigs()[0].is_ref_sensor(camera.sensor_id)
    np.testing.assert_array_equal(
        theirs.read_keypoints(1)[:, :4],
        np.column_stack([as_stored(features).points2D, features.scales, features.orientations]),
    )
    descriptors = theirs.read_descriptors(1)
    assert descriptors.type == pycolmap.FeatureExtractorType.SIFT
    np.testing.assert_array_equal(descriptors.data, features.descriptors)
    np.testing.assert_array_equal(theirs.read_matches(1, 2), matches.indices)
    other = theirs.read_two_view_geometry(1, 2)
    assert int(other.config) == geometry.kind
    np.testing.assert_array_equal(other.inlier_matches, geometry.matches)
    for name in ("E", "F", "H"):
        np.testing.assert_array_equal(getattr(other, name), getattr(geometry, name))
    assert geometry.cam2_from_cam1 is not None
    np.testing.assert_allclose(other.cam2_from_cam1.matrix(), geometry.cam2_from_cam1.matrix, atol=1e-15)
    assert theirs.read_two_view_geometry(1, 3).config == pycolmap.TwoViewGeometryConfiguration.UNDEFINED
    assert theirs.num_verified_image_pairs() == 2
    theirs.close()


def synthetic_database(path: Path) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 6, 120
    options.two_view_geometry_has_relative_pose = True
    theirs = pycolmap.Database.open(path)
    truth = pycolmap.synthesize_dataset(options, theirs)
    theirs.close()
    return truth


def test_we_read_what_pycolmap_writes_and_it_reconstructs_from_our_copy(tmp_path: Path) -> None:
    truth = synthetic_database(tmp_path / "theirs.db")
    with Database.open(tmp_path / "theirs.db", readonly=True) as source, Database.open(tmp_path / "ours.db") as target:
        graph = source.read_view_graph()
        assert len(graph) == 15
        assert all(geometry.cam2_from_cam1 is not None for geometry in graph.pairs.values())
        for camera in source.cameras().values():
            target.add_camera(camera)
        with target.transaction():
            for row in source.images():
                target.add_image(row.name, row.camera_id)
                target.write_features(row.image_id, source.read_features(row.image_id))
            for pair in source.matched_pairs():
                target.write_matches(*pair, source.read_matches(*pair))
            for pair, geometry in graph.pairs.items():
                target.write_geometry(*pair, geometry)
    options = pycolmap.IncrementalPipelineOptions()
    models = pycolmap.incremental_mapping(tmp_path / "ours.db", tmp_path, tmp_path / "out", options)
    assert models[0].num_reg_images() == truth.num_images() == 6


def test_a_foreign_database_can_be_read_without_being_changed(tmp_path: Path) -> None:
    path = tmp_path / "theirs.db"
    synthetic_database(path)
    before = path.read_bytes()
    with Database.open(path, readonly=True) as database:
        assert len(database.images()) == 6
        assert database.ledger() == ()
        assert database.sources() == {}
        with pytest.raises(InputError, match="readonly"):
            database.add_camera(CAMERA)
    assert path.read_bytes() == before


# Transactions, threads, processes


def test_a_transaction_is_all_or_nothing(database: Database) -> None:
    def fail() -> None:
        with database.transaction():
            database.set_stage_keys("x", {"a": "1"})
            with database.transaction():
                database.record(Decision("x", "a", "g", 1.0, 2.0, "v"))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert database.stage_keys("x") == {}
    assert database.ledger() == ()


def test_a_killed_process_loses_only_its_open_transaction(database: Database, path: Path) -> None:
    script = (
        "import os, signal, sys\n"
        "from sfm.io.database import Database\n"
        "database = Database.open(sys.argv[1])\n"
        "database.set_stage_keys('x', {'kept': '1'})\n"
        "with database.transaction():\n"
        "    for k in range(20000):\n"
        "        database.set_stage_keys('x', {f'lost{k}': '1'})\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, check=False, cwd=Path.cwd())
    assert done.returncode == -9, done.stderr.decode()
    assert database.stage_keys("x") == {"kept": "1"}
    database.close()
    with Database.open(path) as again:
        assert again.stage_keys("x") == {"kept": "1"}
        again.set_stage_keys("x", {"new": "2"})


def test_many_threads_read_while_one_writes(database: Database, rng) -> None:
    features = as_stored(random_features(200, rng))
    for image_id in (1, 2, 3):
        database.write_features(image_id, features)
    failures: list[object] = []

    def read() -> None:
        for k in range(60):
            points2D = database.read_features(1 + k % 3).points2D
            if not np.array_equal(points2D, features.points2D):
                failures.append(k)

    threads = [threading.Thread(target=read) for _ in range(3)]
    for thread in threads:
        thread.start()
    with database.transaction():
        for k in range(200):
            database.write_matches(1, 2, Matches(np.full((5, 2), k, np.int32)))
    for thread in threads:
        thread.join()
    assert failures == []
    assert database.read_matches(1, 2).indices[0, 0] == 199


def test_a_second_writer_is_told_that_the_database_is_locked(database: Database, path: Path, monkeypatch) -> None:
    monkeypatch.setattr("sfm.io.sqlite_file._BUSY_TIMEOUT_S", 0.05)
    with Database.open(path) as second, database.transaction():
        database.set_meta("a", "1")
        assert "a" not in second.meta()
        with pytest.raises(WorkspaceLockedError, match="another process writes"):
            second.set_meta("b", "2")


# Files that will not do


def test_a_file_that_is_no_database_is_a_format_error(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    path.write_bytes(b"\xff\xd8\xff not a database at all" * 200)
    for readonly in (False, True):
        with pytest.raises(FormatError, match=r"x\.db: is no sound SQLite database"):
            Database.open(path, readonly=readonly)
    assert path.read_bytes().startswith(b"\xff\xd8\xff")


def test_a_database_of_another_program_is_a_format_error(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE bookmarks (a)")
    connection.close()
    for readonly in (False, True):
        with pytest.raises(FormatError, match="no COLMAP database"):
            Database.open(path, readonly=readonly)


def test_a_truncated_database_is_an_error_that_names_it(database: Database, path: Path, rng) -> None:
    database.write_features(1, random_features(3000, rng))
    database.close()
    whole = path.read_bytes()
    for size in (50, 1000, 5000, 40960, len(whole) // 2):
        path.write_bytes(whole[:size])
        with pytest.raises((FormatError, InputError)) as error, Database.open(path) as damaged:
            damaged.read_features(1)
        assert path.name in str(error.value)


def test_a_damaged_blob_is_a_format_error(database: Database, path: Path, rng) -> None:
    database.write_features(1, random_features(5, rng))
    database.write_matches(1, 2, Matches(np.zeros((5, 2), np.int32)))
    database.write_geometry(1, 2, calibrated(rng))
    with sqlite3.connect(path) as connection:
        for table in ("keypoints", "descriptors", "matches", "two_view_geometries"):
            connection.execute(f"UPDATE {table} SET data = x'0011'")
    connection.close()
    for read in (
        lambda: database.read_features(1),
        lambda: database.read_keypoints(1),
        lambda: database.read_matches(1, 2),
        database.read_view_graph,
    ):
        with pytest.raises(FormatError, match=r"image.* 1.* cannot be read"):
            read()


def test_a_later_schema_is_refused(database: Database, path: Path) -> None:
    database.set_meta("schema_version", "2")
    database.close()
    for readonly in (False, True):
        with pytest.raises(WorkspaceLockedError, match="schema version 2, this program reads 1"):
            Database.open(path, readonly=readonly)


def test_a_missing_database_is_not_made_for_reading(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no database"):
        Database.open(tmp_path / "x.db", readonly=True)
    assert os.listdir(tmp_path) == []
    with pytest.raises(InputError, match="is a folder"):
        Database.open(tmp_path)


def test_a_creation_that_was_killed_is_completed(path: Path) -> None:
    path.parent.mkdir()
    for statement in ("", "CREATE TABLE cameras (camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, "
                      "model INTEGER NOT NULL, width INTEGER NOT NULL, height INTEGER NOT NULL, params BLOB, "
                      "prior_focal_length INTEGER NOT NULL)"):  # fmt: skip
        path.unlink(missing_ok=True)
        with sqlite3.connect(path) as connection:
            connection.execute(statement)
        connection.close()
        with Database.open(path) as database:
            database.add_image("a", database.add_camera(CAMERA))


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_database_in_a_read_only_folder_can_be_read_and_not_made(database: Database, path: Path) -> None:
    database.close()
    path.parent.chmod(0o500)
    try:
        with Database.open(path, readonly=True) as again:
            assert len(again.images()) == 3
        with pytest.raises(InputError):
            Database.open(path.with_name("new.db"))
    finally:
        path.parent.chmod(0o700)


def test_a_closed_database_is_one_file(database: Database, path: Path, tmp_path: Path, rng) -> None:
    database.write_features(1, random_features(5, rng))
    database.close()
    assert os.listdir(path.parent) == [path.name]
    shutil.copy(path, tmp_path / "copy.db")
    with Database.open(tmp_path / "copy.db", readonly=True) as copy:
        assert len(copy.read_features(1)) == 5
