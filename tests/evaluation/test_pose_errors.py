from __future__ import annotations

import numpy as np
import pytest

from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.similarity import Sim3
from sfm.evaluation.pose_errors import (
    absolute_pose_errors,
    angle_between,
    relative_pose_errors,
    trajectory_errors,
)


def random_poses(rng: np.random.Generator, count: int) -> Rigid3:
    return Rigid3(Rotation3.exp(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))


def looking_ahead(centers: list[list[float]]) -> Rigid3:
    """Cameras without rotation at the centres."""
    return Rigid3(Rotation3.identity((len(centers),)), -np.array(centers, dtype=float))


def test_relative_errors_by_hand() -> None:
    truth = looking_ahead([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    # The last camera is moved from (0, 1) to (-1, 1): seen from 0 the direction turns by 45°, seen from 1 from
    # (-1, 1) to (-2, 1): 45° - atan(1/2).
    estimate = looking_ahead([[0, 0, 0], [1, 0, 0], [-1, 1, 0]])
    errors = relative_pose_errors(estimate, truth)
    from_second = 45 - np.degrees(np.arctan(0.5))
    np.testing.assert_allclose(errors.rotation_deg, 0, atol=1e-9)
    np.testing.assert_allclose(errors.direction_deg, [0, 45, 0, from_second, 45, from_second], atol=1e-9)


def test_direction_is_measured_in_the_second_camera_so_that_the_order_of_a_pair_matters() -> None:
    truth = looking_ahead([[0, 0, 0], [1, 0, 0]])
    turned = Rotation3.exp(np.array([[0, 0, 0], [0, 0, np.radians(10)]]))
    centers = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    estimate = Rigid3(turned, -np.einsum("kij,kj->ki", turned.matrix, centers))
    errors = relative_pose_errors(estimate, truth)
    np.testing.assert_allclose(errors.rotation_deg, [10, 10], atol=1e-9)
    np.testing.assert_allclose(errors.direction_deg, [10, 0], atol=1e-9)


def test_relative_errors_match_the_slow_twin() -> None:
    rng = np.random.default_rng(1)
    estimate, truth = random_poses(rng, 5), random_poses(rng, 5)
    present = np.array([True, True, False, True, True])
    rotation, direction = [], []
    for i in range(5):
        for j in range(5):
            if i == j:
                continue
            if not (present[i] and present[j]):
                rotation.append(np.inf)
                direction.append(np.inf)
                continue
            a = estimate[j] @ estimate[i].inverse()
            b = truth[j] @ truth[i].inverse()
            cosine = (np.trace(a.rotation.matrix @ b.rotation.matrix.T) - 1) / 2
            rotation.append(np.degrees(np.arccos(cosine)))
            lengths = np.linalg.norm(a.translation) * np.linalg.norm(b.translation)
            direction.append(np.degrees(np.arccos(a.translation @ b.translation / lengths)))
    errors = relative_pose_errors(estimate, truth, present=present)
    np.testing.assert_allclose(errors.rotation_deg, rotation, atol=1e-6)
    np.testing.assert_allclose(errors.direction_deg, direction, atol=1e-6)
    assert np.isinf(errors.error_deg).sum() == 8


def test_relative_errors_do_not_see_the_world_frame_or_its_scale() -> None:
    rng = np.random.default_rng(2)
    estimate, truth = random_poses(rng, 6), random_poses(rng, 6)
    new_from_world = Sim3.exp(rng.normal(size=7))
    before = relative_pose_errors(estimate, truth).error_deg
    after = relative_pose_errors(new_from_world.transform_pose(estimate), truth).error_deg
    np.testing.assert_allclose(after, before, atol=1e-8)


def test_a_short_baseline_counts_by_its_rotation_alone() -> None:
    truth = looking_ahead([[0, 0, 0], [1e-4, 0, 0], [1, 0, 0]])
    estimate = looking_ahead([[0, 0, 0], [0, 1e-4, 0], [1, 0, 0]])
    strict = relative_pose_errors(estimate, truth).error_deg
    lenient = relative_pose_errors(estimate, truth, min_baseline=1e-3).error_deg
    assert strict[0] > 89
    assert lenient[0] == 0
    assert 0 < lenient.max() < 0.01


def test_absolute_errors_by_hand() -> None:
    truth = looking_ahead([[0, 0, 0], [1, 0, 0]])
    turn = Rotation3.exp(np.array([[0, np.radians(3), 0], [0, 0, 0]]))
    centers = np.array([[0, 0, 0], [1, 3, 4.0]])
    estimate = Rigid3(turn, -np.einsum("kij,kj->ki", turn.matrix, centers))
    rotation, position = absolute_pose_errors(estimate, truth)
    np.testing.assert_allclose(rotation, [3, 0], atol=1e-9)
    np.testing.assert_allclose(position, [0, 5], atol=1e-12)


def test_angle_is_accurate_where_the_cosine_is_not() -> None:
    small = 1e-9
    a, b = np.array([1.0, 0, 0]), np.array([1.0, small, 0])
    np.testing.assert_allclose(angle_between(a, b), small, rtol=1e-6)
    np.testing.assert_allclose(angle_between(a, -b), np.pi - small, rtol=1e-15)
    np.testing.assert_allclose(angle_between(3 * a, np.array([0, 5.0, 0])), np.pi / 2)


def test_angle_to_a_vector_of_length_zero_is_a_failure_not_a_success() -> None:
    zero = np.zeros(3)
    assert angle_between(zero, np.ones(3)) == np.pi / 2
    assert angle_between(zero, zero) == 0


def test_trajectory_errors_see_only_the_motion_between_neighbours() -> None:
    truth = looking_ahead([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    # One jump of 0.5 stays: one wrong motion, three wrong positions.
    estimate = looking_ahead([[0, 0, 0], [1.5, 0, 0], [2.5, 0, 0], [3.5, 0, 0]])
    rotation, translation = trajectory_errors(estimate, truth)
    np.testing.assert_allclose(rotation, 0, atol=1e-9)
    np.testing.assert_allclose(translation, [0.5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(trajectory_errors(estimate, truth, step=2)[1], [0.5, 0], atol=1e-12)
    assert len(trajectory_errors(estimate, truth, step=9)[1]) == 0
    with pytest.raises(ValueError, match="step"):
        trajectory_errors(estimate, truth, step=0)


def test_empty_and_single_inputs_have_no_pairs() -> None:
    for count in (0, 1):
        poses = Rigid3.identity((count,))
        assert len(relative_pose_errors(poses, poses).error_deg) == 0
