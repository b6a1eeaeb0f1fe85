from __future__ import annotations

import numpy as np
import pytest

from datasets.synthetic import materials as m
from datasets.synthetic.buildings import facade
from datasets.synthetic.paths import arc, example_camera, look_at
from datasets.synthetic.shapes import Shape, box, gable, plane, revolved, rock
from sfm.core.cameras import MODELS

CLAY = m.stone((0.5, 0.5, 0.5), 1)
CLOSED = {
    "box": (box((-1, -2, 0), (1, 2, 3), CLAY), 24.0),
    "gable": (gable(2, 1, 1, CLAY, overhang=0.0), 4.0),
    "ball": (rock((1, 1, 1), CLAY, roughness=0.0, wavelength=1.0, seed=0, rows=60), 4 / 3 * np.pi),
    "cylinder": (revolved([(0, 0), (1, 0), (1, 2), (0, 2)], CLAY, sides=200), 2 * np.pi),
}


def volume(shape: Shape) -> float:
    a, b, c = np.moveaxis(shape.points[shape.triangles], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("name", CLOSED)
def test_closed_shapes_hold_their_volume(name):
    shape, expected = CLOSED[name]
    assert abs(volume(shape)) == pytest.approx(expected, rel=3e-3)


@pytest.mark.parametrize("name", CLOSED)
def test_every_edge_of_a_closed_shape_has_two_sides(name):
    shape, _ = CLOSED[name]
    places = np.unique(shape.points.round(9), axis=0, return_inverse=True)[1].ravel()[shape.triangles]
    edges = np.concatenate([places[:, [0, 1]], places[:, [1, 2]], places[:, [2, 0]]])
    _, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    assert np.all(counts == 2)


def test_texture_stays_with_a_shape_that_moves():
    shape = box((0, 0, 0), (1, 2, 3), CLAY)
    moved = shape.moved((5, 6, 7), yaw_deg=90)
    np.testing.assert_array_equal(moved.texture_points, shape.points)
    np.testing.assert_allclose(moved.points, shape.points[:, [1, 0, 2]] * (-1, 1, 1) + (5, 6, 7), atol=1e-12)


def test_shading_normals_of_a_ball_point_along_its_radius():
    ball, _ = CLOSED["ball"]
    radius = ball.points[ball.triangles] - (0, 0, 0.9)
    cosine = np.einsum("ijk,ijk->ij", ball.shading_normals(), radius / np.linalg.norm(radius, axis=-1, keepdims=True))
    assert np.abs(cosine).min() > 0.99


def test_flat_shapes_have_one_normal_for_each_triangle():
    normals = plane(2, 3, CLAY).shading_normals()
    np.testing.assert_allclose(np.abs(normals), np.broadcast_to([0, 0, 1.0], normals.shape), atol=1e-12)


def test_no_two_faces_of_a_facade_fight_for_one_place():
    """Coplanar, overlapping faces of different materials would flicker between views."""
    faces = []
    for number, shape in enumerate(facade(3, 2, 1)):
        if len(shape.triangles) != 12:
            continue
        low, high = shape.points.min(0), shape.points.max(0)
        if np.any(high - low <= 1e-9) or shape.points.shape != (8, 3):
            continue
        faces.append((number, shape.material, low, high))
    fights = [
        (a, b)
        for a, first, low1, high1 in faces
        for b, second, low2, high2 in faces
        if a < b
        and first != second
        and abs(low1[1] - low2[1]) < 1e-6
        and np.all(np.minimum(high1, high2)[[0, 2]] - np.maximum(low1, low2)[[0, 2]] > 1e-6)
    ]
    assert not fights


def test_look_at_puts_the_target_in_the_middle_and_the_sky_on_top():
    pose = look_at((3.0, -4.0, 2.0), (0.5, 0.5, 1.0))
    np.testing.assert_allclose(pose.center, (3, -4, 2), atol=1e-12)
    target = pose @ np.array([[0.5, 0.5, 1.0]])
    np.testing.assert_allclose(target[0, :2], 0, atol=1e-12)
    assert target[0, 2] > 0
    assert (pose.rotation @ np.array([0.0, 0.0, 1.0]))[1] < 0
    with pytest.raises(ValueError, match="vertical"):
        look_at((0, 0, 5), (0, 0, 0))


def test_an_arc_is_at_most_one_turn():
    few, many = arc(5, 15.0, 2.0, 1.0), arc(60, 15.0, 2.0, 1.0)
    step = 2 * 2.0 * np.sin(np.deg2rad(15) / 2)
    np.testing.assert_allclose(np.linalg.norm(np.diff(few, axis=0), axis=1), step)
    assert np.linalg.norm(many[-1] - many[0]) == pytest.approx(2 * 2.0 * np.sin(np.deg2rad(6) / 2))


@pytest.mark.parametrize("model", [info.name for info in MODELS])
def test_example_cameras_see_through_every_pixel(model):
    camera = example_camera(model, 64, 48, fov_deg=70)
    corners = np.array([[0.5, 0.5], [63.5, 0.5], [0.5, 47.5], [63.5, 47.5], [32.0, 24.0]])
    rays, valid = camera.unproject(corners)
    assert valid.all()
    np.testing.assert_allclose(camera.project(rays)[0], corners, atol=1e-6)
