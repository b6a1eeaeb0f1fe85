import itertools
import math

import numpy as np
import pytest

from sfm.core.events import ImageRegistered
from sfm.core.geometry.similarity import Sim3, estimate_similarity
from sfm.mapping import MappingConfig, map_incrementally
from sfm.mapping.leftovers import chance_doubt, log10_false_alarms, loss_doubt, match_doubt
from sfm.mapping.state import State
from tests.mapping.scenes import PointScene, look_at

LAST = 8


def sparse_last_image(few, seed=0, **options):
    """The last of eight images is matched by the points `few` only."""
    scene = PointScene(images=LAST, noise_px=0.4, seed=seed, **options)
    scene.keep_matches(lambda i, j, points: np.isin(points, few) | (j != LAST))
    return scene


def move_keypoints(scene, points, xy):
    """Puts the keypoints of these points in the last image elsewhere."""
    feature_of = np.argsort(scene.order[LAST])
    scene.keypoints[LAST][feature_of[points]] = xy


def mapped(scene, **config):
    events = []
    models = map_incrementally(
        scene.view_graph, scene.keypoints, scene.cameras, scene.image_cameras, scene.image_names,
        MappingConfig(**config), refine_intrinsics=False, observer=events.append,
    )  # fmt: skip
    last = [e.reason.split(":")[0] for e in events if isinstance(e, ImageRegistered) and e.name == "008.jpg"]
    return models[0], last


def position_error(scene, model):
    truth = np.stack([scene.poses[i - 1].center for i in model.image_ids.tolist()])
    world_from_model = estimate_similarity(model.cams_from_world.center, truth)
    assert isinstance(world_from_model, Sim3)
    return float(np.abs(world_from_model @ model.cams_from_world.center - truth).max())


@pytest.mark.parametrize("seed", range(3))
def test_an_image_with_twenty_good_observations_comes_in_last(seed):
    scene = sparse_last_image(np.arange(20), seed=seed)
    model, told = mapped(scene)
    assert told == [""]
    assert model.image_ids.tolist() == list(range(1, LAST + 1))
    assert 1e-5 < position_error(scene, model) < 0.02


def test_without_the_last_round_it_stays_out():
    model, told = mapped(sparse_last_image(np.arange(20)), leftover_min_inliers=30)
    assert told == []
    assert LAST not in model.image_ids


@pytest.mark.parametrize("seed", range(3))
def test_an_image_with_twenty_random_observations_stays_out(seed):
    scene = sparse_last_image(np.arange(20), seed=seed)
    move_keypoints(scene, np.arange(20), np.random.default_rng(seed).uniform(100, 700, (20, 2)))
    model, told = mapped(scene)
    assert LAST not in model.image_ids
    assert told
    assert "" not in told


def test_points_side_by_side_are_not_enough():
    scene, crowd = PointScene(images=LAST), np.arange(20)
    scene.points[crowd] *= 0.12
    for i, pose in enumerate(scene.poses, start=1):
        feature_of = np.argsort(scene.order[i])
        scene.keypoints[i][feature_of[crowd]] = scene.camera.project(pose @ scene.points[crowd])[0]
    scene.keep_matches(lambda i, j, points: np.isin(points, crowd) | (j != LAST))
    model, told = mapped(scene)
    assert LAST not in model.image_ids
    assert told == ["maybe_by_chance"]


def test_a_pose_that_the_other_matches_contradict_is_undone():
    """Twenty points as from a wrong place; sixty matches with image 7 alone, which make no points, know better."""
    few, others = np.arange(20), np.arange(20, 80)

    def kept(i, j, points):
        if (i, j) == (LAST - 1, LAST):
            return np.isin(points, few) | np.isin(points, others)
        return np.isin(points, few) if j == LAST else ~np.isin(points, others)

    scene = PointScene(images=LAST, noise_px=0.4)
    scene.keep_matches(kept)
    wrong = look_at(np.array([-3.0, 1.0, -4.0]), np.zeros(3))
    true_model, told = mapped(scene)
    assert told == [""]
    assert LAST in true_model.image_ids
    move_keypoints(scene, few, scene.camera.project(wrong @ scene.points[few])[0])
    model, told = mapped(scene)
    assert told == ["contradicts_matches"]
    without = mapped(scene, leftover_min_inliers=30)[0]
    # Undone without a trace, but for adjustments while it was tried.
    assert model.image_ids.tolist() == without.image_ids.tolist()
    assert position_error(scene, model) == pytest.approx(position_error(scene, without), rel=0.05)


def test_threads_do_not_change_a_last_round():
    scene = sparse_last_image(np.arange(20))
    one, two = (
        map_incrementally(
            scene.view_graph, scene.keypoints, scene.cameras, scene.image_cameras, scene.image_names, threads=threads
        )[0]
        for threads in (1, 2)
    )
    assert LAST in one.image_ids
    assert np.array_equal(one.cams_from_world.matrix, two.cams_from_world.matrix)


def true_state(scene):
    """All images at their true poses, with the points that follow."""
    state = State.start(scene.rows())
    for row, pose in enumerate(scene.poses):
        state.set_pose(row, pose)
    state.triangulate(np.arange(len(state.has_point)), 4.0, 0.01)
    return state


def test_doubts_arise_one_by_one():
    scene = PointScene(images=LAST, noise_px=0.4)
    state, image = true_state(scene), LAST - 1
    alone = np.arange(LAST) == image
    assert chance_doubt(state, image, 12.0) is None
    assert loss_doubt(state, image, 15) is None
    assert match_doubt(state, alone, ~alone, scene.view_graph, 4.0) is None
    mine = state.scene.observations_of(image)
    state.on[mine[14:]] = False
    lost = loss_doubt(state, image, 15)
    assert lost is not None
    assert lost.reason == "few_points_hold"
    state.on[mine] = False
    assert chance_doubt(state, image, 12.0) is not None
    state.t[image] += [0.5, 0.0, 0.3]
    against = match_doubt(state, alone, ~alone, scene.view_graph, 4.0)
    assert against is not None
    assert against.reason == "contradicts_matches"


def test_false_alarms_count_what_random_cells_would_do():
    """Every choice of agreeing cells and of samples within them, one by one."""
    n, k, chance = 7, 5, 1e-2
    choices = sum(1 for cells in itertools.combinations(range(n), k) for _ in itertools.combinations(cells, 3))
    expected = 4 * (n - 3) * choices * chance ** (k - 3)
    assert log10_false_alarms(k, n, chance) == pytest.approx(math.log10(expected))
    assert log10_false_alarms(3, 3, chance) == math.inf


def test_more_agreement_is_less_likely_chance_and_more_cells_are_more():
    alarms = [log10_false_alarms(k, 40, 5e-4) for k in range(4, 41)]
    assert np.all(np.diff(alarms) < 0)
    assert log10_false_alarms(10, 40, 5e-4) > log10_false_alarms(10, 20, 5e-4)
