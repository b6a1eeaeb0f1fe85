from __future__ import annotations

import numpy as np
import pytest

from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.similarity import Sim3
from sfm.evaluation.alignment import align_poses, average_rotation


def poses_at(centers: np.ndarray, rng: np.random.Generator) -> Rigid3:
    rotation = Rotation3.exp(rng.normal(size=(len(centers), 3)))
    return Rigid3(rotation, -np.einsum("kij,kj->ki", rotation.matrix, centers))


def difference(a: Sim3, b: Sim3) -> float:
    return float(np.linalg.norm((a @ b.inverse()).log()))


CENTERS = {
    "centers": np.random.default_rng(0).normal(size=(8, 3)),
    "line_and_rotations": np.linspace(0, 30, 8)[:, None] * np.array([[0.6, 0.0, 0.8]]),
}


@pytest.mark.parametrize("method", sorted(CENTERS))
def test_a_known_similarity_is_recovered(method: str) -> None:
    rng = np.random.default_rng(3)
    cams_from_a = poses_at(CENTERS[method], rng)
    b_from_a = Sim3.exp(rng.normal(size=7))
    found = align_poses(cams_from_a, b_from_a.transform_pose(cams_from_a))
    assert not isinstance(found, Rejected)
    assert found.method == method
    assert difference(found.b_from_a, b_from_a) < 1e-9
    assert found.inliers.all()


def test_two_images_take_their_scale_from_the_baseline_and_their_roll_from_the_rotations() -> None:
    rng = np.random.default_rng(4)
    cams_from_a = poses_at(rng.normal(size=(2, 3)), rng)
    b_from_a = Sim3.exp(rng.normal(size=7))
    found = align_poses(cams_from_a, b_from_a.transform_pose(cams_from_a))
    assert not isinstance(found, Rejected)
    assert difference(found.b_from_a, b_from_a) < 1e-9


def test_coincident_centers_and_a_single_image_align_by_rotation_with_scale_one() -> None:
    rng = np.random.default_rng(5)
    rigid = Sim3.from_rigid(Rigid3.exp(rng.normal(size=6)))
    for count in (1, 4):
        cams_from_a = poses_at(np.tile([[1.0, 2, 3]], (count, 1)), rng)
        found = align_poses(cams_from_a, rigid.transform_pose(cams_from_a))
        assert not isinstance(found, Rejected)
        assert found.method == "rotations"
        assert difference(found.b_from_a, rigid) < 1e-9


def test_noise_in_a_forward_motion_does_not_roll_the_alignment() -> None:
    rng = np.random.default_rng(6)
    centers = CENTERS["line_and_rotations"]
    cams_from_a = poses_at(centers, rng)
    noisy_centers = centers + rng.normal(scale=0.02, size=centers.shape)
    cams_from_b = Rigid3(cams_from_a.rotation, -np.einsum("kij,kj->ki", cams_from_a.rotation.matrix, noisy_centers))
    found = align_poses(cams_from_a, cams_from_b)
    assert not isinstance(found, Rejected)
    assert np.degrees(found.b_from_a.rotation.angle) < 0.2
    assert np.degrees(found.b_from_a.rotation.angle) > 1e-5


def test_a_line_run_backwards_shows_in_the_rotations_not_in_a_crash() -> None:
    centers = CENTERS["line_and_rotations"]
    identity = Rotation3.identity((len(centers),))
    found = align_poses(Rigid3(identity, -centers), Rigid3(identity, centers))
    assert not isinstance(found, Rejected)
    np.testing.assert_allclose(np.degrees(found.b_from_a.rotation.angle), 180, atol=1e-6)
    np.testing.assert_allclose(found.b_from_a @ centers, -centers, atol=1e-9)


def test_robust_alignment_ignores_a_minority_of_wrong_cameras() -> None:
    pytest.importorskip("sfm.core.robust.alignment")
    rng = np.random.default_rng(7)
    cams_from_a = poses_at(rng.normal(size=(12, 3)), rng)
    b_from_a = Sim3.exp(rng.normal(size=7))
    cams_from_b = b_from_a.transform_pose(cams_from_a)
    shift = np.zeros((12, 3))
    shift[:4] = rng.normal(scale=5, size=(4, 3))
    wrong = Rigid3(cams_from_b.rotation, cams_from_b.translation + shift)
    plain = align_poses(cams_from_a, wrong)
    robust = align_poses(cams_from_a, wrong, max_error=0.01, rng=np.random.default_rng(8))
    assert not isinstance(plain, Rejected)
    assert not isinstance(robust, Rejected)
    assert difference(plain.b_from_a, b_from_a) > 0.1
    assert difference(robust.b_from_a, b_from_a) < 1e-6
    assert robust.inliers.tolist() == [False] * 4 + [True] * 8


def test_average_of_rotations_is_their_median() -> None:
    rng = np.random.default_rng(9)
    center = Rotation3.exp(rng.normal(size=3))
    noise = rng.normal(scale=0.01, size=(21, 3))
    noise[:6] = rng.normal(scale=1.5, size=(6, 3))
    average = average_rotation(Rotation3.exp(noise) @ center)
    assert (average @ center.inverse()).angle < 0.01


def test_average_of_equal_rotations_is_that_rotation() -> None:
    one = Rotation3.exp(np.array([0.3, -2.0, 0.5]))
    average = average_rotation(Rotation3(np.stack([one.wxyz, -one.wxyz, one.wxyz])))
    assert (average @ one.inverse()).angle < 1e-9


def test_bad_input_is_refused() -> None:
    rng = np.random.default_rng(10)
    poses = poses_at(rng.normal(size=(4, 3)), rng)
    assert isinstance(align_poses(poses[:0], poses[:0]), Rejected)
    with pytest.raises(ValueError, match="against"):
        align_poses(poses, poses[:3])
    with pytest.raises(ValueError, match="generator"):
        align_poses(poses, poses, max_error=0.1)
    with pytest.raises(ValueError, match="batch"):
        average_rotation(Rotation3.identity())
