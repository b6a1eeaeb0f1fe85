"""The same problems through pycolmap's Ceres."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, adjust, covariance
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3

LOSSES = {
    "trivial": pycolmap.LossFunctionType.TRIVIAL,
    "soft_l1": pycolmap.LossFunctionType.SOFT_L1,
    "cauchy": pycolmap.LossFunctionType.CAUCHY,
}


def synthetic(frames: int, points: int, noise_px: float) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 2, frames // 2, points
    options.num_points2D_without_point3D = 0
    reconstruction = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev = noise_px, 0.02
    noise.rig_from_world_translation_stddev, noise.rig_from_world_rotation_stddev = 0.02, 0.3
    pycolmap.synthesize_noise(noise, reconstruction)
    return reconstruction


def problem_of(reconstruction: pycolmap.Reconstruction, refine: bool) -> BundleProblem:
    cameras, images = sorted(reconstruction.cameras), sorted(reconstruction.reg_image_ids())
    points = sorted(reconstruction.points3D)
    params, free = np.zeros((len(cameras), 12)), np.zeros((len(cameras), 12), bool)
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


@pytest.mark.parametrize("loss", list(LOSSES))
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


def test_rotations_are_as_uncertain_as_by_ceres():
    """Seen from the image that both hold, rotations do not depend on how the scale is held."""
    reconstruction = synthetic(8, 200, noise_px=0.5)
    options, config = pycolmap.BundleAdjustmentOptions(), pycolmap.BundleAdjustmentConfig()
    options.print_summary = options.refine_focal_length = options.refine_extra_params = False
    pycolmap.bundle_adjustment(reconstruction, options)
    images = sorted(reconstruction.reg_image_ids())
    for image_id in images:
        config.add_image(image_id)
        config.set_constant_cam_intrinsics(reconstruction.images[image_id].camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)
    theirs = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), reconstruction, adjuster)
    ours = covariance(problem_of(reconstruction, refine=False))
    assert isinstance(ours, BundleCovariance)
    assert not ours.poses[0].any()  # the same image is held
    for row, image_id in list(enumerate(images))[2:]:
        # Their tangent of a rotation is half an angle.
        rotation = 4 * theirs.get_cam_cov_from_world(image_id)[:3, :3]
        np.testing.assert_allclose(ours.poses[row, :3, :3], rotation, rtol=1e-4, atol=1e-5 * np.trace(rotation))
