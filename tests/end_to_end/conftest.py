"""Rendered photos with their truth, and what the pipeline makes of them: each made once in a test run."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from datasets.synthetic import SensorConfig, make_scene, write_scene
from sfm.core.scene import Reconstruction
from sfm.io.colmap_model import read_model
from sfm.pipeline.config import CameraConfig, PipelineConfig
from sfm.pipeline.run import reconstruct

SENSOR = SensorConfig(noise=0.004, blur_px=0.0, exposure_jitter_ev=0.05, jpeg_quality=None)
"""A camera by day whose errors are those of the detector, not of the file format."""
MOMENTS = {"rig": 4, "twins": 12}
SIZES = {"orbit": (1024, 768)}
"""The orbit has fewest keypoints: at 800 × 600 an unknown camera leaves its rotations 0.08° off, here 0.02°."""


def true_model(folder: Path) -> Reconstruction:
    return read_model(folder / "truth" / "sparse" / "0")


@pytest.fixture(scope="session")
def rendered(made_once) -> Callable[[str], Path]:
    """`rendered("orbit")`: a folder with `images`, `truth` and the true camera in `cameras.txt`."""

    def make(name: str, folder: Path) -> None:
        width, height = SIZES.get(name, (800, 600))
        scene = make_scene(name, images=MOMENTS.get(name, 9), width=width, height=height)
        assert list(write_scene(scene, folder, sensor=SENSOR, maps=False, threads=2))
        camera = scene.views[0].camera
        params = " ".join(repr(float(value)) for value in camera.params)
        (folder / "cameras.txt").write_text(f"1 {camera.model} {width} {height} {params}\n")

    return lambda name: made_once(f"scene-{name}", lambda folder: make(name, folder))


@pytest.fixture(scope="session")
def reconstructed(rendered, made_once) -> Callable[[str, str], list[Reconstruction]]:
    """`reconstructed("orbit", "given")`: the models of a scene with its true camera; or with an "unknown" one."""

    def make(name: str, intrinsics: str, workspace: Path) -> None:
        scene = rendered(name)
        camera = CameraConfig(intrinsics=str(scene / "cameras.txt") if intrinsics == "given" else "")
        if intrinsics == "unknown":  # features and matches are the same
            shutil.copytree(workspace_of(name, "given"), workspace, dirs_exist_ok=True)
        reconstruct(scene / "images", workspace, PipelineConfig(cameras=camera), threads=2)

    def workspace_of(name: str, intrinsics: str) -> Path:
        return made_once(f"workspace-{name}-{intrinsics}", lambda folder: make(name, intrinsics, folder))

    def models(name: str, intrinsics: str) -> list[Reconstruction]:
        folders = sorted((workspace_of(name, intrinsics) / "sparse").iterdir(), key=lambda folder: int(folder.name))
        return [read_model(folder) for folder in folders]

    return models


@pytest.fixture(scope="session")
def few(rendered, made_once) -> Path:
    """A folder with `photos`, five small ones of a façade, for tests that run often; and the true `cameras.txt`."""

    def make(folder: Path) -> None:
        scene = rendered("facade")
        (folder / "photos").mkdir()
        for path in sorted((scene / "images").iterdir())[:5]:
            small = cv2.resize(cv2.imread(str(path)), (600, 450), interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / "photos" / path.name), small)
        shutil.copy(scene / "cameras.txt", folder)

    return made_once("few", make)


@pytest.fixture(scope="session")
def finished(few, made_once) -> Path:
    """The workspace of an uninterrupted run over `few` on two threads."""
    return made_once("few-workspace", lambda folder: reconstruct(few / "photos", folder, threads=2) and None)
