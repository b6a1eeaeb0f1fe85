"""`sfm refine` on models of pycolmap: as a process, and what it is made of."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from sfm.bundle import BundleConfig, BundleCovariance
from sfm.core.errors import InputError, Rejected
from sfm.io.colmap_model import read_model
from sfm.pipeline.refinement import RefinementConfig, refine_model
from tests.cli.test_cli import assert_one_line

NOISE_PX = 0.5


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model whose poses, points and focal length are off, and whose keypoints have noise."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 8, 300
    options.num_points2D_without_point3D = 5
    reconstruction = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev = NOISE_PX, 0.02
    noise.rig_from_world_translation_stddev, noise.rig_from_world_rotation_stddev = 0.02, 0.3
    pycolmap.synthesize_noise(noise, reconstruction)
    (camera,) = reconstruction.cameras.values()
    params = camera.params.copy()
    params[0] *= 1.02
    camera.params = params
    folder = tmp_path_factory.mktemp("disturbed") / "model"
    folder.mkdir()
    reconstruction.write(folder)
    return folder


def test_a_model_of_colmap_is_refined_to_what_ceres_makes_of_it(sfm, disturbed, tmp_path):
    result = sfm("refine", disturbed, "-o", "refined", "--refine", "focal,distortion", "--sigmas", "--json")
    assert result.returncode == 0, result.stderr
    told = json.loads(result.stdout)
    theirs = pycolmap.Reconstruction(disturbed)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.TRIVIAL
    options.ceres.solver_options.function_tolerance = 1e-10
    pycolmap.bundle_adjustment(theirs, options)
    ours = pycolmap.Reconstruction(tmp_path / "refined")
    assert ours.compute_mean_reprojection_error() == pytest.approx(theirs.compute_mean_reprojection_error(), rel=1e-4)
    (camera,), (reference,) = ours.cameras.values(), theirs.cameras.values()
    np.testing.assert_allclose(camera.params, reference.params, rtol=1e-4, atol=1e-5)
    assert ours.num_points3D() == theirs.num_points3D()
    assert all(len(ours.images[k].points2D) == len(theirs.images[k].points2D) for k in theirs.images)
    assert told["final_cost"] < told["initial_cost"] / 100
    assert told["reason"] == "relative_cost"
    (cameras,) = told["cameras"].values()
    truth = read_model(disturbed).cameras[1].params[0] / 1.02
    assert abs(cameras["params"]["f"] - truth) < 4 * cameras["sigmas"]["f"] < 0.05 * truth
    assert "cx" not in cameras["sigmas"]


def test_what_is_held_stays_to_the_last_bit(disturbed):
    model = read_model(disturbed)
    held = refine_model(model, RefinementConfig(intrinsics=(), points=False)).reconstruction
    assert held.points3D.tobytes() == model.points3D.tobytes()
    assert held.cameras[1].params.tobytes() == model.cameras[1].params.tobytes()
    assert not np.array_equal(held.cams_from_world.translation, model.cams_from_world.translation)
    held = refine_model(model, RefinementConfig(intrinsics=("focal",), poses=False)).reconstruction
    assert held.cams_from_world.translation.tobytes() == model.cams_from_world.translation.tobytes()
    assert held.cameras[1].params[0] != model.cameras[1].params[0]
    nothing = refine_model(model, RefinementConfig(intrinsics=(), poses=False, points=False))
    assert nothing.result.reason == "no_free_parameters"


def test_the_noise_is_found_and_the_focal_length_is_as_certain_as_it_claims(disturbed):
    refined = refine_model(read_model(disturbed), with_covariance=True)
    assert isinstance(refined.covariance, BundleCovariance)
    count = 2 * len(refined.result.problem.obs_images)
    assert np.sqrt(2 * refined.result.final_cost / count) == pytest.approx(NOISE_PX, rel=0.15)


def test_a_summary_says_whether_it_has_converged(sfm, disturbed, tmp_path):
    result = sfm("refine", disturbed, "-o", "one", "--max-iterations", "1", "--loss", "soft_l1", "--text")
    assert result.returncode == 0, result.stderr
    assert "NOT CONVERGED" in result.stdout
    assert (tmp_path / "one" / "cameras.txt").exists()


def test_an_image_with_two_points_gets_no_nan_and_no_sigma(disturbed, tmp_path):
    reconstruction = pycolmap.Reconstruction(disturbed)
    image = reconstruction.images[4]
    seen = [k for k, point in enumerate(image.points2D) if point.has_point3D()]
    for k in seen[2:]:
        reconstruction.delete_observation(4, k)
    (tmp_path / "few").mkdir()
    reconstruction.write(tmp_path / "few")
    refined = refine_model(read_model(tmp_path / "few"), with_covariance=True)
    assert isinstance(refined.covariance, Rejected)
    assert refined.to_json()["undetermined"] == f"the pose of {image.name}"
    assert np.isfinite(refined.reconstruction.cams_from_world.translation).all()
    assert np.isfinite(refined.reconstruction.points3D).all()


def test_models_that_cannot_be_adjusted_are_told(sfm, disturbed, tmp_path):
    assert_one_line(sfm("refine", disturbed, "-o", disturbed), 3, "both source and target")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--refine", "focus"), 2, "knows no 'focus'")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--loss", "l7"), 2, "choose one of trivial")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--loss-scale", "-1"), 2, "must be positive")
    behind = pycolmap.Reconstruction(disturbed)
    for image_id in list(behind.images):
        frame = behind.images[image_id].frame
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, 0.0, -1000.0]))
    (tmp_path / "behind").mkdir()
    behind.write(tmp_path / "behind")
    assert_one_line(sfm("refine", "behind", "-o", "out"), 3, "no observation of this model has a projection")


def test_rigs_are_refused_before_they_come_apart(tmp_path):
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 2, 4, 50
    (tmp_path / "rig").mkdir()
    pycolmap.synthesize_dataset(options).write(tmp_path / "rig")
    with pytest.raises(InputError, match="rig"):
        refine_model(read_model(tmp_path / "rig"), RefinementConfig(bundle=BundleConfig(max_iterations=1)))
