import numpy as np
import pytest

from sfm.core.errors import Rejected
from sfm.core.events import Note
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.similarity import Sim3
from sfm.core.scene import TwoViewGeometry, ViewGraph
from sfm.mapping import MappingConfig, map_incrementally
from sfm.mapping.joining import Join, find_join, join_doubt, merged
from sfm.mapping.state import State
from tests.mapping.scenes import PointScene
from tests.mapping.test_leftovers import position_error

IMAGES, HALF = 10, 5
FIRST = np.arange(IMAGES) < HALF
A_FROM_B = Sim3(np.asarray(2.5), Rotation3.exp(np.array([0.3, -0.8, 0.2])), np.array([4.0, -1.0, 7.0]))


def half_scene(common, seed=0):
    """Two halves of an arc of images, between which only the points `common` are matched."""
    scene = PointScene(images=IMAGES, noise_px=0.4, seed=seed)
    scene.keep_matches(lambda i, j, points: np.isin(points, common) | (FIRST[i - 1] == FIRST[j - 1]))
    return scene


def mapped(scene, **config):
    """Models of a mapper that leaves the halves apart while they grow, and what it noted."""
    events = []
    models = map_incrementally(
        scene.view_graph, scene.keypoints, scene.cameras, scene.image_cameras, scene.image_names,
        MappingConfig(resection_min_inliers=80, leftover_min_inliers=80, **config),
        refine_intrinsics=False, observer=events.append,
    )  # fmt: skip
    return models, [event.message for event in events if isinstance(event, Note)]


@pytest.mark.parametrize("seed", range(2))
def test_two_half_models_with_common_points_are_joined(seed):
    scene = half_scene(np.arange(40), seed)
    (model,), notes = mapped(scene)
    assert notes == ["models of 5 and 5 images joined by 40 common tracks"]
    assert model.image_ids.tolist() == list(range(1, IMAGES + 1))
    assert 1e-5 < position_error(scene, model) < 0.02
    apart, notes = mapped(scene, join_min_tracks=41)
    assert [len(model.image_ids) for model in apart] == [5, 5]
    assert notes == []


@pytest.mark.parametrize("seed", range(2))
def test_two_unrelated_models_are_not(seed):
    """The forty matches between them are wrong."""
    scene, rng = half_scene(np.arange(40), seed), np.random.default_rng(seed)
    pairs = {}
    for (i, j), geometry in scene.view_graph.pairs.items():
        matches = geometry.matches.copy()
        if FIRST[i - 1] != FIRST[j - 1]:
            matches[:, 1] = rng.permutation(matches[:, 1])
        pairs[i, j] = TwoViewGeometry(geometry.kind, matches, geometry.cam2_from_cam1)
    scene.view_graph = ViewGraph(pairs)
    models, _ = mapped(scene)
    assert [len(model.image_ids) for model in models] == [5, 5]


def halves(scene):
    """States of the two halves at the true poses, the second in a world of its own."""
    rows, states = scene.rows(), []
    for half, own_from_world in ((FIRST, Sim3.identity()), (~FIRST, A_FROM_B.inverse())):
        state = State.start(rows)
        for row in np.flatnonzero(half).tolist():
            state.set_pose(row, own_from_world.transform_pose(scene.poses[row]))
        state.triangulate(np.arange(len(state.has_point)), 4.0, 0.01)
        states.append(state)
    return states


def found(a, b, **options):
    return find_join(a, b, **({"max_error_px": 12.0, "min_agreeing": 20} | options), rng=np.random.default_rng(0))


def test_the_similarity_between_exact_halves_is_found():
    a, b = halves(PointScene(images=IMAGES))
    join = found(a, b)
    assert isinstance(join, Join)
    assert (join.agreeing, join.shared) == (400, 400)
    assert np.abs((join.a_from_b @ A_FROM_B.inverse()).log()).max() < 1e-6


def test_a_similarity_is_found_among_wrong_tracks():
    scene = half_scene(np.arange(100))
    a, b = halves(scene)
    wrong = np.random.default_rng(0).permutation(np.flatnonzero(a.has_point & b.has_point))[:30]
    b.points[wrong] = b.points[np.roll(wrong, 1)]
    join = found(a, b)
    assert isinstance(join, Join)
    difference = (join.a_from_b @ A_FROM_B.inverse()).log()
    assert 1e-6 < np.abs(difference).max() < 0.05


def test_too_few_common_tracks_are_refused_before_any_work():
    a, b = halves(half_scene(np.arange(19)))
    refused = found(a, b)
    assert isinstance(refused, Rejected)
    assert refused.reason == "too_few_common_tracks"


def test_the_merged_model_is_that_of_all_images():
    scene = PointScene(images=IMAGES)
    a, b = halves(scene)
    both = merged(a, b, A_FROM_B)
    assert both.registered.all()
    assert not a.registered[~FIRST].any()
    poses = Rigid3(Rotation3.from_matrix(both.R), both.t)
    for row, pose in enumerate(scene.poses):
        assert np.allclose(poses[row].center, pose.center, atol=1e-9)
        assert float((poses[row].rotation @ pose.rotation.inverse()).angle) < 1e-7
    assert both.on.sum() == a.on.sum() + b.on.sum()
    assert both.filter(np.arange(len(both.has_point)), 0.01, 0.01) == 0


def test_a_join_is_doubted_where_images_or_common_points_are_lost():
    scene = PointScene(images=IMAGES)
    a, b = halves(scene)
    both = merged(a, b, A_FROM_B)
    assert join_doubt(both, FIRST, ~FIRST, 20) is None
    torn = both.copy()
    torn.on[(torn.scene.track_of % 2 == 0) & FIRST[torn.scene.image]] = False
    doubt = join_doubt(torn, FIRST, ~FIRST, 20)
    assert doubt is not None
    assert doubt.reason == "few_common_points"
    both.unregister(IMAGES - 1)
    doubt = join_doubt(both, FIRST, ~FIRST, 20)
    assert doubt is not None
    assert doubt.reason == "lost_images"
