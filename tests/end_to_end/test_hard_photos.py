"""Folders as people have them, and worse ones: each gives a sane result or one clear line."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from sfm.core.errors import ReconstructionError
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.io.colmap_model import read_model
from sfm.pipeline.config import CameraConfig, PipelineConfig
from sfm.pipeline.run import reconstruct
from tests.end_to_end.conftest import true_model
from tests.end_to_end.poses import errors_of
from tests.pictures import texture

pytestmark = pytest.mark.slow

FOCAL = 600.0
PINHOLE = np.array([[FOCAL, 0, 320], [0, FOCAL, 240], [0, 0, 1]])


@pytest.fixture
def photos(few, tmp_path) -> Path:
    """A copy of the five good photos that a test may spoil."""
    shutil.copytree(few / "photos", tmp_path / "photos")
    return tmp_path / "photos"


def given(folder: Path) -> PipelineConfig:
    return PipelineConfig(cameras=CameraConfig(intrinsics=str(folder / "cameras.txt")))


def warped(picture: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """A photo of 640 × 480 px; `homography` takes pixels of the picture, corner (0, 0), to those of the photo."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return cv2.warpPerspective(picture, np.linalg.inv(half) @ homography @ half, (640, 480), flags=cv2.INTER_CUBIC)


def write_pinhole(folder: Path) -> None:
    (folder / "cameras.txt").write_text(f"1 SIMPLE_PINHOLE 640 480 {FOCAL} 320 240\n")


def test_good_photos_among_horrors_are_found(sfm, few, finished, photos, tmp_path):
    good = sorted(path.name for path in photos.iterdir())
    whole = cv2.imread(str(photos / good[0]))
    cv2.imwrite(str(tmp_path / "whole.jpg"), whole)
    jpeg = (tmp_path / "whole.jpg").read_bytes()
    (photos / "cut.jpg").write_bytes(jpeg[: len(jpeg) // 2])
    (photos / "noise.jpg").write_bytes(jpeg[:20] + np.random.default_rng(1).bytes(5000))
    (photos / "text.jpg").write_text("I am no photo.")
    (photos / "empty.png").write_bytes(b"")
    Image.new("RGB", (1, 1)).save(photos / "dot.png")
    Image.fromarray(texture(1)[..., 0]).save(photos / "one_channel.png")
    cv2.imwrite(str(photos / "sixteen_bit.png"), texture(2)[..., 0].astype(np.uint16) * 257)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(texture(3)).save(photos / "rotated.jpg", exif=exif, quality=95)
    Image.fromarray(texture(4)).convert("CMYK").save(photos / "cmyk.jpg", quality=95)
    Image.fromarray(np.dstack([texture(5), np.full((240, 320), 9, np.uint8)])).save(photos / "alpha.png")
    Image.fromarray(texture(6, (24, 4000))).save(photos / "strip.png")
    shutil.copy(photos / good[1], photos / "duplicate of it.png")
    result = sfm("run", "photos", "-o", "ws")
    assert result.returncode == 0, result.stderr
    assert "Traceback" not in result.stderr
    manifest = json.loads((tmp_path / "ws" / "manifest.json").read_text())
    reasons = {
        "cut.jpg": "truncated",
        "noise.jpg": "",
        "text.jpg": "text file",
        "empty.png": "empty",
        "dot.png": "small",
    }
    assert set(manifest["skipped"]) == set(reasons)
    for name, reason in reasons.items():
        assert reason in manifest["skipped"][name]
        assert name in result.stderr
    assert manifest["images"] == len(good) + 7
    model = read_model(tmp_path / "ws" / "sparse" / "0")
    assert set(good) | {"duplicate of it.png"} == set(model.image_names)
    strangers = {"one_channel.png", "sixteen_bit.png", "rotated.jpg", "cmyk.jpg", "alpha.png", "strip.png"}
    assert set(manifest["missing"]) == strangers
    centers = dict(zip(model.image_names, model.cams_from_world.center, strict=True))
    extent = np.linalg.norm(np.ptp(model.cams_from_world.center, axis=0))
    assert np.linalg.norm(centers[good[1]] - centers["duplicate of it.png"]) < 1e-3 * extent


def test_every_photo_twice_is_the_model_of_every_photo_once(few, photos, rendered, tmp_path):
    for path in sorted(photos.iterdir()):
        shutil.copy(path, path.with_name(f"again {path.name}"))
    report = reconstruct(photos, tmp_path / "ws", given(few), threads=2)
    assert (report.models[0].images, len(report.models)) == (10, 1)
    model, truth = read_model(tmp_path / "ws" / "sparse" / "0"), true_model(rendered("facade"))
    rows = np.array([truth.image_names.index(name.removeprefix("again ")) for name in model.image_names])
    truth_poses = truth.cams_from_world[rows]
    errors = errors_of(model.cams_from_world, truth_poses, truth_poses.center)
    assert 1e-4 < errors.rotation_deg < 0.05
    assert 1e-6 < errors.position < 5e-3


def test_a_flat_wall_is_reconstructed_if_the_camera_is_known(tmp_path):
    """The picture, 1 px = 1 / 500, lies in the plane z = 0 and is seen from five places."""
    picture, photos = texture(7, (1000, 1600)), tmp_path / "photos"
    photos.mkdir()
    write_pinhole(tmp_path)
    plane_from_picture = np.array([[1 / 500, 0, -1.6], [0, 1 / 500, -1.0], [0, 0, 1]])
    poses = []
    for k, x in enumerate((-0.6, -0.3, 0.0, 0.3, 0.6)):
        turn = Rotation3.exp(np.array([0.05 * (-1) ** k, 0.35 * x, 0.02 * k]))
        pose = Rigid3(turn, -(turn @ np.array([x, 0.1 * (-1) ** k, -1.6])))
        poses.append(pose)
        photo_from_plane = PINHOLE @ np.column_stack([turn.matrix[:, :2], pose.translation])
        Image.fromarray(warped(picture, photo_from_plane @ plane_from_picture)).save(photos / f"{k}.png")
    report = reconstruct(photos, tmp_path / "ws", given(tmp_path), threads=2)
    assert report.models[0].images == 5
    model, truth = read_model(tmp_path / "ws" / "sparse" / "0"), Rigid3.stack(poses)
    order = np.array([int(Path(name).stem) for name in model.image_names])
    errors = errors_of(model.cams_from_world, truth[order], truth.center)
    assert 1e-4 < errors.rotation_deg < 0.05
    assert 1e-6 < errors.position < 5e-3


def test_turning_on_the_spot_gives_no_model_and_says_so(tmp_path):
    picture, photos = texture(8, (900, 1600)), tmp_path / "photos"
    photos.mkdir()
    write_pinhole(tmp_path)
    centered = np.array([[1, 0, -800], [0, 1, -450], [0, 0, FOCAL]])
    for k, angle in enumerate((-0.3, -0.15, 0.0, 0.15, 0.3)):
        turn = Rotation3.exp(np.array([0.03 * (-1) ** k, angle, 0.0]))
        Image.fromarray(warped(picture, PINHOLE @ turn.matrix @ centered)).save(photos / f"{k}.png")
    with pytest.raises(ReconstructionError, match=r"overlap, but none can start a model.*turning on the spot"):
        reconstruct(photos, tmp_path / "ws", given(tmp_path), threads=2)


def test_names_of_any_kind_and_folders_within_are_kept(few, photos, tmp_path):
    names = ["Füße – 東京 🏔.png", "x" * 240 + ".png", "a b'c\"d;.png", "unter ordner/tief/1.png", "-o.png"]
    for path, name in zip(sorted(photos.iterdir()), names, strict=True):
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        path.rename(photos / name)
    report = reconstruct(photos, tmp_path / "wörk späce", given(few), threads=2)
    model = read_model(tmp_path / "wörk späce" / "sparse" / "0")
    assert report.models[0].images == 5
    assert set(model.image_names) == set(names)


def test_a_photo_that_is_replaced_or_gone_between_runs_leaves_no_trace(few, photos, tmp_path):
    reconstruct(photos, tmp_path / "ws", given(few), threads=2)
    first, *_, last = sorted(photos.iterdir())
    first.unlink()
    Image.fromarray(texture(9, (600, 800))).save(last)
    report = reconstruct(photos, tmp_path / "ws", given(few), threads=2)
    model = read_model(tmp_path / "ws" / "sparse" / "0")
    assert list(report.missing) == [last.name]
    assert len(model.image_names) == 3
    assert not {first.name, last.name} & set(model.image_names)


def test_a_workspace_that_lost_its_models_gets_them_back(few, finished, tmp_path):
    shutil.copytree(finished, tmp_path / "ws")
    before = (tmp_path / "ws" / "sparse" / "0" / "images.bin").read_bytes()
    shutil.rmtree(tmp_path / "ws" / "sparse")
    reconstruct(few / "photos", tmp_path / "ws", threads=2)
    assert (tmp_path / "ws" / "sparse" / "0" / "images.bin").read_bytes() == before


def test_a_database_of_something_else_is_named(sfm, few, tmp_path):
    (tmp_path / "ws").mkdir()
    (tmp_path / "ws" / "database.db").write_bytes(b"not a database" * 100)
    result = sfm("run", few / "photos", "-o", "ws")
    assert result.returncode == 3
    assert re.search(r"^error: .*database\.db", result.stderr, re.MULTILINE)
