from __future__ import annotations

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Reconstruction, Tracks
from sfm.viz.figures import (
    BACKGROUND,
    FRUSTUM_COLOR,
    View,
    choose_view,
    default_frustum_size,
    frustum_edges,
    render_model,
)


def model_of(centers: np.ndarray, points: np.ndarray, colors: np.ndarray | None = None) -> Reconstruction:
    """Cameras without rotation (looking along +z) at the centres; points without tracks of their own."""
    images, count = len(centers), len(points)
    return Reconstruction(
        cameras={1: Camera("PINHOLE", 640, 480, np.array([500.0, 500, 320, 240]))},
        image_ids=np.arange(1, images + 1, dtype=np.int32),
        image_names=tuple(f"{k}.jpg" for k in range(images)),
        image_camera_ids=np.ones(images, dtype=np.int32),
        cams_from_world=Rigid3(Rotation3.identity((images,)), -np.asarray(centers, dtype=float).reshape(-1, 3)),
        keypoint_offsets=np.zeros(images + 1, dtype=np.int64),
        keypoints=np.zeros((0, 2)),
        points3D=np.asarray(points, dtype=float).reshape(-1, 3),
        point_ids=np.arange(count, dtype=np.int64),
        colors=np.zeros((count, 3), np.uint8) if colors is None else colors.astype(np.uint8),
        errors=np.full(count, -1.0),
        tracks=Tracks(np.zeros(count + 1, np.int64), np.zeros(0, np.int32), np.zeros(0, np.int32)),
    )


FRONT = View(np.array([0.0, 0, -10]), np.zeros(3), np.array([0.0, -1, 0]), fov=float(np.radians(90)))


def test_a_point_appears_where_the_formula_says_in_its_colour() -> None:
    # f = 60 / (2 tan 45°) = 30 px; at (2, -3, 0), depth 10: x = 30 * 0.2 + 40 = 46, y = 30 * -0.3 + 30 = 21.
    model = model_of(np.zeros((0, 3)), np.array([[2.0, -3, 0]]), np.array([[200, 10, 10]]))
    picture = render_model(model, 80, 60, view=FRONT, frustum_size=0.0)
    rows, columns = np.nonzero((picture != np.array(BACKGROUND)).any(2))
    assert abs(columns.mean() + 0.5 - 46) < 1
    assert abs(rows.mean() + 0.5 - 21) < 1
    assert picture[21, 46].tolist() == [200, 10, 10]


def test_the_nearer_point_hides_the_farther_whatever_their_order() -> None:
    points, colors = np.array([[0.0, 0, 0], [0, 0, 5]]), np.array([[255, 0, 0], [0, 0, 255]])
    for order in ([0, 1], [1, 0]):
        model = model_of(np.zeros((0, 3)), points[order], colors[order])
        picture = render_model(model, 41, 41, view=FRONT, frustum_size=0.0)
        assert picture[20, 20].tolist() == [255, 0, 0]


def test_points_behind_and_beside_the_viewpoint_are_not_drawn() -> None:
    model = model_of(np.zeros((0, 3)), np.array([[0.0, 0, -20], [500, 0, 0], [0, 0, -10], [np.nan, 0, 0]]))
    picture = render_model(model, 40, 30, view=FRONT, frustum_size=0.0)
    assert np.all(picture == np.array(BACKGROUND))


def test_a_frustum_has_its_apex_in_the_centre_and_its_corners_on_the_rays() -> None:
    edges = frustum_edges(model_of(np.array([[1.0, 2, 3]]), np.zeros((0, 3))), 2.0)
    assert edges.shape == (8, 2, 3)
    np.testing.assert_allclose(edges[:4, 0], np.tile([1.0, 2, 3], (4, 1)))
    corner = np.array([1.0, 2, 3]) + 2 * np.array([-320 / 500, -240 / 500, 1])
    np.testing.assert_allclose(edges[0, 1], corner, atol=1e-12)
    np.testing.assert_allclose(edges[7, 1], edges[4, 0])


def test_the_chosen_view_shows_all_cameras_and_nearly_all_points() -> None:
    rng = np.random.default_rng(0)
    centers = np.stack([np.linspace(-3, 3, 7), np.zeros(7), np.zeros(7)], 1)
    points = rng.normal(size=(400, 3)) + np.array([0, 0, 8.0])
    points[:8] = rng.normal(scale=1000, size=(8, 3))
    view = choose_view(model_of(centers, points), aspect=2.0)
    shown = np.concatenate([centers, points[8:]])
    x, y, z = ((shown - view.position) @ view.axes.T).T
    slope = np.tan(view.fov / 2)
    inside = (z > 0) & (np.abs(x) < 2 * slope * z) & (np.abs(y) < slope * z)
    assert inside[: len(centers)].all()
    assert inside.mean() > 0.95
    assert np.linalg.norm(view.target - view.position) < 40


def test_the_chosen_view_is_from_the_cameras_side_and_upright() -> None:
    rng = np.random.default_rng(1)
    model = model_of(rng.normal(size=(6, 3)), rng.normal(size=(100, 3)) + np.array([0, 0, 20.0]))
    view = choose_view(model, azimuth=0.0, elevation=0.0)
    np.testing.assert_allclose(view.axes, np.eye(3), atol=1e-12)


def test_cameras_all_around_an_object_are_seen_from_the_side_of_the_first() -> None:
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    rotation = Rotation3.exp(np.stack([0 * angles, angles, 0 * angles], 1))
    centers = np.einsum("kji,j->ki", rotation.matrix, np.array([0, 0, -5.0]))
    flat = model_of(centers, np.zeros((0, 3)))
    translation = -np.einsum("kij,kj->ki", rotation.matrix, centers)
    model = Reconstruction(
        **{name: getattr(flat, name) for name in flat.__slots__} | {"cams_from_world": Rigid3(rotation, translation)}
    )
    view = choose_view(model, azimuth=0.0, elevation=0.0)
    np.testing.assert_allclose(view.axes[2], [0, 0, 1], atol=1e-9)


def test_a_picture_of_a_model_has_its_points_and_its_frusta() -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(size=(300, 3)) + np.array([0, 0, 8.0])
    model = model_of(np.array([[-1.0, 0, 0], [1, 0, 0]]), points, np.tile([0, 90, 0], (300, 1)))
    picture = render_model(model, 200, 150)
    assert picture.shape == (150, 200, 3)
    assert picture.dtype == np.uint8
    assert (picture == np.array([0, 90, 0])).all(2).sum() > 100
    assert (np.abs(picture.astype(int) - FRUSTUM_COLOR).max(2) < 40).sum() > 20
    np.testing.assert_array_equal(picture, render_model(model, 200, 150))


def test_frusta_are_sized_by_the_spacing_of_the_cameras_within_the_scene() -> None:
    points = np.random.default_rng(3).normal(size=(100, 3)) + np.array([0, 0, 10.0])
    near = default_frustum_size(model_of(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]), points))
    np.testing.assert_allclose(near, 0.5)
    alone = default_frustum_size(model_of(np.zeros((1, 3)), points))
    assert 0.5 < alone < 3
    coincident = default_frustum_size(model_of(np.zeros((3, 3)), points))
    assert 0 < coincident < 1
    assert default_frustum_size(model_of(np.zeros((0, 3)), points)) == 0


def test_impossible_views_and_sizes_are_refused() -> None:
    model = model_of(np.zeros((1, 3)), np.zeros((0, 3)))
    with pytest.raises(ValueError, match="line of sight"):
        View(np.zeros(3), np.zeros(3), np.array([0.0, 1, 0]))
    with pytest.raises(ValueError, match="line of sight"):
        View(np.zeros(3), np.array([0.0, 2, 0]), np.array([0.0, 1, 0]))
    with pytest.raises(ValueError, match="field of view"):
        View(np.zeros(3), np.array([0.0, 0, 1]), np.array([0.0, 1, 0]), fov=4.0)
    with pytest.raises(ValueError, match="no pixels"):
        render_model(model, 0, 10)
    with pytest.raises(ValueError, match="without images"):
        choose_view(model_of(np.zeros((0, 3)), np.zeros((5, 3))))


def test_a_single_camera_without_points_still_gives_a_picture() -> None:
    picture = render_model(model_of(np.zeros((1, 3)), np.zeros((0, 3))), 60, 40)
    assert (picture != np.array(BACKGROUND)).any()
