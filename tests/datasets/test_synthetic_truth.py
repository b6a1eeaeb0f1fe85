from __future__ import annotations

import cv2
import numpy as np
import pytest

from datasets.synthetic import (
    NAMES,
    STILL_NAMES,
    Renderer,
    View,
    example_camera,
    flow,
    look_at,
    make_scene,
    reconstruction,
    rectified_pair,
)
from datasets.synthetic.render import pixel_centers
from datasets.synthetic.truth import sightings
from sfm.io.colmap_model import read_model, write_model


@pytest.fixture(scope="module")
def model(orbit, orbit_renderer):
    return reconstruction(orbit, orbit_renderer, points_per_image=800)


def test_observations_are_the_projections_of_their_points(orbit, model):
    points = np.repeat(model.points3D, model.tracks.lengths, axis=0)
    for row, view in enumerate(orbit.views):
        mine = model.image_rows == row
        points2D, valid = view.camera.project(view.cam_from_world @ points[mine])
        assert valid.all()
        np.testing.assert_allclose(points2D, model.observations[mine], atol=1e-9)
        assert np.all((points2D >= 0) & (points2D <= (view.camera.width, view.camera.height)))


def test_every_track_has_two_views_or_more_and_most_have_all(model):
    assert len(model.tracks) > 1000
    assert model.tracks.lengths.min() >= 2
    assert model.tracks.lengths.mean() > 2.5


def test_the_surface_at_an_observation_is_its_point(orbit, orbit_renderer, model):
    """Depth agrees with the points: the ray through the observed pixel ends at the point."""
    points = np.repeat(model.points3D, model.tracks.lengths, axis=0)
    for row, view in enumerate(orbit.views):
        mine = model.image_rows == row
        found, _ = orbit_renderer.surface_points(view.camera, view.cam_from_world, model.observations[mine])
        away = np.linalg.norm(found - points[mine], axis=1)
        assert np.nanmedian(away) < 1e-9
        # A point a hair from an outline may be missed by its own ray.
        assert np.mean(~(away < 1e-5)) < 0.005


def test_points_land_on_the_same_texture_in_every_view(orbit, model, orbit_pictures, bilinear):
    """The photometric residual is that of resampling; two pixels off it is many times that."""
    colors = {}
    for shift in ((0.0, 0.0), (2.0, 0.0), (0.0, 2.0)):
        seen = np.empty((len(model.observations), 3))
        for row, picture in enumerate(orbit_pictures):
            mine = model.image_rows == row
            seen[mine] = bilinear(picture.radiance, model.observations[mine] + (shift if row % 2 else (0.0, 0.0)))
        mean = np.add.reduceat(seen, model.tracks.offsets[:-1]) / model.tracks.lengths[:, None]
        colors[shift] = np.median(np.abs(seen - mean[model.tracks.track_ids]))
    exact, *moved = colors.values()
    assert exact < 0.012
    assert min(moved) > 2.0 * exact


def test_in_closer_pictures_the_photometric_residual_falls(orbit, orbit_renderer, model, bilinear):
    """What remains is the filter of the pixel: it shrinks with the pixel, as a false pose's residual would not."""
    target = model.points3D[model.tracks.lengths == len(orbit.views)][0]
    poses = [look_at(view.cam_from_world.center, target) for view in orbit.views[:2]]
    medians = []
    for scale in (1, 3):
        camera = example_camera("PINHOLE", 120 * scale, 90 * scale, fov_deg=8)
        first, second = (View("close", 1, camera, pose) for pose in poses)
        here, there = orbit_renderer.view(first).radiance, orbit_renderer.view(second).radiance
        moved = flow(orbit_renderer, first, second)
        ends = pixel_centers(camera)[moved.visible.ravel()] + moved.flow[moved.visible]
        medians.append(np.median(np.abs(bilinear(there, ends) - here[moved.visible])))
    assert medians[1] < medians[0]
    assert medians[0] < 0.02


def test_hidden_points_are_not_observed(orbit, orbit_pictures, model):
    """A point behind all that is seen around its pixel is hidden there; there are many such."""
    observed = np.zeros((len(model.tracks), len(orbit.views)), bool)
    observed[model.tracks.track_ids, model.image_rows] = True
    hidden = 0
    for row, (view, picture) in enumerate(zip(orbit.views, orbit_pictures, strict=True)):
        in_camera = view.cam_from_world @ model.points3D
        points2D, valid = view.camera.project(in_camera)
        size = np.array([view.camera.width, view.camera.height])
        inside = valid & np.all((points2D > 1) & (points2D < size - 1), axis=1)
        x, y = points2D[inside].astype(int).T
        around = np.array([picture.depth[b - 1 : b + 2, a - 1 : a + 2].max() for a, b in zip(x, y, strict=True)])
        behind = around < 0.99 * in_camera[inside, 2]
        assert not np.any(behind & observed[inside, row])
        hidden += int(behind.sum())
    assert hidden > 100


def test_flow_carries_one_picture_onto_the_other(orbit, orbit_renderer, orbit_pictures, bilinear):
    moved = flow(orbit_renderer, orbit.views[0], orbit.views[1])
    assert 0.4 < moved.visible.mean() < 1.0
    pixels = pixel_centers(orbit.views[0].camera)[moved.visible.ravel()]
    here = orbit_pictures[0].radiance[moved.visible]
    there = bilinear(orbit_pictures[1].radiance, pixels + moved.flow[moved.visible])
    still = bilinear(orbit_pictures[1].radiance, pixels)
    assert np.median(np.abs(there - here)) < 0.015
    assert np.median(np.abs(still - here)) > 4 * np.median(np.abs(there - here))
    assert np.linalg.norm(moved.flow[moved.visible], axis=1).mean() > 5


def test_pictures_carried_onto_each_other_agree_to_a_hundredth_of_a_pixel(orbit, orbit_renderer, orbit_pictures):
    """The shift that would best explain what is left of the difference, by least squares on the gradient."""
    moved = flow(orbit_renderer, orbit.views[0], orbit.views[1])
    here, there = (picture.radiance.mean(axis=-1) for picture in orbit_pictures[:2])
    ends = (pixel_centers(orbit.views[0].camera).reshape(moved.flow.shape) + moved.flow - 0.5).astype(np.float32)
    difference = cv2.remap(there, ends[..., 0], ends[..., 1], cv2.INTER_CUBIC) - here
    inner = cv2.erode(moved.visible.astype(np.uint8), np.ones((5, 5))) > 0
    inner &= np.abs(difference) < 0.1
    gradient = np.stack(np.gradient(here), axis=-1)[inner]
    shift = np.linalg.lstsq(gradient, difference[inner], rcond=None)[0]
    assert np.abs(shift).max() < 0.01


def test_flow_there_and_back_is_nothing(orbit, orbit_renderer):
    first, second = orbit.views[:2]
    there = flow(orbit_renderer, first, second)
    ends = (pixel_centers(first.camera).reshape(there.flow.shape) + there.flow)[there.visible]
    found, normals = orbit_renderer.surface_points(second.camera, second.cam_from_world, ends)
    back, _ = sightings(orbit_renderer, first, found, normals)
    error = np.linalg.norm(back - pixel_centers(first.camera)[there.visible.ravel()], axis=1)
    assert np.nanmedian(error) < 1e-9
    assert np.nanmean(error > 1e-3) < 0.01


def test_flow_to_the_same_view_is_zero(orbit, orbit_renderer, orbit_pictures):
    still = flow(orbit_renderer, orbit.views[0], orbit.views[0])
    seen = np.isfinite(orbit_pictures[0].depth)
    np.testing.assert_allclose(still.flow[seen], 0, atol=1e-8)
    assert np.all(np.isnan(still.flow[~seen]))
    assert still.visible[seen].mean() > 0.97


def test_disparity_is_the_flow_along_the_row(bilinear):
    scene = make_scene("room", images=1, seed=2)
    renderer = Renderer(scene.world)
    camera = example_camera("PINHOLE", 160, 120, fov_deg=70)
    pair = rectified_pair(renderer, camera, scene.views[0].cam_from_world, 0.1)
    assert np.isfinite(pair.disparity).all()
    np.testing.assert_allclose(pair.disparity * pair.left.depth, camera.focal_lengths[0] * 0.1)
    pixels = pixel_centers(camera)[pair.visible.ravel()]
    shifted = pixels - np.c_[pair.disparity[pair.visible], np.zeros(len(pixels))]
    here = pair.left.radiance[pair.visible]
    residual = np.median(np.abs(bilinear(pair.right.radiance, shifted) - here))
    assert residual < 0.015
    assert np.median(np.abs(bilinear(pair.right.radiance, pixels) - here)) > 2 * residual
    assert 0.6 < pair.visible.mean() < 1
    with pytest.raises(ValueError, match="pinhole"):
        rectified_pair(renderer, example_camera("OPENCV", 32, 24), scene.views[0].cam_from_world, 0.1)
    with pytest.raises(ValueError, match="baseline"):
        rectified_pair(renderer, camera, scene.views[0].cam_from_world, 0.0)


@pytest.mark.parametrize("name", NAMES)
def test_each_scene_ties_its_views_together(name):
    """Neighbours share many points, depths are those of the place, and little is overexposed or black."""
    scene = make_scene(name, images=6, width=96, height=72)
    renderer = Renderer(scene.world)
    model = reconstruction(scene, renderer, points_per_image=150)
    seen = np.zeros((len(model.tracks), len(scene.views)), bool)
    seen[model.tracks.track_ids, model.image_rows] = True
    for row in range(len(scene.views) - 1):
        assert (seen[:, row] & seen[:, row + 1]).sum() > 60, row
    picture = renderer.view(scene.views[2])
    assert np.isfinite(picture.depth).mean() > 0.5
    assert 0.02 < np.nanmedian(picture.depth) / scene.world.extent < 4
    assert (picture.radiance > 1).mean() < 0.03
    assert 0.1 < picture.radiance.mean() < 0.5
    assert picture.radiance.std() > 0.05


@pytest.mark.parametrize("name", STILL_NAMES)
def test_a_scene_has_the_views_that_were_asked_for(name):
    scene = make_scene(name, images=7, width=64, height=48)
    assert len(scene.views) == len({view.name for view in scene.views}) == 7
    assert len(scene.cameras) == 1
    centers = scene.cams_from_world.center
    assert (
        np.linalg.norm(centers[:, None] - centers, axis=-1)[~np.eye(7, dtype=bool)].min() > 0.005 * scene.world.extent
    )


def test_the_twins_look_alike_where_their_surroundings_do_not():
    """The trap: 26 m apart the same picture but for a poster, the light included."""
    scene = make_scene("twins", images=1)
    renderer = Renderer(scene.world)
    camera = example_camera("PINHOLE", 160, 120, fov_deg=40)
    first, second = (renderer.render(camera, look_at((x, -12, 2), (x, 0, 4.5))).radiance for x in (-13, 13))
    difference = np.abs(first - second).max(axis=-1)
    assert np.mean(difference < 0.01) > 0.8
    assert np.mean(difference > 0.05) > 0.01
    between = renderer.render(camera, look_at((0, -12, 2), (0, 0, 4.5))).radiance
    assert np.mean(np.abs(first - between).max(axis=-1) < 0.01) < 0.1


def test_the_frames_of_the_rig_are_its_images():
    scene = make_scene("rig", images=3, width=64, height=48)
    assert [view.name for view in scene.views[:2]] == ["left/0001", "right/0001"]
    (rig,), poses = scene.rigs, scene.cams_from_world
    for frame in scene.frames:
        left, right = frame.image_ids[1] - 1, frame.image_ids[2] - 1
        np.testing.assert_allclose(poses[left].matrix, frame.rig_from_world.matrix)
        np.testing.assert_allclose(poses[right].matrix, (rig.sensors_from_rig[2] @ frame.rig_from_world).matrix)
        assert np.linalg.norm(poses[left].center - poses[right].center) == pytest.approx(0.4)


def test_a_model_on_disk_is_the_model(tmp_path):
    scene = make_scene("rig", images=3, width=64, height=48)
    model = reconstruction(scene, Renderer(scene.world), points_per_image=60, suffix=".jpg")
    write_model(model, tmp_path / "0")
    again = read_model(tmp_path / "0")
    np.testing.assert_array_equal(again.points3D, model.points3D)
    np.testing.assert_array_equal(again.observations, model.observations)
    assert again.image_names == model.image_names
    assert len(again.frames) == 3


@pytest.mark.parametrize(("name", "images"), [("nowhere", 3), ("orbit", 0)])
def test_a_scene_that_cannot_be_made_is_refused(name, images):
    with pytest.raises(ValueError, match=r"unknown scene|at least one"):
        make_scene(name, images=images)
