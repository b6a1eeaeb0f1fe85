"""The same numbers as pycolmap, up to the range in which a model is one to one.

Near its end, pycolmap's Newton steps land on another branch of the polynomial for a few pixels; those are left out.
Behind the image plane it has rays for the panorama only, and turns those of a polynomial fisheye to the front.
"""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from sfm.core.cameras import COLMAP_MODELS, Camera
from tests.core.cameras.conftest import random_camera


@pytest.fixture(params=[(m, seed) for m in COLMAP_MODELS for seed in range(2)], ids=lambda p: f"{p[0].name}-{p[1]}")
def camera(request: pytest.FixtureRequest) -> Camera:
    info, seed = request.param
    return random_camera(info.name, np.random.default_rng([seed, info.model_id]))


def theirs(camera: Camera) -> pycolmap.Camera:
    return pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=camera.params)


@pytest.mark.parametrize("info", COLMAP_MODELS, ids=lambda info: info.name)
def test_the_table_has_their_ids_and_order(info):
    other = pycolmap.Camera(model=info.name, width=10, height=10, params=np.ones(len(info.param_names)))
    assert int(other.model) == info.model_id
    assert tuple(name.strip() for name in other.params_info.split(",")) == info.param_names
    assert tuple(other.focal_length_idxs()) == info.focal_indices
    assert tuple(other.principal_point_idxs()) == info.principal_point_indices
    assert tuple(other.extra_params_idxs()) == info.extra_indices


def test_projection_agrees(camera, seen_points):
    points = seen_points(500, limit=1.5)
    pixels, valid = camera.project(points)
    assert valid.all()
    np.testing.assert_allclose(pixels, theirs(camera).img_from_cam(points), rtol=0, atol=1e-9)


def test_rays_agree(camera, seen_points):
    pixels = camera.project(seen_points(500, np.pi if camera.model == "EQUIRECTANGULAR" else 1.5))[0]
    rays, valid = camera.unproject(pixels)
    expected = theirs(camera).cam_ray_from_img(pixels)
    within = np.arccos(expected[:, 2]) < camera.max_angle
    assert valid.all()
    assert within.mean() > 0.9
    np.testing.assert_allclose(rays[within], expected[within], rtol=0, atol=1e-9)


def test_normalised_points_agree(camera, seen_points):
    pixels = camera.project(seen_points(500, 1.4))[0]
    rays, valid = camera.unproject(pixels)
    expected = theirs(camera).cam_from_img(pixels)
    within = np.arctan(np.linalg.norm(expected, axis=1)) < camera.max_angle
    assert valid.all()
    assert within.mean() > 0.9
    np.testing.assert_allclose(rays[within, :2] / rays[within, 2:], expected[within], rtol=1e-9, atol=1e-9)


def test_rescaling_agrees(camera):
    other = theirs(camera)
    other.rescale(camera.width // 2, camera.height // 2 + 7)
    ours = camera.scaled(camera.width // 2, camera.height // 2 + 7)
    assert (other.width, other.height) == (ours.width, ours.height)
    np.testing.assert_allclose(ours.params, other.params, rtol=1e-14)
