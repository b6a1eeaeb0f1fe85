"""`sfm refine` on models of pycolmap: as a process, and what it is made of."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from sfm.bundle import BundleConfig
from sfm.cli.refine_report import summary
from sfm.core.errors import InputError, Rejected
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.similarity import Sim3
from sfm.core.scene.transformation import transformed
from sfm.io.colmap_model import read_model
from sfm.pipeline.refined_model import Uncertainty
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


def test_a_focal_length_that_ends_on_a_bound_is_named(sfm, disturbed, tmp_path):
    present = read_model(disturbed).cameras[1].params[0]
    bounds = ("--bounds", "focal=0.995:,distortion=-1:1")
    result = sfm("refine", disturbed, "-o", "bounded", "--refine", "focal,distortion", "--sigmas", *bounds)
    assert result.returncode == 0, result.stderr
    assert "camera 1: f ended on a bound" in result.stdout
    assert read_model(tmp_path / "bounded").cameras[1].params[0] == 0.995 * present
    result = sfm("refine", disturbed, "-o", "within", "--refine", "focal", "--bounds", "focal=0.9:1.1", "--json")
    assert "at_bounds" not in json.loads(result.stdout)


@pytest.mark.parametrize(
    ("bounds", "told"),
    [
        ("focal=1.2:0.8", "does not know 'focal=1.2:0.8'"),
        ("focal=a:b", "does not know 'focal=a:b'"),
        ("zoom=1:2", "does not know 'zoom=1:2'"),
        ("focal=1.1:1.2", "must contain 1"),
        ("pp=-5:5", "may not change"),
        ("distortion=0.5:1", "k of camera 1 is .* out of its bounds 0.5..1"),
    ],
)
def test_bounds_that_cannot_be_are_refused(sfm, disturbed, bounds, told):
    result = sfm("refine", disturbed, "-o", "refused", "--refine", "focal,distortion", "--bounds", bounds)
    assert_one_line(result, 3 if "out of" in told else 2, told)


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
    assert isinstance(refined.uncertainty, Uncertainty)
    assert refined.uncertainty.keypoint_sigma_px == refined.uncertainty.noise_px == pytest.approx(NOISE_PX, rel=0.05)
    count = 2 * len(refined.result.problem.obs_images)
    assert np.sqrt(2 * refined.result.final_cost / count) == pytest.approx(NOISE_PX, rel=0.15)


def test_parameters_that_are_known_stay_near(disturbed):
    model = read_model(disturbed)
    known = RefinementConfig(intrinsics=("focal", "principal_point"), focal_sigma=1e-3, principal_point_sigma=1e-3)
    camera = refine_model(model, known).reconstruction.cameras[1]
    np.testing.assert_allclose(camera.params[:3], model.cameras[1].params[:3], atol=0.1)
    vaguely = dataclasses.replace(known, focal_sigma=1e3)
    assert refine_model(model, vaguely).reconstruction.cameras[1].params[0] < model.cameras[1].params[0] - 5
    with pytest.raises(ValueError, match="focal_sigma must be positive"):
        RefinementConfig(focal_sigma=0.0)


@pytest.mark.parametrize("pixel_sigma", [0.3, 1.0])
def test_a_principal_point_that_is_known_is_as_certain_as_it_claims(disturbed, pixel_sigma):
    """Over repeated measurements of keypoints and of the camera; what residuals show does not make it surer."""
    truth = refine_model(read_model(disturbed), RefinementConfig(intrinsics=())).reconstruction
    camera, rng = truth.cameras[1], np.random.default_rng(0)
    rows = truth.keypoint_offsets[truth.image_rows] + truth.tracks.feature_ids
    places = truth.cams_from_world[truth.image_rows] @ truth.points3D[truth.tracks.track_ids]
    exact = truth.keypoints.copy()
    exact[rows] = camera.project(places)[0]
    config = RefinementConfig(intrinsics=("principal_point",), principal_point_sigma=0.2, pixel_sigma=pixel_sigma)
    off, stated = [], []
    for _ in range(60):
        params = camera.params.copy()
        params[1:3] += 0.2 * rng.normal(size=2)
        noisy = exact + 0.3 * rng.normal(size=exact.shape)
        known = dataclasses.replace(truth, cameras={1: dataclasses.replace(camera, params=params)}, keypoints=noisy)
        refined = refine_model(known, config, with_covariance=True)
        assert isinstance(refined.uncertainty, Uncertainty)
        assert refined.uncertainty.keypoint_sigma_px == pixel_sigma
        assert refined.uncertainty.noise_px == pytest.approx(0.3, rel=0.1)
        off.append(refined.reconstruction.cameras[1].params[1:3] - camera.params[1:3])
        stated.append(np.sqrt(np.diag(refined.uncertainty.covariance.params[0])[1:3]))
    ratio = np.sqrt(np.mean(np.square(off)) / np.mean(np.square(stated)))
    assert 0.85 < ratio < 1.15


def test_a_summary_says_of_which_noise_standard_deviations_are(sfm, disturbed, tmp_path):
    words = ("--refine", "focal,pp", "--sigmas")
    result = sfm("refine", disturbed, "-o", "free", *words)
    assert re.search(r"for the noise that the residuals show, 0\.(49|50)", result.stdout), result.stderr
    result = sfm("refine", disturbed, "-o", "known", *words, "--pp-sigma", "2", "--pixel-sigma", "0.25")
    assert "for keypoints of 0.25 px, as stated (--pixel-sigma); the residuals show 0.4" in result.stdout
    result = sfm("refine", disturbed, "-o", "known", *words, "--pp-sigma", "2", "--json", "--overwrite")
    told = json.loads(result.stdout)["keypoint_sigma_px"]
    assert told["of_sigmas"] == 1
    assert told["of_residuals"] == pytest.approx(NOISE_PX, rel=0.1)


def test_residuals_are_told_in_px_whatever_they_are_divided_by(disturbed, tmp_path):
    """Nor do priors of cameras count as residuals, or the scale at which a graduated loss ends."""
    model, graduated = read_model(disturbed), BundleConfig(loss="huber", loss_scale_px=100.0, graduated=True)
    configs = [RefinementConfig(), RefinementConfig(pixel_sigma=0.1), RefinementConfig(bundle=graduated)]
    told = [summary(refine_model(model, config), tmp_path, config.bundle.graduated) for config in configs]
    lines = [text.splitlines()[1] for text in told]
    start = refine_model(model, RefinementConfig(bundle=BundleConfig(max_iterations=0))).rms_px[0]
    assert lines[0].startswith(f"root mean square reprojection error {start:.4f} → 0.")
    assert len({line.split(",")[0] for line in lines}) == 1
    assert [line.endswith("by the last scale of the loss") for line in lines] == [False, False, True]
    known = RefinementConfig(intrinsics=("focal",), focal_sigma=1e-3)
    pressed = refine_model(model, known)
    assert np.mean(pressed.reconstruction.errors) == pytest.approx(pressed.rms_px[1], rel=0.5)
    assert pressed.rms_px[0] == pytest.approx(start)


def test_where_nothing_is_left_over_standard_deviations_are_those_stated(sfm, tmp_path):
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 2, 5
    reconstruction = pycolmap.synthesize_dataset(options)
    (tmp_path / "tiny").mkdir()
    reconstruction.write(tmp_path / "tiny")
    result = sfm("refine", "tiny", "-o", "out", "--refine", "none", "--sigmas", "--json")
    assert result.returncode == 0, result.stderr
    assert "NaN" not in result.stdout
    assert json.loads(result.stdout)["keypoint_sigma_px"] == {"of_sigmas": 1.0, "of_residuals": None}
    result = sfm("refine", "tiny", "-o", "out", "--refine", "none", "--sigmas", "--overwrite")
    assert "no observation is left over to tell their noise" in result.stdout


def table_of(path: Path) -> tuple[list[str], np.ndarray]:
    """First column, and the others; NaN where a cell is empty."""
    rows = [line.split(",") for line in path.read_text().splitlines()[1:]]
    return [row[0] for row in rows], np.array([[float(cell or "nan") for cell in row[1:]] for row in rows])


@pytest.mark.parametrize("gauge", ["cameras", "points", "free"])
def test_tables_beside_the_model_say_how_certain_poses_and_points_are(sfm, disturbed, tmp_path, gauge):
    result = sfm("refine", disturbed, "-o", "out", "--refine", "focal", "--sigmas", "--gauge", gauge, "--json")
    assert result.returncode == 0, result.stderr
    names, poses = table_of(tmp_path / "out" / "pose_sigmas.csv")
    ids, points = table_of(tmp_path / "out" / "point_sigmas.csv")
    kinds: dict[str, Any] = {"cameras": "two_cameras", "points": "three_points", "free": "free"}
    bundle = BundleConfig(relative_cost_tolerance=1e-8, gauge=kinds[gauge])
    model = read_model(disturbed)
    refined = refine_model(model, RefinementConfig(intrinsics=("focal",), bundle=bundle), with_covariance=True)
    assert isinstance(refined.uncertainty, Uncertainty)
    found = refined.uncertainty.covariance
    assert tuple(names) == model.image_names
    assert ids == [str(k) for k in model.point_ids]
    np.testing.assert_allclose(poses[:, :3] ** 2, np.einsum("iaa->ia", found.centers), rtol=1e-4, atol=1e-12)
    turns = np.einsum("iaa->ia", found.poses)[:, :3]
    np.testing.assert_allclose(np.deg2rad(poses[:, 3:]) ** 2, turns, rtol=1e-4, atol=1e-12)
    np.testing.assert_allclose(points**2, np.einsum("iaa->ia", found.points3D), rtol=1e-4, atol=1e-12)
    assert np.sum(np.all(poses == 0, axis=1)) == (gauge == "cameras")
    assert np.sum(np.all(points == 0, axis=1)) == 2 * (gauge == "points")
    told = json.loads(result.stdout)["median_sigmas"]
    lengths = np.linalg.norm(poses[:, :3], axis=1)
    assert told["centers"] == pytest.approx(np.median(lengths[lengths > 0]), rel=1e-4)


def test_tables_of_an_earlier_adjustment_go_with_its_model(sfm, disturbed, tmp_path):
    """And those of a stranger stay: there is nothing to overwrite."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "frame.json").write_text("mine")
    sfm("refine", disturbed, "-o", "out", "--sigmas", "--refine", "none", "--hold", "poses")
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".bin", ".csv", ".json"}
    result = sfm("refine", disturbed, "-o", "out", "--overwrite", "--max-iterations", "1")
    assert result.returncode == 0, result.stderr
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".bin"}


def test_where_all_is_held_nothing_is_uncertain_and_nothing_warns(sfm, disturbed):
    for held in ("poses", "poses,points"):
        words = ("--refine", "none", "--hold", held, "--sigmas", "--overwrite")
        result = sfm("refine", disturbed, "-o", "out", *words)
        assert result.returncode == 0, result.stderr
        assert "DPOTRI" not in result.stdout + result.stderr
        assert ("nothing uncertain" in result.stdout) == (held != "poses")


def test_a_workspace_has_a_place_for_its_adjusted_model(sfm, disturbed, tmp_path):
    (tmp_path / "scene" / "sparse").mkdir(parents=True)
    shutil.copytree(disturbed, tmp_path / "scene" / "sparse" / "0")
    assert_one_line(sfm("refine", disturbed), 2, "-o is missing")
    result = sfm("refine", "scene")
    assert result.returncode == 0, result.stderr
    assert read_model(tmp_path / "scene" / "refined").image_names == read_model(disturbed).image_names
    assert_one_line(sfm("refine", "scene"), 3, "is there already")


def test_a_file_in_the_way_is_told_before_anything_is_adjusted(sfm, disturbed, tmp_path):
    (tmp_path / "file").write_text("mine")
    for target in ("file", "file/in/it"):
        result = sfm("refine", disturbed, "-o", target)
        assert_one_line(result, 3, "is a file, not a folder")
        assert "adjusting" not in result.stderr


def test_a_summary_says_whether_it_has_converged(sfm, disturbed, tmp_path):
    words = ("--max-iterations", "1", "--loss", "soft_l1", "--solver", "dense", "--text")
    result = sfm("refine", disturbed, "-o", "one", *words)
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
    assert isinstance(refined.uncertainty, Rejected)
    assert refined.to_json()["undetermined"] == f"the pose of {image.name}"
    assert np.isfinite(refined.reconstruction.cams_from_world.translation).all()
    assert np.isfinite(refined.reconstruction.points3D).all()


def test_models_that_cannot_be_adjusted_are_told(sfm, disturbed, tmp_path):
    assert_one_line(sfm("refine", disturbed, "-o", disturbed), 3, "both source and target")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--refine", "focus"), 2, "knows no 'focus'")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--loss", "l7"), 2, "choose one of trivial")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--loss-scale", "-1"), 2, "must be positive")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--focal-sigma", "1e-170"), 2, "focal_sigma must be positive")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--tolerance", "nan"), 2, "relative_cost_tolerance must lie")
    behind = pycolmap.Reconstruction(disturbed)
    for image_id in list(behind.images):
        frame = behind.images[image_id].frame
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, 0.0, -1000.0]))
    (tmp_path / "behind").mkdir()
    behind.write(tmp_path / "behind")
    assert_one_line(sfm("refine", "behind", "-o", "out"), 3, "no observation of this model has a projection")


@pytest.fixture
def on_rigs(tmp_path):
    """Four moments of two cameras on a rig, with noise."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 2, 4, 80
    reconstruction = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev, noise.point3D_stddev = NOISE_PX, 0.02
    noise.rig_from_world_translation_stddev, noise.rig_from_world_rotation_stddev = 0.02, 0.3
    pycolmap.synthesize_noise(noise, reconstruction)
    (tmp_path / "rig").mkdir()
    reconstruction.write(tmp_path / "rig")
    return tmp_path / "rig"


def mounts(model):
    """The pose of the second image of each frame in the camera of the first."""
    rows = [np.searchsorted(model.image_ids, list(frame.image_ids.values())) for frame in model.frames]
    return np.array([(model.cams_from_world[int(b)] @ model.cams_from_world[int(a)].inverse()).matrix for a, b in rows])


@pytest.mark.parametrize("sensors", [False, True])
def test_rigs_stay_together(on_rigs, sensors):
    model = read_model(on_rigs)
    refined = refine_model(model, RefinementConfig(intrinsics=(), sensors=sensors))
    after = refined.reconstruction
    assert refined.result.final_cost < 0.5 * refined.result.initial_cost
    np.testing.assert_allclose(mounts(after), mounts(after)[:1].repeat(4, axis=0), atol=1e-9)
    assert np.allclose(mounts(after), mounts(model), atol=1e-9) != sensors


def test_a_sensor_that_is_left_open_is_named(tmp_path):
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 3, 4, 80
    reconstruction = pycolmap.synthesize_dataset(options)
    last = max(reconstruction.cameras)
    images = [k for k, image in reconstruction.images.items() if image.camera_id == last]
    for image_id in images:
        seen = [k for k, point in enumerate(reconstruction.images[image_id].points2D) if point.has_point3D()]
        for k in seen[image_id == images[0] :]:
            reconstruction.delete_observation(image_id, k)
    reconstruction.write(tmp_path)
    refined = refine_model(read_model(tmp_path), RefinementConfig(intrinsics=(), sensors=True), with_covariance=True)
    assert isinstance(refined.uncertainty, Rejected)
    assert refined.undetermined == f"the pose of camera {last} on rig 1"


def test_rigs_whose_mounts_are_not_known_are_refused(on_rigs):
    model = read_model(on_rigs)
    rig = dataclasses.replace(model.rigs[0], sensors_from_rig=dict.fromkeys(model.rigs[0].sensors_from_rig))
    with pytest.raises(InputError, match="is not known"):
        refine_model(dataclasses.replace(model, rigs=(rig,)))


MOVED = Sim3(np.array(2.5), Rotation3.exp(np.array([0.3, -1.0, 0.5])), np.array([100.0, -50.0, 20.0]))
"""By which the frame of the measurements differs from that of the model."""


@pytest.fixture(scope="module")
def surveyed(disturbed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tables of what was measured of the disturbed model: exact, in the frame of the truth."""
    model = refine_model(read_model(disturbed), RefinementConfig(intrinsics=())).reconstruction
    truth = transformed(model, MOVED)
    folder = tmp_path_factory.mktemp("surveyed")
    names, centers = truth.image_names, truth.cams_from_world.center
    rows = [f"{name},{x!r},{y!r},{z!r}" for name, (x, y, z) in zip(names, centers.tolist(), strict=True)]
    (folder / "positions.csv").write_text("\n".join(["name,x,y,z", *rows]) + "\n")
    down = -truth.cams_from_world.rotation.matrix[:, :, 2]
    rows = [f"{name},{x!r},{y!r},{z!r}" for name, (x, y, z) in zip(names, down.tolist(), strict=True)]
    (folder / "gravity.csv").write_text("\n".join(["name,x,y,z", *rows]) + "\n")
    length = float(np.linalg.norm(centers[0] - centers[4]))
    (folder / "distances.csv").write_text(f"name1,name2,distance,sigma\n{names[0]},{names[4]},{length!r},0.001\n")
    rows = [
        f"{k},{x!r},{y!r},{z!r}" for k, (x, y, z) in zip(truth.point_ids[:9], truth.points3D[:9].tolist(), strict=True)
    ]
    (folder / "points.csv").write_text("\n".join(["point,x,y,z", *rows]) + "\n")
    return folder


def centers_of(folder: Path) -> np.ndarray:
    return read_model(folder).cams_from_world.center


def positions_in(table: Path) -> np.ndarray:
    return np.array([[float(cell) for cell in row.split(",")[1:]] for row in table.read_text().splitlines()[1:]])


def test_measured_positions_make_up_frame_and_scale(sfm, disturbed, surveyed, tmp_path):
    table = surveyed / "positions.csv"
    result = sfm("refine", disturbed, "-o", "out", "--refine", "none", "--positions", table, "--position-sigma", "0.01")
    assert result.returncode == 0, result.stderr
    assert "positions      8, " in result.stdout
    np.testing.assert_allclose(centers_of(tmp_path / "out"), positions_in(table), atol=0.03)
    told = json.loads((tmp_path / "out" / "frame.json").read_text())
    assert told["origin"] is None
    assert told["frame_from_model"]["scale"] == pytest.approx(2.5, rel=0.05)
    assert told["measurements"]["after"]["positions"]["rms_sigmas"] < 1.5


def test_a_common_shift_of_all_positions_is_found(sfm, disturbed, surveyed, tmp_path):
    shifted = positions_in(surveyed / "positions.csv") + [0.5, 0.0, -0.3]
    names = [row.split(",")[0] for row in (surveyed / "positions.csv").read_text().splitlines()[1:]]
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in zip(names, shifted.tolist(), strict=True)]
    (tmp_path / "shifted.csv").write_text("\n".join(["name,x,y,z", *rows]))
    control = ("--control-points", surveyed / "points.csv", "--control-sigma", "0.01")
    words = ("--positions", "shifted.csv", "--position-sigma", "0.01", "--position-bias", "1", *control, "--json")
    result = sfm("refine", disturbed, "-o", "out", "--refine", "none", *words)
    assert result.returncode == 0, result.stderr
    after = json.loads(result.stdout)["frame"]["measurements"]["after"]
    np.testing.assert_allclose(after["positions"]["bias"], [-0.5, 0.0, 0.3], atol=0.03)
    np.testing.assert_allclose(centers_of(tmp_path / "out"), positions_in(surveyed / "positions.csv"), atol=0.05)


def test_gravity_and_a_distance_make_the_model_upright_and_metric(sfm, disturbed, surveyed, tmp_path):
    words = ("--gravity", surveyed / "gravity.csv", "--distances", surveyed / "distances.csv")
    result = sfm("refine", disturbed, "-o", "out", "--refine", "none", *words)
    assert result.returncode == 0, result.stderr
    ours, theirs = centers_of(tmp_path / "out"), positions_in(surveyed / "positions.csv")
    assert np.linalg.norm(ours[0] - ours[4]) == pytest.approx(np.linalg.norm(theirs[0] - theirs[4]), abs=0.003)
    np.testing.assert_allclose(ours[:, 2] - ours[0, 2], theirs[:, 2] - theirs[0, 2], atol=0.1)


def test_control_points_that_are_marked_in_photos_make_up_the_frame(sfm, disturbed, tmp_path):
    model, lines = read_model(disturbed), ["point,name,x,y"]
    chosen = np.flatnonzero(model.tracks.lengths >= 4)[:6]
    for k, row in enumerate(chosen):
        for o in range(model.tracks.offsets[row], model.tracks.offsets[row + 1]):
            x, y = model.observations[o]
            lines.append(f"P{k},{model.image_names[model.image_rows[o]]},{x},{y}")
    (tmp_path / "marks.csv").write_text("\n".join(lines))
    truth = transformed(refine_model(model, RefinementConfig(intrinsics=())).reconstruction, MOVED)
    rows = [f"P{k},{x},{y},{z}" for k, (x, y, z) in enumerate(truth.points3D[chosen].tolist())]
    (tmp_path / "points.csv").write_text("\n".join(["point,x,y,z", *rows, "P99,0,0,0"]))
    words = ("--control-points", "points.csv", "--control-sigma", "0.02", "--marks", "marks.csv")
    result = sfm("refine", disturbed, "-o", "out", "--refine", "none", *words)
    assert result.returncode == 0, result.stderr
    assert "control points 6, " in result.stdout
    assert "1 of the measurements are of images or points that the model lacks" in result.stdout
    out = read_model(tmp_path / "out")
    assert len(out.points3D) == len(model.points3D)
    np.testing.assert_allclose(out.cams_from_world.center, truth.cams_from_world.center, atol=0.1)


def test_measurements_that_will_not_do_are_told(sfm, disturbed, surveyed, tmp_path):
    table = surveyed / "positions.csv"
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--positions", table), 3, "--position-sigma")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--positions", table, "--gps", "."), 2, "exclude each other")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--gps", tmp_path), 3, "says where it was taken")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--pixel-sigma", "0"), 2, "pixel_sigma must be positive")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--marks", table), 2, "of control points")
    words = ("--positions", table, "--position-sigma", "1e-200")
    assert_one_line(sfm("refine", disturbed, "-o", "out", *words), 2, "position_sigma must be positive")
    header, *rows = table.read_text().splitlines()
    (tmp_path / "bad.csv").write_text("\n".join([f"{header},sx,sy,sz", *(f"{row},1,1e-200,1" for row in rows)]))
    result = sfm("refine", disturbed, "-o", "out", "--positions", "bad.csv")
    assert_one_line(result, 3, "deviations of positions must be")
    (tmp_path / "bad.csv").write_text("name,x,y\na,1,2\n")
    assert_one_line(sfm("refine", disturbed, "-o", "out", "--positions", "bad.csv"), 3, "lacks z")


def test_a_solver_that_is_not_installed_is_a_missing_dependency(sfm, disturbed):
    if importlib.util.find_spec("sksparse"):
        pytest.skip("scikit-sparse is installed")
    result = sfm("refine", disturbed, "-o", "refined", "--solver", "cholmod")
    assert_one_line(result, 6, r"CHOLMOD cannot be imported.*scikit-sparse<0\.5")
