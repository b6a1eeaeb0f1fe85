from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from datasets.synthetic import Renderer, World, example_camera, look_at, make_scene
from datasets.synthetic import _sampling_kernels as sampling
from datasets.synthetic import _surface_kernels as kernels
from datasets.synthetic import materials as m
from datasets.synthetic import render as module
from datasets.synthetic.render import pixel_centers
from datasets.synthetic.shapes import box, plane
from datasets.synthetic.world import DAYLIGHT, Lamp, Sun
from sfm.core.cameras import MODELS

CAMERA = example_camera("PINHOLE", 96, 72, fov_deg=60)
FLOOR = plane(50, 50, m.bricks((0.4, 0.3, 0.25), 3))


def world(*shapes, lights=(Sun((0.3, 0.2, 1.0), (0.8, 0.8, 0.8)),)) -> World:
    return World(tuple(shapes), tuple(lights), DAYLIGHT, extent=2.0)


def test_depth_and_normals_of_a_plane_are_the_formula():
    pose = look_at((1.0, -3.0, 2.0), (0.2, 0.4, 0.0), roll_deg=5)
    picture = Renderer(world(FLOOR)).render(CAMERA, pose)
    rays = pose.inverse().rotation @ CAMERA.unproject(pixel_centers(CAMERA))[0]
    down = -rays[:, 2].reshape(72, 96)
    z = CAMERA.unproject(pixel_centers(CAMERA))[0][:, 2].reshape(72, 96)
    with np.errstate(divide="ignore"):
        expected = np.where(down > 0, 2.0 / down * z, np.nan)
    seen = np.isfinite(picture.depth)
    assert 0.5 < seen.mean() <= 1
    np.testing.assert_allclose(picture.depth[seen], expected[seen], rtol=1e-12)
    normal = pose.rotation @ np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(picture.normals[seen], np.broadcast_to(normal, (seen.sum(), 3)), atol=1e-12)


@pytest.mark.parametrize("model", [info.name for info in MODELS])
def test_depth_lies_on_the_ray_of_its_pixel_for_every_camera_model(model, orbit, orbit_renderer):
    camera = example_camera(model, 48, 36, fov_deg=70)
    pose = orbit.views[0].cam_from_world
    picture = orbit_renderer.render(camera, pose)
    points, normals = orbit_renderer.surface_points(camera, pose, pixel_centers(camera))
    seen = np.isfinite(picture.depth).ravel()
    assert seen.mean() > 0.4
    in_camera = pose @ points[seen]
    np.testing.assert_allclose(in_camera[:, 2], picture.depth.ravel()[seen], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(camera.project(in_camera)[0], pixel_centers(camera)[seen], atol=1e-6)
    np.testing.assert_allclose(normals[seen] @ pose.rotation.matrix.T, picture.normals.reshape(-1, 3)[seen], atol=1e-12)


def test_normals_are_unit_and_face_the_camera(orbit, orbit_pictures):
    for view, picture in zip(orbit.views, orbit_pictures, strict=True):
        rays = view.camera.unproject(pixel_centers(view.camera))[0].reshape(picture.normals.shape)
        seen = picture.triangles >= 0
        assert np.array_equal(seen, np.isfinite(picture.depth))
        np.testing.assert_allclose(np.linalg.norm(picture.normals[seen], axis=-1), 1, atol=1e-12)
        assert np.einsum("ij,ij->i", picture.normals[seen], rays[seen]).max() <= 0


@pytest.mark.parametrize("model", ["OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "EUCM"])
def test_a_distorted_picture_is_the_pinhole_picture_moved_along_the_rays(model, orbit, orbit_renderer, bilinear):
    pose = orbit.views[0].cam_from_world
    pinhole = example_camera("PINHOLE", 512, 512, fov_deg=80)
    wide = example_camera(model, 192, 128, fov_deg=60)
    reference, picture = orbit_renderer.render(pinhole, pose), orbit_renderer.render(wide, pose)
    rays, _ = wide.unproject(pixel_centers(wide))
    there, valid = pinhole.project(rays)
    inside = valid & np.all((there > 4) & (there < 508), axis=1)
    assert inside.mean() > 0.9
    # The reference has pixels of half the size: the mean over a coarse pixel is that of a patch of the fine one.
    fine = np.apply_along_axis(lambda v: np.convolve(v, [0.25, 0.5, 0.25], "same"), 0, reference.radiance)
    fine = np.apply_along_axis(lambda v: np.convolve(v, [0.25, 0.5, 0.25], "same"), 1, fine)
    errors = [
        np.median(np.abs(bilinear(fine, there[inside] + shift) - picture.radiance.reshape(-1, 3)[inside]))
        for shift in ((0, 0), (2.0, 0), (0, 2.0))
    ]
    assert errors[0] < 0.01
    assert errors[0] < 0.5 * min(errors[1:])


def test_few_rays_give_the_picture_that_many_give(orbit, orbit_renderer, orbit_pictures, monkeypatch):
    """Sampling every pixel by the tent changes little where the texture's own filter was used."""
    monkeypatch.setattr(Renderer, "_needs_samples", lambda self, hits, shape: np.ones(shape, bool))
    full = orbit_renderer.view(orbit.views[0]).radiance
    difference = np.abs(full - orbit_pictures[0].radiance)
    assert 0 < np.median(difference) < 0.01
    assert np.quantile(difference, 0.99) < 0.06


def test_outlines_are_smooth():
    """A pixel on the edge of a dark box before a bright sky has a colour between the two in proportion to its share."""
    dark = box((-1, 0, -50), (1, 1, 50), m.stone((0.02, 0.02, 0.02), 1, contrast=0.0))
    pose = look_at((0, -4, 0), (0, 0, 0), roll_deg=3.0)
    plain_sky = dataclasses.replace(DAYLIGHT, zenith=DAYLIGHT.horizon)
    scene = World((dark,), (), plain_sky, extent=1.0)
    row = Renderer(scene, samples=4).render(CAMERA, pose).radiance[:, :, 2]
    inside, sky = row[36, 48], row[36, 5]
    share = (row - inside) / (sky - inside)
    between = (share > 0.1) & (share < 0.9)
    assert between.any(axis=1).all()
    coarse = Renderer(scene, samples=1).render(CAMERA, pose).radiance[:, :, 2]
    hard = (coarse - inside) / (sky - inside)
    assert not ((hard > 0.1) & (hard < 0.9)).any()


def test_the_number_of_threads_changes_no_bit(orbit):
    view = orbit.views[0]
    pictures = [Renderer(orbit.world, threads=threads).view(view) for threads in (1, 3)]
    for field in dataclasses.fields(pictures[0]):
        np.testing.assert_array_equal(getattr(pictures[0], field.name), getattr(pictures[1], field.name))


def test_the_seed_decides_everything():
    def picture(seed):
        scene = make_scene("facade", images=1, width=48, height=36, seed=seed)
        return Renderer(scene.world).view(scene.views[0]).radiance

    np.testing.assert_array_equal(picture(3), picture(3))
    assert np.abs(picture(3) - picture(4)).mean() > 0.02


def test_pixels_without_a_ray_are_black_and_have_no_depth():
    camera = example_camera("OPENCV_FISHEYE", 96, 96, fov_deg=60)
    narrow = dataclasses.replace(camera, params=np.array([12.0, 12, 48, 48, 0, 0, 0, 0]))
    _, valid = narrow.unproject(pixel_centers(narrow))
    picture = Renderer(world(FLOOR)).render(narrow, look_at((0, 0, 2), (3, 0, 0)))
    blind = ~valid.reshape(96, 96)
    assert 0.05 < blind.mean() < 0.95
    assert np.all(picture.radiance[blind] == 0)
    assert np.all(np.isnan(picture.depth[blind]))
    assert np.all(picture.radiance[~blind] > 0)


def test_shadows_fall_where_the_light_is_hidden():
    lamp = Lamp((0.0, 0.0, 3.0), (6.0, 6.0, 6.0))
    table = box((-0.5, -0.5, 1.0), (0.5, 0.5, 1.1), m.plaster((0.5, 0.5, 0.5), 2))
    floor = plane(50, 50, m.stone((0.5, 0.5, 0.5), 1, contrast=0.0))
    renderer = Renderer(world(floor, table, lights=(lamp,)))
    pose = look_at((4.0, 0.0, 2.5), (0, 0, 0))
    points = np.array([[0.72, 0.0, 0.0], [0.85, 0.0, 0.0], [0.6, 0.6, 0.0], [0.9, 0.9, 0.0]])
    pixels, _ = CAMERA.project(pose @ points)
    found, _, radiance = renderer.samples(CAMERA, pose, pixels)
    np.testing.assert_allclose(found, points, atol=1e-9)
    # The table's top edge at 1.1 of 3 m throws its shadow to 0.5 · 3 / 1.9 = 0.789 m.
    assert radiance[0].mean() < 0.6 * radiance[1].mean()
    assert radiance[2].mean() < 0.6 * radiance[3].mean()


def test_light_does_not_depend_on_where_it_is_seen_from(rng):
    renderer = Renderer(world(plane(3, 3, m.stone((0.5, 0.5, 0.5), 1, wavelength=5.0))))
    points = np.c_[rng.uniform(-0.5, 0.5, (50, 2)), np.zeros(50)]
    seen = []
    for center in ((3, 0, 3), (-1, 2.5, 4), (0.1, -3, 3.5)):
        pose = look_at(center, (0, 0, 0))
        seen.append(renderer.samples(CAMERA, pose, CAMERA.project(pose @ points)[0])[2])
    assert np.ptp(seen, axis=0).mean() < 0.01
    assert np.std(seen[0]) > 0.03


def test_a_point_is_visible_exactly_where_nothing_stands_before_it():
    renderer = Renderer(world(FLOOR, box((-1, -1, 0), (1, 1, 2), m.stone((0.5, 0.5, 0.5), 1))))
    points = np.array([[0, -3, 0], [0, 3, 0], [0, 1, 1], [0, -1, 1], [0.3, 0.2, 2.0], [np.nan] * 3], float)
    expected = [True, False, False, True, False, False]
    assert renderer.visible(points, np.array([0.0, -6.0, 1.0])).tolist() == expected


def test_a_kernel_keeps_embrees_distance_where_the_ray_lies_in_the_triangle():
    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], float)
    distances, normals = np.empty(2), np.empty((2, 3))
    kernels.resolve(
        np.array([-1.0, 0.2, 0.0]), np.array([[1.0, 0, 0], [0, 0, 1.0]]), np.array([0, kernels.MISS], np.uint32),
        np.array([1.0, np.inf], np.float32), corners, distances, normals,
    )  # fmt: skip
    assert distances[0] == 1.0
    assert np.isnan(distances[1])
    assert np.isnan(normals[1]).all()


def test_the_tent_is_summed_as_by_its_definition(rng):
    refine = rng.random((7, 9)) < 0.3
    s = 3
    nodes = np.full(((7 + 1) * s - 1, (9 + 1) * s - 1), -1, np.int32)
    pixels = np.empty((nodes.size, 2))
    count = sampling.place_nodes(refine, s, nodes, pixels)
    radiance = rng.random((count, 3)).astype(np.float32)
    image = np.zeros((7, 9, 3), np.float32)
    sampling.sum_tent(refine, s, nodes, radiance, image)
    assert np.all(image[~refine] == 0)
    for y, x in np.argwhere(refine):
        offset = pixels[:count] - (x + 0.5, y + 0.5)
        weights = np.clip(1 - np.abs(offset), 0, None).prod(axis=1) / s**2
        assert weights.sum() == pytest.approx(1)
        np.testing.assert_allclose(image[y, x], weights @ radiance, rtol=1e-5)


def test_mixed_pixels_are_found_as_by_their_definition(orbit, orbit_renderer):
    camera = example_camera("PINHOLE", 60, 40)
    pose = orbit.views[0].cam_from_world
    rays, valid = camera.unproject(pixel_centers(camera))
    hits = orbit_renderer._cast(pose.inverse(), rays, valid)
    orbit_renderer._cast_shadows(hits)
    actual = orbit_renderer._needs_samples(hits, (40, 60))
    shapes = np.where(hits.triangle_ids == kernels.MISS, -1, 0)
    shapes[shapes == 0] = orbit_renderer._shapes[hits.triangle_ids[shapes == 0]]
    expected = -np.einsum("ij,ij->i", hits.normals, hits.directions) < module._GRAZING
    for i in range(2400):
        for j in [i + dy * 60 + dx for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy or dx)]:
            if not 0 <= j < 2400 or abs(j % 60 - i % 60) > 1:
                continue
            a, b = min(i, j), max(i, j)
            edge = shapes[a] != shapes[b]
            if not edge and shapes[a] >= 0:
                edge = hits.lit[a, 0] != hits.lit[b, 0]
                if hits.triangle_ids[a] != hits.triangle_ids[b]:
                    away = abs(hits.normals[a] @ (hits.points[b] - hits.points[a]))
                    edge |= bool(hits.normals[a] @ hits.normals[b] < module._CREASE)
                    edge |= bool(away > module._GAP * hits.distances[a])
            expected[i] |= edge
    np.testing.assert_array_equal(actual.ravel(), expected)
    assert 0.05 < expected.mean() < 0.9
