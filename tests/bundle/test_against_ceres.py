"""The same problems through pycolmap's Ceres.

pycolmap has no Python type for Ceres' problem, so neither its residuals nor its gradient can be asked for. Its summary
tells the cost at the start to the last digit, and where a tolerance is met at once, the largest entry of the gradient
there to seven digits. With one parameter or one point free at a time, that is its gradient entry by entry.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection

import numpy as np
import pycolmap
import pytest
from pycolmap import pyceres

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, adjust, covariance
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew

LOSSES = {
    "trivial": pycolmap.LossFunctionType.TRIVIAL,
    "huber": pycolmap.LossFunctionType.HUBER,
    "soft_l1": pycolmap.LossFunctionType.SOFT_L1,
    "cauchy": pycolmap.LossFunctionType.CAUCHY,
}


MODELS = {
    "PINHOLE": [1280.0, 1270.0, 512.0, 384.0],
    "SIMPLE_RADIAL": [1280.0, 512.0, 384.0, 0.05],
    "OPENCV": [1280.0, 1270.0, 512.0, 384.0, -0.05, 0.02, 0.001, -0.002],
    "FULL_OPENCV": [1280.0, 1270.0, 512.0, 384.0, -0.05, 0.02, 0.001, -0.002, 0.003, 0.01, 0.002, 0.001],
    "OPENCV_FISHEYE": [900.0, 910.0, 512.0, 384.0, 0.02, -0.005, 0.001, -0.0002],
    "EUCM": [900.0, 910.0, 512.0, 384.0, 0.6, 1.1],
}


def synthetic(
    frames: int, points: int, noise_px: float, model: str = "SIMPLE_RADIAL", seed: int = 1
) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 2, frames // 2, points
    options.num_points2D_without_point3D = 0
    options.camera_model_id, options.camera_params = getattr(pycolmap.CameraModelId, model), MODELS[model]
    reconstruction = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev = noise_px, 0.02
    noise.rig_from_world_translation_stddev, noise.rig_from_world_rotation_stddev = 0.02, 0.3
    pycolmap.synthesize_noise(noise, reconstruction)
    return reconstruction


def problem_of(reconstruction: pycolmap.Reconstruction, refine: bool) -> BundleProblem:
    cameras, images = sorted(reconstruction.cameras), sorted(reconstruction.reg_image_ids())
    points = sorted(reconstruction.points3D)
    params, free = np.zeros((len(cameras), MAX_PARAMS)), np.zeros((len(cameras), MAX_PARAMS), bool)
    for row, camera_id in enumerate(cameras):
        camera = reconstruction.cameras[camera_id]
        params[row, : len(camera.params)] = camera.params
        free[row, [*camera.focal_length_idxs(), *camera.extra_params_idxs()]] = refine
    poses = [reconstruction.images[k].cam_from_world() for k in images]
    observations = [
        (images.index(element.image_id), row, *reconstruction.images[element.image_id].points2D[element.point2D_idx].xy)
        for row, point in enumerate(points)
        for element in reconstruction.points3D[point].track.elements
    ]
    table = np.array(observations)
    return BundleProblem(
        model_ids=np.array([int(reconstruction.cameras[k].model) for k in cameras], np.int32),
        camera_params=params,
        image_cameras=np.array([cameras.index(reconstruction.images[k].camera_id) for k in images], np.int32),
        cams_from_world=Rigid3(
            Rotation3(np.array([p.rotation.quat for p in poses])[:, [3, 0, 1, 2]]),
            np.array([p.translation for p in poses]),
        ),
        points3D=np.array([reconstruction.points3D[k].xyz for k in points]),
        obs_images=table[:, 0].astype(np.int32),
        obs_points=table[:, 1].astype(np.int32),
        obs_points2D=np.ascontiguousarray(table[:, 2:]),
        free_params=free,
        free_poses=np.ones(len(images), bool),
        free_points=np.ones(len(points), bool),
    )


@pytest.mark.parametrize("loss", ["trivial", "soft_l1", "cauchy"])
@pytest.mark.parametrize("refine", [True, False])
def test_the_final_cost_is_no_higher_than_that_of_ceres(loss, refine):
    reconstruction = synthetic(frames=8, points=150, noise_px=1.0)
    config = BundleConfig(loss=loss, loss_scale_px=1.0, relative_cost_tolerance=1e-9)
    ours = adjust(problem_of(reconstruction, refine), config)

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = refine
    options.ceres.loss_function_type, options.ceres.loss_function_scale = LOSSES[loss], 1.0
    options.ceres.solver_options.function_tolerance = 1e-12
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(reconstruction, options)
    theirs = adjust(problem_of(reconstruction, refine), BundleConfig(loss=loss, loss_scale_px=1.0, max_iterations=0))

    assert ours.final_cost < 0.5 * ours.initial_cost
    assert theirs.final_cost * (1 - 1e-6) <= ours.final_cost <= theirs.final_cost * (1 + 1e-6)


def ceres(
    reconstruction: pycolmap.Reconstruction, loss: str = "trivial", *, images: Collection[int] = (),
    cameras: Collection[int] = (), points: Collection[int] | None = None, trials: int = 0,
    gradient_tolerance: float = 1e-10,
) -> tuple[pycolmap.CeresBundleAdjuster, pyceres.SolverSummary]:  # fmt: skip
    """Ceres after so many trials, from which all that is not listed is held constant; None lists all points."""
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.print_summary = False
    options.refine_principal_point = True
    options.ceres.loss_function_type, options.ceres.loss_function_scale = LOSSES[loss], 1.0
    solver = options.ceres.solver_options
    solver.max_num_iterations, solver.gradient_tolerance, solver.num_threads = trials, gradient_tolerance, 1
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
        if image_id not in images:
            config.set_constant_rig_from_world_pose(reconstruction.images[image_id].frame_id)
    for camera_id in set(reconstruction.cameras) - set(cameras):
        config.set_constant_cam_intrinsics(camera_id)
    for point_id in set() if points is None else set(reconstruction.points3D) - set(points):
        config.add_constant_point(point_id)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    return adjuster, adjuster.solve().ceres_summary  # type: ignore[attr-defined]


def largest_gradient(summary: pyceres.SolverSummary) -> float:
    """That of the start, of a run whose tolerance it met there."""
    found = re.search(r"Gradient max norm: (\S+) <=", summary.message)
    assert found is not None, summary.message
    return float(found[1])


def with_free(problem: BundleProblem, *, params=(), poses=(), points=()) -> BundleProblem:
    """`problem` with nothing free but these rows."""
    free_params = np.zeros_like(problem.free_params)
    for camera, k in params:
        free_params[camera, k] = True
    return dataclasses.replace(
        problem,
        free_params=free_params,
        free_poses=np.isin(np.arange(len(problem.free_poses)), list(poses)),
        free_points=np.isin(np.arange(len(problem.free_points)), list(points)),
    )


@pytest.mark.parametrize("loss", list(LOSSES))
@pytest.mark.parametrize("model", list(MODELS))
def test_the_cost_is_that_of_ceres(model, loss):
    reconstruction = synthetic(6, 80, noise_px=2.0, model=model)
    ours = adjust(problem_of(reconstruction, False), BundleConfig(loss=loss, max_iterations=0))
    _, theirs = ceres(reconstruction, loss)
    assert ours.invalid == 0
    # What Ceres finds constant it counts apart.
    assert ours.final_cost == pytest.approx(theirs.initial_cost + theirs.fixed_cost, rel=1e-11)


@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_the_gradient_of_a_point_is_that_of_ceres(loss):
    reconstruction = synthetic(6, 12, noise_px=2.0)
    problem, config = problem_of(reconstruction, False), BundleConfig(loss=loss, max_iterations=0)
    for row, point_id in enumerate(sorted(reconstruction.points3D)):
        ours = adjust(with_free(problem, points=[row]), config).table[0].gradient_max
        _, theirs = ceres(reconstruction, loss, points=[point_id], trials=1, gradient_tolerance=1e30)
        assert ours == pytest.approx(largest_gradient(theirs), rel=1e-6)


@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
@pytest.mark.parametrize("model", list(MODELS))
def test_the_gradient_of_the_camera_parameters_is_that_of_ceres(model, loss):
    """Its largest entry by what Ceres tells, each entry by central differences of Ceres' cost."""
    reconstruction = synthetic(6, 80, noise_px=2.0, model=model)
    problem, config = problem_of(reconstruction, False), BundleConfig(loss=loss, max_iterations=0)
    count = len(MODELS[model])
    gradients = [adjust(with_free(problem, params=[(0, k)]), config).table[0].gradient_max for k in range(count)]
    first = min(reconstruction.cameras)
    _, theirs = ceres(reconstruction, loss, cameras=[first], points=[], trials=1, gradient_tolerance=1e30)
    assert max(gradients) == pytest.approx(largest_gradient(theirs), rel=1e-6)
    camera, params = reconstruction.cameras[first], np.array(reconstruction.cameras[first].params)
    for k, gradient in enumerate(gradients):
        step, costs = 3e-6 * max(abs(params[k]), 1.0), []
        for sign in (1, -1):
            camera.params = (params + sign * step * (np.arange(count) == k)).tolist()
            _, moved = ceres(reconstruction, loss)
            costs.append(moved.initial_cost + moved.fixed_cost)
        camera.params = params.tolist()
        assert gradient == pytest.approx(abs(costs[0] - costs[1]) / (2 * step), rel=1e-5, abs=1e-6 * max(gradients))


@pytest.mark.parametrize("loss", ["trivial", "cauchy"])
def test_our_minimum_is_one_to_ceres(loss):
    """With two poses held on both sides, nothing else fixes the gauge: the same unknowns, the same minimum."""
    reconstruction = synthetic(8, 150, noise_px=1.0)
    images, points = sorted(reconstruction.reg_image_ids()), sorted(reconstruction.points3D)
    problem = problem_of(reconstruction, True)
    problem = dataclasses.replace(problem, free_poses=np.arange(len(images)) >= 2)
    _, start = ceres(
        reconstruction, loss, images=images[2:], cameras=reconstruction.cameras, trials=1, gradient_tolerance=1e30
    )
    config = BundleConfig(loss=loss, relative_cost_tolerance=1e-14, max_iterations=200)
    problem = dataclasses.replace(problem, free_params=problem.camera_params != 0)
    best = adjust(problem, config).problem
    for row, camera_id in enumerate(sorted(reconstruction.cameras)):
        reconstruction.cameras[camera_id].params = best.camera_params[row, :4].tolist()
    for row, image_id in enumerate(images):
        pose = pycolmap.Rigid3d(best.cams_from_world.matrix[row][:3])
        reconstruction.frames[reconstruction.images[image_id].frame_id].rig_from_world = pose
    for row, point_id in enumerate(points):
        reconstruction.points3D[point_id].xyz = best.points3D[row]
    _, there = ceres(
        reconstruction, loss, images=images[2:], cameras=reconstruction.cameras, trials=1, gradient_tolerance=1e30
    )
    assert largest_gradient(there) < 1e-6 * largest_gradient(start)


@pytest.fixture(scope="module")
def covariances():
    """Ours and theirs at the same minimum, the first two images held, all camera parameters free."""
    reconstruction = synthetic(8, 200, noise_px=0.5)
    images = sorted(reconstruction.reg_image_ids())
    adjuster, _ = ceres(reconstruction, images=images[2:], cameras=reconstruction.cameras, trials=100)
    options = pycolmap.BACovarianceOptions()
    options.damping = 0.0
    theirs = pycolmap.estimate_ba_covariance(options, reconstruction, adjuster)
    problem = problem_of(reconstruction, True)
    problem = dataclasses.replace(
        problem, free_params=problem.camera_params != 0, free_poses=np.arange(len(images)) >= 2
    )
    ours = covariance(problem)
    assert isinstance(ours, BundleCovariance)
    assert theirs is not None
    return reconstruction, problem, ours, theirs, adjuster


def test_poses_and_centres_are_as_uncertain_as_by_ceres(covariances):
    """Compared by what does not depend on how a tangent is written: the axes of the rotation's ellipsoid, centres."""
    _, problem, ours, theirs, _ = covariances
    assert not ours.poses[:2].any()
    R, t = problem.cams_from_world.rotation.matrix, problem.cams_from_world.translation
    # Their tangent of a rotation is half an angle, from the left; that of a translation is added to it.
    double = np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
    for row in range(2, len(R)):
        cov = theirs.get_cam_cov_from_world(row + 1) * np.outer(double, double)
        axes = np.linalg.eigvalsh(cov[:3, :3])
        np.testing.assert_allclose(np.linalg.eigvalsh(ours.poses[row, :3, :3]), axes, rtol=1e-6)
        J = np.hstack([-R[row].T @ skew(t[row]), -R[row].T])
        center = J @ cov @ J.T
        np.testing.assert_allclose(ours.centers[row], center, rtol=0, atol=1e-6 * np.trace(center))


def test_camera_parameters_are_as_uncertain_as_by_ceres(covariances):
    reconstruction, _, ours, theirs, _ = covariances
    for row, camera_id in enumerate(sorted(reconstruction.cameras)):
        expected = theirs.get_other_params_cov(reconstruction.cameras[camera_id].params)
        sigmas = np.sqrt(np.diag(expected))
        unit = np.outer(sigmas, sigmas)
        np.testing.assert_allclose(ours.params[row, :4, :4] / unit, expected / unit, rtol=0, atol=1e-6)


def test_points_seen_by_constant_cameras_are_as_uncertain_as_by_ceres(covariances):
    """That is what pycolmap tells of a point: with everything else held."""
    reconstruction, problem, _, theirs, _ = covariances
    ours = covariance(with_free(problem, points=range(len(problem.points3D))))
    assert isinstance(ours, BundleCovariance)
    for row, point_id in enumerate(sorted(reconstruction.points3D)):
        expected = theirs.get_point_cov(point_id)
        np.testing.assert_allclose(ours.points3D[row], expected, rtol=0, atol=1e-7 * np.trace(expected))
