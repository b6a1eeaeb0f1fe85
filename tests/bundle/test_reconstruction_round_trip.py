from __future__ import annotations

import numpy as np
import pytest

from sfm.bundle import adjust, free_params_of, problem_from_reconstruction, squared_errors, update_reconstruction
from sfm.core.cameras import Camera
from sfm.core.cameras.models import model_by_name
from sfm.core.scene import Reconstruction, Tracks


@pytest.fixture
def reconstruction(make_problem, rng):
    """The poses and points of a problem, with camera and image ids that are not row numbers."""
    problem = make_problem(rng, model="SIMPLE_RADIAL", noise_px=0.5, cameras=1)
    images, points = len(problem.free_poses), len(problem.points3D)
    by_image = np.argsort(problem.obs_images, kind="stable")
    offsets = np.searchsorted(problem.obs_images[by_image], np.arange(images + 1))
    feature = np.empty(len(by_image), np.int32)
    feature[by_image] = np.arange(len(by_image)) - offsets[problem.obs_images[by_image]]
    by_point = np.argsort(problem.obs_points, kind="stable")
    image_ids = 10 + 3 * np.arange(images, dtype=np.int32)
    tracks = Tracks(
        np.searchsorted(problem.obs_points[by_point], np.arange(points + 1)),
        image_ids[problem.obs_images[by_point]],
        feature[by_point],
    )
    camera = Camera("SIMPLE_RADIAL", 1000, 760, problem.camera_params[0, :4])
    return problem, Reconstruction(
        cameras={4: camera, 7: camera},
        image_ids=image_ids,
        image_names=tuple(f"{k}.jpg" for k in range(images)),
        image_camera_ids=np.where(np.arange(images) % 2, 7, 4).astype(np.int32),
        cams_from_world=problem.cams_from_world,
        keypoint_offsets=offsets,
        keypoints=problem.obs_points2D[by_image],
        points3D=problem.points3D,
        point_ids=np.arange(points) + 100,
        colors=np.zeros((points, 3), np.uint8),
        errors=np.full(points, -1.0),
        tracks=tracks,
    )


def test_a_reconstruction_becomes_the_problem_that_it_is(reconstruction):
    problem, model = reconstruction
    made = problem_from_reconstruction(model)
    order, made_order = (np.lexsort((p.obs_images, p.obs_points)) for p in (problem, made))
    assert np.array_equal(made.obs_images[made_order], problem.obs_images[order])
    assert np.array_equal(made.obs_points[made_order], problem.obs_points[order])
    assert np.array_equal(made.obs_points2D[made_order], problem.obs_points2D[order])
    assert made.image_cameras.tolist() == [0, 1, 0, 1, 0, 1]
    assert made.free_params.sum(axis=1).tolist() == [2, 2]
    assert made.free_poses.all()
    assert made.free_points.all()


def test_the_adjusted_problem_goes_back_with_its_errors(reconstruction):
    _, model = reconstruction
    result = adjust(problem_from_reconstruction(model))
    after = update_reconstruction(model, result.problem)
    assert list(after.cameras) == [4, 7]
    for row, camera in zip(result.problem.camera_params, after.cameras.values(), strict=True):
        assert np.array_equal(camera.params, row[:4])
    assert np.array_equal(after.points3D, result.problem.points3D)
    assert np.array_equal(after.cams_from_world.matrix, result.problem.cams_from_world.matrix)
    errors = np.sqrt(squared_errors(result.problem))
    for p in (0, 17):
        assert after.errors[p] == pytest.approx(errors[result.problem.obs_points == p].mean(), rel=1e-12)
    assert 0.1 < after.errors.mean() < 1.0


def test_kinds_of_parameters_are_found_by_name():
    opencv, equirectangular = model_by_name("OPENCV"), model_by_name("EQUIRECTANGULAR")
    assert np.flatnonzero(free_params_of(opencv, ("focal",))).tolist() == [0, 1]
    assert np.flatnonzero(free_params_of(opencv, ("principal_point", "extra"))).tolist() == [2, 3, 4, 5, 6, 7]
    assert not free_params_of(opencv, ()).any()
    assert not free_params_of(equirectangular, ("focal", "principal_point", "extra")).any()
