"""The synthetic suite, from pixels to poses."""

from __future__ import annotations

import pytest

from datasets.synthetic import STILL_NAMES
from sfm.io.colmap_model import read_model
from sfm.pipeline.config import CameraConfig, PipelineConfig
from sfm.pipeline.run import reconstruct
from tests.end_to_end.conftest import true_model
from tests.end_to_end.poses import pose_errors

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("intrinsics", ["given", "unknown"])
@pytest.mark.parametrize("name", [name for name in STILL_NAMES if name != "twins"])
def test_every_photo_of_a_scene_finds_its_pose(rendered, reconstructed, name, intrinsics):
    truth = true_model(rendered(name))
    model, *others = reconstructed(name, intrinsics)
    assert not others
    assert sorted(model.image_names) == sorted(truth.image_names)
    errors = pose_errors(model, truth)
    assert 1e-4 < errors.rotation_deg < 0.05
    assert 1e-6 < errors.position < 2e-3
    assert len(model.tracks) > 200 * len(model.image_ids)
    assert 0.01 < model.errors.mean() < 0.5
    if intrinsics == "given":
        (camera,) = model.cameras.values()
        assert camera.params.tolist() == truth.cameras[1].params.tolist()


@pytest.mark.parametrize("intrinsics", ["given", "unknown"])
def test_two_fronts_that_look_alike_do_not_fold(rendered, reconstructed, intrinsics):
    """Folded onto each other the fronts fit well, with rotations right to 0.1°; but positions are off by 40 %.

    Past a front the principal point is hardly determined: unknown, it takes 0.3° of rotation with it.
    """
    truth = true_model(rendered("twins"))
    models = reconstructed("twins", intrinsics)
    assert len(models) <= 2
    assert sorted(name for model in models for name in model.image_names) == sorted(truth.image_names)
    for model in models:
        errors = pose_errors(model, truth)
        assert 1e-4 < errors.rotation_deg < (0.05 if intrinsics == "given" else 0.5)
        assert 1e-6 < errors.position < 5e-3


def test_photos_of_a_rig_reconstruct_as_photos_of_two_cameras(rendered, tmp_path):
    scene = rendered("rig")
    config = PipelineConfig(cameras=CameraConfig(sharing="folder"))
    report = reconstruct(scene / "images", tmp_path / "ws", config, threads=2)
    assert (report.models[0].images, report.images, len(report.models)) == (8, 8, 1)
    model, truth = read_model(tmp_path / "ws" / "sparse" / "0"), true_model(scene)
    errors = pose_errors(model, truth)
    assert 1e-4 < errors.rotation_deg < 0.1
    assert 1e-6 < errors.position < 5e-3
    assert len(model.cameras) == 2
