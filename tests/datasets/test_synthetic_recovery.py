"""The truth is true: an independent program that is given the photos and the intrinsics finds the poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datasets.synthetic import SensorConfig, make_scene, write_scene
from sfm.core.geometry.rotation import Rotation3


def map_with_pycolmap(folder: Path, camera) -> object:
    """The largest model of pycolmap's incremental mapper, intrinsics held fixed."""
    import pycolmap

    pycolmap.logging.minloglevel = 3
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = camera.model, ",".join(repr(float(p)) for p in camera.params)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu, extraction.num_threads = False, 2
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads = False, 2
    database = folder / "database.db"
    pycolmap.extract_features(
        database, folder / "images", camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
        extraction_options=extraction,
    )  # fmt: skip
    pairing = pycolmap.SequentialPairingOptions()
    pairing.overlap, pairing.quadratic_overlap = 3, False
    pycolmap.match_sequential(database, pairing_options=pairing, matching_options=matching)
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.num_threads, options.random_seed = 2, 1
    models = pycolmap.incremental_mapping(database, folder / "images", folder / "models", options=options)
    return max(models.values(), key=lambda model: model.num_reg_images())


@pytest.mark.slow
def test_pycolmap_recovers_all_poses_of_the_orbit(tmp_path):
    scene = make_scene("orbit", images=9, width=1024, height=768)
    sensor = SensorConfig(noise=0.004, blur_px=0.0, exposure_jitter_ev=0.05, jpeg_quality=None)
    names = list(write_scene(scene, tmp_path, sensor=sensor, maps=False))
    (tmp_path / "models").mkdir()
    model = map_with_pycolmap(tmp_path, scene.views[0].camera)
    images = {image.name: image for image in model.images.values() if image.has_pose}
    assert sorted(images) == sorted(names)

    found = [images[name] for name in names]
    true_from_found = [
        view.cam_from_world.rotation.matrix.T @ image.cam_from_world().rotation.matrix()
        for view, image in zip(scene.views, found, strict=True)
    ]
    left, _, right = np.linalg.svd(np.sum(true_from_found, axis=0))
    turn = left @ right
    angles = np.rad2deg(Rotation3.from_matrix(np.array(true_from_found) @ turn.T).angle)
    assert 0 < angles.max() < 0.03

    truth = scene.cams_from_world.center
    centers = np.array([image.projection_center() for image in found]) @ turn.T
    here, there = centers - centers.mean(0), truth - truth.mean(0)
    scale = (here * there).sum() / (here**2).sum()
    assert 0 < np.linalg.norm(scale * here - there, axis=1).max() < 1e-3 * scene.world.extent
