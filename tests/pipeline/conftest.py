"""Small photos, and stand-ins for the two stages that take long, so that these tests are about the pipeline alone."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sfm.core.errors import Rejected
from sfm.core.events import ImageRegistered
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import PairKind, Reconstruction, Tracks, TwoViewGeometry
from sfm.pipeline import models, stages
from tests.pictures import texture


def write_photo(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Four overlapping cuts of one picture."""
    picture = texture(1, (160, 240))
    for k, x in enumerate((0, 20, 40, 60)):
        write_photo(tmp_path / "photos" / f"photo{k}.png", picture[20:140, x : x + 160])
    return tmp_path / "photos"


def plausible_geometry(
    points2D_1, points2D_2, matches, camera1, camera2, config, *, rng, distinct1=None, distinct2=None
):
    """Takes the matches that agree with the median shift; in fact the truth for cuts of one picture."""
    if len(matches) < 15:
        return Rejected("too_few_matches", f"{len(matches)} of 15")
    shift = points2D_2[matches.indices[:, 1]] - points2D_1[matches.indices[:, 0]]
    inliers = np.linalg.norm(shift - np.median(shift, axis=0), axis=1) < 2
    if inliers.sum() < 15:
        return Rejected("too_few_inliers", f"{inliers.sum()} of 15")
    pose = Rigid3.exp(np.array([0, 0, 0, 1.0, 0, 0]) + 1e-3 * rng.normal(size=6))
    return TwoViewGeometry(PairKind.CALIBRATED, matches.indices[inliers], pose, tri_angle=0.3)


def best_pair_model(
    view_graph, keypoints, cameras, image_cameras, image_names, config, *,
    keypoint_scales, seed, threads, refine_intrinsics, observer,
) -> list[Reconstruction]:  # fmt: skip
    """A model of the pair with most matches; its points lie anywhere."""
    if not view_graph.pairs:
        return []
    pair = max(view_graph.pairs, key=lambda key: len(view_graph.pairs[key]))
    geometry = view_graph.pairs[pair]
    count = len(geometry)
    for image_id in pair:
        observer(ImageRegistered(name=image_names[image_id], registered=2, points=count, inliers=count, visible=count))
    return [
        Reconstruction(
            cameras=cameras,
            image_ids=np.array(pair, np.int32),
            image_names=tuple(image_names[k] for k in pair),
            image_camera_ids=np.array([image_cameras[k] for k in pair], np.int32),
            cams_from_world=Rigid3.stack([Rigid3.identity(), geometry.cam2_from_cam1]),
            keypoint_offsets=np.cumsum([0] + [len(keypoints[k]) for k in pair]),
            keypoints=np.concatenate([keypoints[k] for k in pair]),
            points3D=np.random.default_rng(seed).normal(size=(count, 3)) + np.array([0, 0, 5.0]),
            point_ids=np.arange(1, count + 1),
            colors=np.zeros((count, 3), np.uint8),
            errors=np.full(count, 0.5),
            tracks=Tracks(
                np.arange(0, 2 * count + 1, 2), np.tile(np.array(pair, np.int32), count), geometry.matches.reshape(-1)
            ),
        )
    ]


@pytest.fixture(autouse=True)
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages, "verify_pair", plausible_geometry)
    monkeypatch.setattr(models, "map_incrementally", best_pair_model)
