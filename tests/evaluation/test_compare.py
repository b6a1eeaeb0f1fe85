from __future__ import annotations

import dataclasses
import json

import numpy as np

from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.similarity import Sim3
from sfm.core.scene import Reconstruction, Tracks
from sfm.evaluation import compare_models
from sfm.evaluation.compare import match_names


def model_of(names: list[str], poses: Rigid3) -> Reconstruction:
    count = len(names)
    return Reconstruction(
        cameras={1: Camera("PINHOLE", 640, 480, np.array([500.0, 500, 320, 240]))},
        image_ids=np.arange(1, count + 1, dtype=np.int32),
        image_names=tuple(names),
        image_camera_ids=np.ones(count, dtype=np.int32),
        cams_from_world=poses,
        keypoint_offsets=np.zeros(count + 1, dtype=np.int64),
        keypoints=np.zeros((0, 2)),
        points3D=np.zeros((0, 3)),
        point_ids=np.zeros(0, dtype=np.int64),
        colors=np.zeros((0, 3), dtype=np.uint8),
        errors=np.zeros(0),
        tracks=Tracks.empty(),
    )


def reference(count: int = 6) -> Reconstruction:
    rng = np.random.default_rng(0)
    poses = Rigid3(Rotation3.exp(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))
    return model_of([f"{k:03}.jpg" for k in range(count)], poses)


def in_another_frame(model: Reconstruction, rows: list[int]) -> Reconstruction:
    other_from_world = Sim3.exp(np.random.default_rng(1).normal(size=7))
    poses = other_from_world.transform_pose(model.cams_from_world)[np.array(rows, dtype=int)]
    return model_of([model.image_names[row] for row in rows], poses)


def test_a_copy_in_another_frame_has_no_error() -> None:
    truth = reference()
    comparison = compare_models(in_another_frame(truth, [5, 1, 0, 3, 2, 4]), truth)
    assert comparison.names == truth.image_names
    assert comparison.missing == comparison.extra == ()
    assert comparison.rotation_error_deg.max() < 1e-9
    assert comparison.position_error.max() < 1e-9
    assert comparison.absolute_trajectory_error < 1e-9
    assert min(comparison.auc().values()) > 1 - 1e-6


def test_missing_images_are_failures_of_their_pairs() -> None:
    truth = reference(6)
    comparison = compare_models(in_another_frame(truth, [0, 1, 2, 4]), truth)
    assert comparison.missing == ("003.jpg", "005.jpg")
    np.testing.assert_allclose(comparison.auc()[1.0], 4 * 3 / (6 * 5), atol=1e-6)
    np.testing.assert_allclose(comparison.auc(registered_only=True)[1.0], 1, atol=1e-6)
    assert len(comparison.relative.error_deg) == 30
    assert len(comparison.registered_error_deg) == 12


def test_one_turned_camera_shows_where_it_is() -> None:
    truth = reference(8)
    q = np.array(truth.cams_from_world.rotation.wxyz)
    turn = Rotation3.exp(np.array([0, np.radians(2), 0]))
    turned = Rigid3((turn @ Rotation3(q[3])), (turn @ truth.cams_from_world.translation[3]))
    q[3] = turned.rotation.wxyz
    t = np.array(truth.cams_from_world.translation)
    t[3] = turned.translation
    comparison = compare_models(model_of(list(truth.image_names), Rigid3(Rotation3(q), t)), truth)
    np.testing.assert_allclose(comparison.rotation_error_deg[3], 2, atol=1e-6)
    np.testing.assert_allclose(np.delete(comparison.rotation_error_deg, 3), 0, atol=1e-6)
    assert comparison.position_error.max() < 1e-9
    worst = comparison.relative.rotation_deg
    assert (worst > 1).sum() == 2 * 7


def test_names_match_by_their_last_part_only_where_that_is_unique() -> None:
    rows, true_rows = match_names(("a/1.jpg", "b/2.jpg", "c/2.jpg", "3.jpg"), ("1.jpg", "2.jpg", "x/3.jpg", "4.jpg"))
    assert rows.tolist() == [0, 3]
    assert true_rows.tolist() == [0, 2]


def test_equal_names_win_over_equal_last_parts() -> None:
    rows, true_rows = match_names(("b/1.jpg", "a/1.jpg"), ("a/1.jpg", "1.jpg"))
    assert dict(zip(true_rows.tolist(), rows.tolist(), strict=True)) == {0: 1, 1: 0}


def test_models_without_common_images_compare_without_a_crash() -> None:
    truth = reference(3)
    other = model_of(["x.jpg"], Rigid3.identity((1,)))
    comparison = compare_models(other, truth)
    assert comparison.extra == ("x.jpg",)
    assert comparison.auc()[10.0] == 0
    as_json = comparison.to_json()
    assert as_json["alignment"]["rejected"] == "too_few_images"
    assert as_json["position_error"]["median"] is None


def test_json_is_plain_and_complete() -> None:
    truth = reference(5)
    comparison = compare_models(in_another_frame(truth, [0, 1, 3]), truth)
    text = json.dumps(comparison.to_json(), allow_nan=False)
    back = json.loads(text)
    assert back["images"] == {
        "reference": 5,
        "registered": 3,
        "missing": ["002.jpg", "004.jpg"],
        "extra": [],
    }
    assert set(back["relative_pose"]["auc_deg"]) == {"0.5", "1", "3", "5", "10"}
    assert len(back["per_image"]) == 3
    assert back["alignment"]["method"] == "centers"


def test_comparison_does_not_change_its_inputs() -> None:
    truth = reference(4)
    before = truth.cams_from_world.matrix.copy()
    compare_models(dataclasses.replace(truth), truth)
    np.testing.assert_array_equal(truth.cams_from_world.matrix, before)
