import dataclasses
import pickle

import jaxtyping
import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import (
    Features,
    Frame,
    Matches,
    PairKind,
    Reconstruction,
    Rig,
    Tracks,
    TwoViewGeometry,
    ViewGraph,
)

PROTOCOLS = range(2, pickle.HIGHEST_PROTOCOL + 1)
# The value refuses a wrong shape itself; in the test run the checked signature may be faster.
REFUSED = (ValueError, jaxtyping.TypeCheckError)


def features(count=3):
    return Features(
        np.ones((count, 2)),
        np.ones(count, np.float32),
        np.zeros(count, np.float32),
        np.zeros((count, 128), np.uint8),
    )


def reconstruction(**changes):
    """Images 2, 5 and 9 with 3, 0 and 2 keypoints; two points, of which the second is seen in image 2 only."""
    cameras = {7: Camera("PINHOLE", 10, 8, np.array([9.0, 9, 5, 4])), 3: Camera("SIMPLE_PINHOLE", 4, 4, np.ones(3))}
    parts = {
        "cameras": cameras,
        "image_ids": np.array([2, 5, 9], np.int32),
        "image_names": ("a.jpg", "b.jpg", "c.jpg"),
        "image_camera_ids": np.array([7, 3, 7], np.int32),
        "cams_from_world": Rigid3.exp(np.arange(18.0).reshape(3, 6) / 10),
        "keypoint_offsets": np.array([0, 3, 3, 5]),
        "keypoints": np.arange(10.0).reshape(5, 2),
        "points3D": np.ones((2, 3)),
        "point_ids": np.array([4, 8]),
        "colors": np.zeros((2, 3), np.uint8),
        "errors": np.full(2, -1.0),
        "tracks": Tracks(np.array([0, 2, 3]), np.array([2, 9, 2], np.int32), np.array([1, 1, 2], np.int32)),
    }
    return Reconstruction(**(parts | changes))


def arrays_of(value):
    """All arrays within a value, however deep."""
    for field in dataclasses.fields(value):
        part = getattr(value, field.name)
        if isinstance(part, np.ndarray):
            yield part
        elif dataclasses.is_dataclass(part):
            yield from arrays_of(part)


def two_views(count=2):
    return TwoViewGeometry(
        PairKind.CALIBRATED, np.zeros((count, 2), np.int32), Rigid3.identity(), E=np.eye(3), tri_angle=0.1
    )


VALUES = {
    "features": features,
    "matches": lambda: Matches(np.zeros((4, 2), np.int32)),
    "two_views": two_views,
    "view_graph": lambda: ViewGraph({(0, 1): two_views()}),
    "tracks": lambda: reconstruction().tracks,
    "reconstruction": reconstruction,
    "camera": lambda: reconstruction().cameras[7],
    "rig": lambda: Rig(1, 7, {3: Rigid3.identity(), 4: None}),
    "frame": lambda: Frame(1, 1, Rigid3.identity(), {7: 2}),
}


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("name", VALUES)
def test_products_come_back_equal_and_read_only_from_every_pickle_protocol(name, protocol):
    value = VALUES[name]()
    again = pickle.loads(pickle.dumps(value, protocol))
    assert type(again) is type(value)
    before, after = list(arrays_of(value)), list(arrays_of(again))
    assert len(before) == len(after)
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == b.dtype
        assert not b.flags.writeable


@pytest.mark.parametrize("name", VALUES)
def test_no_array_of_a_product_can_be_written(name):
    assert not any(array.flags.writeable for array in arrays_of(VALUES[name]()))


def test_mappings_within_products_cannot_be_changed_from_either_side():
    images = {7: 2}
    frame, rig = Frame(1, 1, Rigid3.identity(), images), Rig(1, 7, {3: None})
    images[8] = 3
    assert dict(frame.image_ids) == {7: 2}
    for mapping in (frame.image_ids, rig.sensors_from_rig, reconstruction().cameras, ViewGraph({}).pairs):
        with pytest.raises(TypeError):
            mapping[0] = None  # pyright: ignore[reportIndexIssue]


def test_a_reference_sensor_has_no_pose_of_its_own():
    with pytest.raises(ValueError, match="reference"):
        Rig(1, 7, {7: Rigid3.identity()})


def test_columns_of_features_have_one_length():
    assert len(features(5)) == 5
    assert len(features(0)) == 0
    for name in ("scales", "orientations", "descriptors"):
        with pytest.raises(REFUSED):
            dataclasses.replace(features(3), **{name: getattr(features(2), name)})


def test_matches_are_pairs():
    assert len(Matches(np.zeros((0, 2), np.int32))) == 0
    with pytest.raises(REFUSED):
        Matches(np.zeros((3, 3), np.int32))
    with pytest.raises(REFUSED):
        dataclasses.replace(two_views(), F=np.eye(4))


def test_a_view_graph_is_in_the_order_of_its_keys_whatever_the_order_given():
    pairs = {(1, 2): two_views(), (0, 9): two_views(), (0, 2): two_views()}
    graph = ViewGraph(pairs)
    assert list(graph.pairs) == [(0, 2), (0, 9), (1, 2)]
    assert len(graph) == 3
    assert graph.pairs[1, 2] is pairs[1, 2]
    pairs.clear()
    assert len(graph) == 3


@pytest.mark.parametrize("pair", [(2, 1), (1, 1)])
def test_a_pair_names_the_smaller_image_first(pair):
    with pytest.raises(ValueError, match="below"):
        ViewGraph({pair: two_views()})


def test_kinds_of_pairs_have_the_numbers_of_colmap():
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.TwoViewGeometryConfiguration.__members__
    for kind in PairKind:
        assert int(theirs[kind.name]) == kind


def test_tracks_are_slices_of_their_columns():
    tracks = reconstruction().tracks
    assert len(tracks) == 2
    assert tracks.lengths.tolist() == [2, 1]
    assert tracks.track_ids.tolist() == [0, 0, 1]


def test_there_may_be_no_tracks_and_empty_ones():
    assert len(Tracks.empty()) == 0
    assert Tracks.empty().track_ids.tolist() == []
    none = np.zeros(0, np.int32)
    assert Tracks(np.zeros(3, np.int64), none, none).lengths.tolist() == [0, 0]


@pytest.mark.parametrize("offsets", [[], [1, 2], [0, 2, 1, 2], [-1, 2], [0, -2]])
def test_offsets_of_tracks_start_at_zero_and_never_fall(offsets):
    ids = np.zeros(2, np.int32)
    with pytest.raises(ValueError, match="offsets"):
        Tracks(np.array(offsets, np.int64), ids, ids)


@pytest.mark.parametrize("offsets", [[0, 1], [0, 3]])
def test_tracks_use_all_of_their_columns(offsets):
    ids = np.zeros(2, np.int32)
    with pytest.raises(REFUSED):
        Tracks(np.array(offsets), ids, ids)


def test_observations_are_the_keypoints_that_tracks_name():
    model = reconstruction()
    assert model.image_rows.tolist() == [0, 2, 0]
    np.testing.assert_array_equal(model.observations, model.keypoints[[1, 4, 2]])


def test_a_reconstruction_may_be_empty():
    model = reconstruction(
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
    assert model.observations.shape == (0, 2)


def test_cameras_are_in_the_order_of_their_ids():
    assert list(reconstruction().cameras) == [3, 7]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"image_ids": np.array([2, 9, 5], np.int32)}, "sorted"),
        ({"image_ids": np.array([2, 2, 9], np.int32)}, "sorted"),
        ({"image_ids": np.array([2, 5], np.int32)}, "expected an array|Type-check"),
        ({"image_camera_ids": np.array([7, 3, 4], np.int32)}, "absent: .4."),
        ({"cams_from_world": Rigid3.identity((2,))}, "poses for 3 images"),
        ({"keypoint_offsets": np.array([0, 3, 5])}, "expected an array|Type-check"),
        ({"keypoint_offsets": np.array([0, 3, 2, 5])}, "never fall"),
        ({"keypoint_offsets": np.array([1, 3, 3, 5])}, "never fall"),
        ({"keypoints": np.zeros((4, 2))}, "expected an array|Type-check"),
        ({"points3D": np.zeros((3, 3))}, "expected an array|Type-check"),
        ({"point_ids": np.zeros(1, np.int64)}, "expected an array|Type-check"),
        ({"colors": np.zeros((2, 4), np.uint8)}, "expected an array|Type-check"),
        ({"errors": np.zeros(3)}, "expected an array|Type-check"),
        ({"tracks": Tracks(np.array([0, 1, 2]), np.array([2, 3], np.int32), np.zeros(2, np.int32))}, "absent"),
        ({"tracks": Tracks.empty()}, "expected an array|Type-check"),
    ],
)
def test_a_reconstruction_that_contradicts_itself_is_refused(changes, message):
    with pytest.raises(REFUSED, match=message):
        reconstruction(**changes)


def test_moving_the_cameras_leaves_the_rest_shared():
    model = reconstruction()
    moved = dataclasses.replace(model, cams_from_world=Rigid3(Rotation3.identity((3,)), np.zeros((3, 3))))
    assert np.shares_memory(moved.keypoints, model.keypoints)
    assert moved.tracks is model.tracks
    assert model.cams_from_world.translation.any()
