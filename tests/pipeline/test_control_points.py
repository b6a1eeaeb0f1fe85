import dataclasses

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import InputError
from sfm.core.scene import Reconstruction, Tracks
from sfm.io.measurements import ControlPoints, Marks
from sfm.pipeline.control_points import with_marks, without_marks
from tests.bundle.conftest import looking_inwards

CAMERA = Camera("PINHOLE", 1000, 760, np.array([800.0, 820, 500, 380]))


@pytest.fixture
def model(rng):
    """Four images with different numbers of keypoints, of which the first two are of one point."""
    poses = looking_inwards(4, rng)
    point = np.array([[0.1, 0.2, 0.3]])
    counts = [3, 1, 0, 2]
    keypoints = rng.uniform(0, 700, (sum(counts), 2))
    for row, first in ((0, 0), (1, 3)):
        keypoints[first] = CAMERA.project(poses[row] @ point)[0][0]
    return Reconstruction(
        cameras={1: CAMERA},
        image_ids=np.array([2, 3, 5, 8], np.int32),
        image_names=("a.jpg", "b.jpg", "c.jpg", "d.jpg"),
        image_camera_ids=np.ones(4, np.int32),
        cams_from_world=poses,
        keypoint_offsets=np.cumsum([0, *counts]),
        keypoints=keypoints,
        points3D=point,
        point_ids=np.array([7]),
        colors=np.full((1, 3), 9, np.uint8),
        errors=np.zeros(1),
        tracks=Tracks(np.array([0, 2]), np.array([2, 3], np.int32), np.array([0, 0], np.int32)),
    )


POINTS = np.array([[0.5, -0.4, 0.2], [-0.3, 0.6, 0.1]])
SEEN = (
    ("A", "d.jpg", 0),
    ("B", "a.jpg", 1),
    ("A", "a.jpg", 0),
    ("B", "c.jpg", 1),
    ("A", "c.jpg", 0),
    ("C", "a.jpg", 0),
)


@pytest.fixture
def marks(model):
    row_of = {name: row for row, name in enumerate(model.image_names)}
    points2D = [CAMERA.project(model.cams_from_world[row_of[n]] @ POINTS[p : p + 1])[0][0] for _, n, p in SEEN]
    return Marks(tuple(label for label, _, _ in SEEN), tuple(n for _, n, _ in SEEN), np.array(points2D))


def control(*labels):
    return ControlPoints(labels, np.arange(3.0 * len(labels)).reshape(-1, 3), np.ones((len(labels), 3)))


def test_points_that_two_images_mark_become_points_of_the_model(model, marks):
    found, named, lost = with_marks(model, control("C", "B", "A"), marks)
    assert (named.labels, lost) == (("8", "9"), 1)
    np.testing.assert_array_equal(named.positions, [[3, 4, 5], [6, 7, 8]])
    np.testing.assert_allclose(found.points3D[1:], POINTS[[1, 0]], atol=1e-9)
    np.testing.assert_array_equal(found.point_ids, [7, 8, 9])
    np.testing.assert_array_equal(found.tracks.lengths, [2, 2, 3])
    # Every observation is where its point projects to.
    track = found.tracks.track_ids
    for row in range(4):
        mine = found.image_rows == row
        projected = CAMERA.project(found.cams_from_world[row] @ found.points3D[track[mine]])[0]
        np.testing.assert_allclose(found.observations[mine], projected, atol=1e-6)


def test_the_model_is_as_before_without_them(model, marks):
    found, _, _ = with_marks(model, control("A"), marks)
    back = without_marks(found, model)
    for name in ("keypoints", "keypoint_offsets", "points3D", "point_ids", "colors", "errors"):
        np.testing.assert_array_equal(getattr(back, name), getattr(model, name))
    assert back.tracks is model.tracks


def test_control_points_that_nobody_marked_are_refused(model, marks):
    with pytest.raises(InputError, match="marked in two images"):
        with_marks(model, control("Z"), marks)
    elsewhere = dataclasses.replace(marks, names=tuple("x" + name for name in marks.names))
    with pytest.raises(InputError, match="marked in two images"):
        with_marks(model, control("A"), elsewhere)
