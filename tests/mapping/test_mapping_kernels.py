import numpy as np
import pytest

from sfm.core.geometry.rigid import Rigid3
from sfm.mapping import build_tracks
from sfm.mapping._kernels import mean_errors, visibility_scores
from sfm.mapping.initialization import InitialPair, acceptable_pairs
from sfm.mapping.state import Scene, State
from tests.mapping.scenes import PointScene


def _state(noise_px=0.5, wrong=0):
    """True poses and no points yet; the first `wrong` observations are moved far away."""
    scene = PointScene(images=5, points=60, noise_px=noise_px, seed=4)
    tracks = build_tracks(scene.view_graph, scene.keypoints)
    built = Scene.build(tracks, scene.keypoints, scene.cameras, scene.image_cameras, scene.image_names)
    built.xy[:wrong] += 60.0
    state = State.start(built)
    for image, pose in enumerate(scene.poses):
        state.set_pose(image, pose)
    return state


def _errors(state):
    """Reprojection error of every observation, one by one."""
    s, out = state.scene, np.full(len(state.scene.xy), np.nan)
    for o in range(len(out)):
        image, track = s.image[o], s.track_of[o]
        if state.has_point[track]:
            in_camera = state.R[image] @ state.points[track] + state.t[image]
            xy, valid = state.camera(int(s.image_camera[image])).project(in_camera[None])
            out[o] = np.linalg.norm(xy[0] - s.xy[o]) if valid[0] else np.inf
    return out


def test_triangulated_points_take_exactly_the_observations_that_fit():
    state = _state(wrong=7)
    made, _ = state.triangulate(np.arange(len(state.has_point)), 4.0, 0.01)
    assert made == state.has_point.sum() == 60
    assert np.array_equal(state.on, _errors(state) <= 4.0)
    assert 0 < np.sum(~state.on) <= 7


def test_a_second_pass_adds_what_fits_by_now():
    state = _state()
    everything = np.arange(len(state.has_point))
    state.triangulate(everything, 4.0, 0.01)
    state.on[::3] = False
    _, added = state.triangulate(everything, 4.0, 0.01)
    assert added == len(state.on[::3])
    assert state.on.all()


def test_the_filter_drops_what_its_twin_drops():
    state = _state()
    everything = np.arange(len(state.has_point))
    state.triangulate(everything, 10.0, 0.01)
    errors, before = _errors(state), state.on.copy()
    dropped = state.filter(everything, 0.4, 0.0)
    kept = before & (errors <= 0.4)
    alone = np.bincount(state.scene.track_of[kept], minlength=len(everything)) < 2
    assert np.array_equal(state.on, kept & ~alone[state.scene.track_of])
    assert np.array_equal(state.has_point, ~alone)
    assert dropped == before.sum() - state.on.sum()


def test_the_filter_drops_points_of_narrow_rays():
    state = _state()
    everything = np.arange(len(state.has_point))
    state.triangulate(everything, 4.0, 0.01)
    assert state.filter(everything, 4.0, np.deg2rad(89.0)) > 0
    assert not state.has_point.any()


def test_mean_errors_are_means_of_the_observations_that_count():
    state = _state()
    state.triangulate(np.arange(len(state.has_point)), 4.0, 0.01)
    state.on[::4] = False
    state.has_point[5] = False
    s = state.scene
    found = mean_errors(
        s.offsets, s.image, s.xy, state.on, state.points, state.has_point,
        state.R, state.t, s.image_camera, state.model_ids, state.params,
    )  # fmt: skip
    errors = _errors(state)
    for track in range(len(found)):
        rows = np.flatnonzero((s.track_of == track) & state.on)
        assert found[track] == pytest.approx(errors[rows].mean() if state.has_point[track] else -1.0)


def test_visibility_scores_count_cells_of_a_pyramid(rng):
    state = _state()
    state.has_point[:] = rng.random(len(state.has_point)) < 0.5
    s, images = state.scene, np.arange(5)
    counts, scores = visibility_scores(
        images, s.image_offsets, s.image_observations, s.track_of, state.has_point, s.xy, s.sizes, 6
    )
    for image in images.tolist():
        rows = [o for o in s.observations_of(image) if state.has_point[s.track_of[o]]]
        score = 0
        for level in range(1, 7):
            cells = {tuple((s.xy[o] / s.sizes[image] * 2**level).astype(int)) for o in rows}
            score += len(cells) * 4**level
        assert (counts[image], scores[image]) == (len(rows), score)


def test_initial_pairs_come_once_each_with_thresholds_relaxed_step_by_step():
    def pair(name, inliers, angle, forward=0.0):
        return InitialPair(name, name + 1, Rigid3.identity(), inliers, angle, forward)

    candidates = [pair(0, 40, 0.3), pair(1, 200, 0.02), pair(2, 150, 0.3, 0.99), pair(3, 120, 0.3), pair(4, 5, 0.3)]
    assert [p.image1 for p in acceptable_pairs(candidates, 100, 0.28, 0.95)] == [3, 2, 0, 1]
