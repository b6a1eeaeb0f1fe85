import dataclasses

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.geometry.epipolar import essential_from_fundamental, essential_from_pose, fundamental_from_essential
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import PairKind, TwoViewGeometry, ViewGraph
from sfm.viewgraph import calibrate_focal_lengths, poses_under

TRUE_FOCALS = {1: 700.0, 2: 1100.0, 3: 900.0, 4: 1500.0, 5: 1250.0}


def _camera(focal, known=False):
    return Camera("SIMPLE_RADIAL", 1000, 750, np.array([focal, 500, 375, 0.0]), known)


def _scene(rng):
    """Five cameras in general position round a cloud: keypoints, and F of every pair."""
    points = rng.uniform(-1, 1, (200, 3))
    poses = {}
    for i in TRUE_FOCALS:
        angle = 0.3 * i
        turn = Rotation3.exp(np.array([0.2 * np.sin(i), angle, 0.1 * np.cos(2 * i)]))
        offset = np.array([0.1 * i, -0.2 * np.sin(i), 6 + 0.4 * np.cos(3 * i)])
        poses[i] = Rigid3(turn, offset)
    truth = {i: _camera(f) for i, f in TRUE_FOCALS.items()}
    keypoints = {i: truth[i].project(poses[i] @ points)[0] for i in truth}
    pairs = {}
    for i in truth:
        for j in range(i + 1, len(truth) + 1):
            essential = essential_from_pose(poses[j] @ poses[i].inverse())
            F = fundamental_from_essential(essential, truth[i].calibration_matrix, truth[j].calibration_matrix)
            F = F / np.linalg.norm(F)
            matches = np.repeat(np.arange(200, dtype=np.int32)[:, None], 2, 1)
            pairs[i, j] = TwoViewGeometry(PairKind.UNCALIBRATED, matches, F=F)
    return ViewGraph(pairs), keypoints, poses


def test_exact_matrices_give_focal_lengths_that_only_the_guess_biases(rng):
    graph, _, _ = _scene(rng)
    found = calibrate_focal_lengths(graph, {i: _camera(1200.0) for i in TRUE_FOCALS}, {i: i for i in TRUE_FOCALS})
    for i, focal in TRUE_FOCALS.items():
        assert found[i].mean_focal_length == pytest.approx(focal, rel=0.03)


def test_a_known_focal_length_is_not_touched(rng):
    graph, _, _ = _scene(rng)
    cameras = {i: _camera(TRUE_FOCALS[i] if i == 2 else 1200.0, known=i == 2) for i in TRUE_FOCALS}
    found = calibrate_focal_lengths(graph, cameras, {i: i for i in TRUE_FOCALS})
    assert found[2] is cameras[2]


def test_one_wrong_pair_does_not_move_the_others(rng):
    graph, _, _ = _scene(rng)
    pairs = dict(graph.pairs)
    pairs[1, 2] = TwoViewGeometry(PairKind.UNCALIBRATED, pairs[1, 2].matches, F=rng.normal(size=(3, 3)))
    found = calibrate_focal_lengths(
        ViewGraph(pairs), {i: _camera(1200.0) for i in TRUE_FOCALS}, {i: i for i in TRUE_FOCALS}
    )
    for i, focal in TRUE_FOCALS.items():
        assert found[i].mean_focal_length == pytest.approx(focal, rel=0.03)


def test_pairs_without_a_matrix_leave_the_guess():
    graph = ViewGraph({(1, 2): TwoViewGeometry(PairKind.PLANAR, np.zeros((50, 2), np.int32))})
    cameras = {1: _camera(1200.0), 2: _camera(1200.0)}
    assert calibrate_focal_lengths(graph, cameras, {1: 1, 2: 2}) == cameras


@pytest.mark.parametrize("kind", [PairKind.UNCALIBRATED, PairKind.CALIBRATED])
def test_poses_follow_the_corrected_focal_lengths(rng, kind):
    graph, keypoints, poses = _scene(rng)
    truth = {i: _camera(f) for i, f in TRUE_FOCALS.items()}
    if kind == PairKind.CALIBRATED:  # as COLMAP leaves them: with E, without a pose
        K = {i: camera.calibration_matrix for i, camera in truth.items()}
        pairs = {
            (i, j): dataclasses.replace(one, kind=kind, E=essential_from_fundamental(one.F, K[i], K[j]), F=None)
            for (i, j), one in graph.pairs.items()
        }
        graph = ViewGraph(pairs)
    posed = poses_under(graph, keypoints, truth, {i: i for i in TRUE_FOCALS})
    for (i, j), geometry in posed.pairs.items():
        motion = poses[j] @ poses[i].inverse()
        assert geometry.cam2_from_cam1 is not None
        assert (geometry.cam2_from_cam1.rotation @ motion.rotation.inverse()).angle < 1e-6
        direction = motion.translation / np.linalg.norm(motion.translation)
        assert np.abs(geometry.cam2_from_cam1.translation - direction).max() < 1e-6
        assert geometry.tri_angle > 0.01


def _known(factor):
    """All focal lengths from EXIF, those of some images wrong by a factor."""
    return {i: _camera(f * factor.get(i, 1.0), known=True) for i, f in TRUE_FOCALS.items()}


def _kinds(graph, wrong):
    """As verification finds them: E fails where a focal length is wrong."""
    return ViewGraph(
        {
            pair: dataclasses.replace(one, kind=PairKind.UNCALIBRATED if wrong & set(pair) else PairKind.CALIBRATED)
            for pair, one in graph.pairs.items()
        }
    )


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_exif_that_is_wrong_by_a_factor_of_two_is_corrected(rng, factor):
    graph, _, _ = _scene(rng)
    images = {i: i for i in TRUE_FOCALS}
    found = calibrate_focal_lengths(
        _kinds(graph, set(TRUE_FOCALS)), _known(dict.fromkeys(TRUE_FOCALS, factor)), images, doubt_known=True
    )
    for i, focal in TRUE_FOCALS.items():
        assert found[i].mean_focal_length == pytest.approx(focal, rel=0.05)
        assert not found[i].has_prior_focal_length


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_one_wrong_exif_among_right_ones_is_the_only_one_corrected(rng, factor):
    graph, _, _ = _scene(rng)
    cameras = _known({3: factor})
    found = calibrate_focal_lengths(_kinds(graph, {3}), cameras, {i: i for i in TRUE_FOCALS}, doubt_known=True)
    assert found[3].mean_focal_length == pytest.approx(TRUE_FOCALS[3], rel=0.03)
    assert [i for i in TRUE_FOCALS if found[i] is not cameras[i]] == [3]


def test_right_exif_and_a_given_calibration_are_not_doubted(rng):
    graph, _, _ = _scene(rng)
    images = {i: i for i in TRUE_FOCALS}
    right, wrong = _known({}), _known(dict.fromkeys(TRUE_FOCALS, 2.0))
    assert calibrate_focal_lengths(_kinds(graph, set()), right, images, doubt_known=True) == right
    assert calibrate_focal_lengths(_kinds(graph, set(TRUE_FOCALS)), wrong, images) == wrong
