"""An independent program on the same photos: that the truth is true, and that we are no worse."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from sfm.core.scene import Reconstruction
from sfm.io.colmap_model import read_model
from tests.end_to_end.conftest import true_model
from tests.end_to_end.poses import pose_errors

pytestmark = pytest.mark.slow


def map_with_pycolmap(scene: Path, camera, folder: Path) -> None:
    """Models of pycolmap's incremental mapper, intrinsics held fixed, in `folder`."""
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
        database, scene / "images", camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
        extraction_options=extraction,
    )  # fmt: skip
    pycolmap.match_exhaustive(database, matching_options=matching)
    options = pycolmap.IncrementalPipelineOptions()
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.num_threads, options.random_seed = 2, 1
    pycolmap.incremental_mapping(database, scene / "images", folder, options=options)


@pytest.fixture(scope="session")
def theirs(rendered, made_once) -> Callable[[str], Reconstruction]:
    """`theirs("orbit")`: pycolmap's largest model of a scene with its true camera."""

    def make(name: str, folder: Path) -> None:
        map_with_pycolmap(rendered(name), true_model(rendered(name)).cameras[1], folder)

    def model(name: str) -> Reconstruction:
        folder = made_once(f"pycolmap-{name}", lambda folder: make(name, folder))
        models = [read_model(path) for path in folder.iterdir() if path.is_dir()]
        return max(models, key=lambda model: len(model.image_ids))

    return model


def test_pycolmap_recovers_all_poses_of_the_orbit(rendered, theirs):
    truth, model = true_model(rendered("orbit")), theirs("orbit")
    assert sorted(model.image_names) == sorted(truth.image_names)
    errors = pose_errors(model, truth)
    assert 0 < errors.rotation_deg < 0.03
    assert 0 < errors.position < 3e-4  # 0.1 % of the table, 0.03 % of the path


@pytest.mark.parametrize("name", ["orbit", "room"])
def test_poses_are_as_good_as_those_of_pycolmap(rendered, reconstructed, theirs, name):
    truth = true_model(rendered(name))
    (ours,), peer = reconstructed(name, "given"), theirs(name)
    assert len(ours.image_ids) >= len(peer.image_ids)
    mine, their = pose_errors(ours, truth), pose_errors(peer, truth)
    assert 0 < mine.rotation_rms_deg < 1.1 * their.rotation_rms_deg + 0.0015  # 0.02 px at the centre of the image
    assert 0 < mine.position_rms < 1.1 * their.position_rms + 5e-5
