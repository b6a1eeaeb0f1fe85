import dataclasses

import numpy as np
import pytest

from sfm.core.cameras import Camera
from sfm.core.errors import ConfigError
from sfm.core.events import ImageRegistered
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.similarity import Sim3, estimate_similarity
from sfm.core.scene import PairKind, TwoViewGeometry, ViewGraph
from sfm.mapping import MappingConfig, build_tracks, map_incrementally
from sfm.mapping.refinement import drop_misplaced_images, triangulate_seen_by
from sfm.mapping.state import Scene, State
from sfm.mapping.task import MappingTask
from tests.mapping.scenes import PointScene, look_at


def _map(scene, **options):
    return map_incrementally(
        scene.view_graph, scene.keypoints, scene.cameras, scene.image_cameras, scene.image_names, **options
    )


def _pose_errors(scene, model):
    """Largest rotation error in degrees and centre error in scene units, after alignment of the centres."""
    truth = [scene.poses[i - 1] for i in model.image_ids.tolist()]
    centers = np.stack([pose.center for pose in truth])
    world_from_model = estimate_similarity(model.cams_from_world.center, centers)
    assert isinstance(world_from_model, Sim3)
    aligned = world_from_model.transform_pose(model.cams_from_world)
    rotation = max(float((aligned[k].rotation @ pose.rotation.inverse()).angle) for k, pose in enumerate(truth))
    return np.rad2deg(rotation), float(np.abs(aligned.center - centers).max())


def test_exact_matches_give_exact_poses():
    scene = PointScene()
    (model,) = _map(scene, refine_intrinsics=False)
    rotation_deg, position = _pose_errors(scene, model)
    assert len(model.image_names) == 8
    assert rotation_deg < 1e-4
    assert position < 1e-5
    assert len(model.tracks) == 400
    assert model.errors.max() < 1e-3


def test_noise_and_wrong_matches_leave_poses_near_the_truth():
    scene = PointScene(noise_px=0.5, outliers=0.3, seed=1)
    (model,) = _map(scene, refine_intrinsics=False)
    rotation_deg, position = _pose_errors(scene, model)
    assert len(model.image_names) == 8
    assert 1e-4 < rotation_deg < 0.1
    assert position < 0.01
    assert 0.3 < model.errors.mean() < 0.8


def _with_false_wide_pair(scene, first=1, last=8, count=60):
    """The only wide pair is a false one: as if `first` saw some points from a place where it never was."""
    elsewhere = look_at(np.array([4.0, 0.5, -3.0]), np.zeros(3))
    real = scene.view_graph.pairs[first, last].matches[:, 1][:count]
    points = scene.points[scene.order[last][real]]
    xy, valid = scene.camera.project(elsewhere @ points)
    assert valid.all()
    matches = np.stack([len(scene.keypoints[first]) + np.arange(count), real], 1).astype(np.int32)
    scene.keypoints[first] = np.concatenate([scene.keypoints[first], xy])
    motion = scene.poses[last - 1] @ elsewhere.inverse()
    unit = Rigid3(motion.rotation, motion.translation / np.linalg.norm(motion.translation))
    pairs = dict(scene.view_graph.pairs)
    pairs[first, last] = TwoViewGeometry(PairKind.CALIBRATED, matches, unit)
    scene.view_graph = ViewGraph(pairs)
    return scene


def test_a_first_pair_that_leads_nowhere_gives_way_to_the_next():
    scene = _with_false_wide_pair(PointScene(noise_px=0.3, spread_deg=14.0))
    events = []
    (model,) = _map(scene, config=MappingConfig(init_min_inliers=50), refine_intrinsics=False, observer=events.append)
    first = [event.name for event in events if isinstance(event, ImageRegistered)][:2]
    assert first == ["001.jpg", "008.jpg"]
    assert len(model.image_names) == 8
    assert _pose_errors(scene, model)[1] < 0.05


def test_an_image_that_disagrees_with_what_it_should_see_is_misplaced():
    scene, events = PointScene(noise_px=0.3), []
    tracks = build_tracks(scene.view_graph, scene.keypoints, min_length=2)
    rows = Scene.build(tracks, scene.keypoints, scene.cameras, scene.image_cameras, scene.image_names)
    task = MappingTask(rows, scene.view_graph, MappingConfig(), 0, 1, False, events.append)
    state = State.start(rows)
    for row, pose in enumerate(scene.poses):
        state.set_pose(row, pose)
    triangulate_seen_by(task, state, np.arange(8))
    assert not drop_misplaced_images(task, state)
    # What image 3 sees no longer fits, but for one in ten: its own points, as a false pair would have made them.
    mine = rows.observations_of(2)
    state.on[mine[40:]] = False
    assert drop_misplaced_images(task, state)
    assert not state.registered[2]
    assert not state.on[mine].any()
    assert state.registered.sum() == 7
    assert [(event.name, event.reason.split(":")[0]) for event in events] == [("003.jpg", "misplaced")]


def test_many_narrow_matches_start_better_than_few_wide_ones():
    scene = _with_false_wide_pair(PointScene(noise_px=0.3, spread_deg=30.0))
    events = []
    _map(scene, refine_intrinsics=False, observer=events.append)
    first = [event.name for event in events if isinstance(event, ImageRegistered)][:2]
    assert first != ["001.jpg", "008.jpg"]


def test_learnt_precision_of_keypoints_makes_poses_better():
    """Half of the keypoints are ten times as precise as the others; only their scales tell which."""
    gains = []
    for seed in range(3):
        scene, rng = PointScene(points=700, seed=seed), np.random.default_rng(seed)
        scales = {i: np.where(rng.random(len(xy)) < 0.5, 1.5, 6.0) for i, xy in scene.keypoints.items()}
        for i, xy in scene.keypoints.items():
            scene.keypoints[i] = xy + rng.normal(0, 1, xy.shape) * np.where(scales[i] < 2, 0.1, 1.0)[:, None]
        errors = [
            _pose_errors(scene, _map(scene, refine_intrinsics=False, keypoint_scales=given)[0])[1]
            for given in (scales, None)
        ]
        gains.append(errors[0] / errors[1])
    assert max(gains) < 0.6
    assert min(gains) > 0.01


def test_a_wrong_focal_length_is_corrected():
    scene = PointScene(images=10, noise_px=0.2, seed=2)
    guess = Camera("SIMPLE_RADIAL", 1000, 800, np.array([1100.0, 500, 400, 0]))
    (model,) = _map(_with_camera(scene, guess))
    assert len(model.image_names) == 10
    assert model.cameras[1].params[0] == pytest.approx(900, rel=5e-3)
    assert model.cameras[1].params[3] == pytest.approx(-0.05, abs=0.01)


def _with_camera(scene, camera):
    scene.cameras = {1: camera}
    return scene


def test_given_intrinsics_stay_as_they_are():
    scene = PointScene(noise_px=0.5)
    (model,) = _map(scene, refine_intrinsics=False)
    assert np.array_equal(model.cameras[1].params, scene.camera.params)


def test_threads_do_not_change_a_bit():
    scene = PointScene(noise_px=0.5, outliers=0.2)
    one, two = _map(scene, threads=1)[0], _map(scene, threads=2)[0]
    assert np.array_equal(one.points3D, two.points3D)
    assert np.array_equal(one.cams_from_world.matrix, two.cams_from_world.matrix)
    assert np.array_equal(one.tracks.feature_ids, two.tracks.feature_ids)


def test_images_without_common_matches_make_models_of_their_own():
    scene = PointScene(images=9)
    together = {pair: g for pair, g in scene.view_graph.pairs.items() if (pair[0] <= 5) == (pair[1] <= 5)}
    scene.view_graph = ViewGraph(together)
    models = _map(scene, refine_intrinsics=False)
    assert [m.image_ids.tolist() for m in models] == [[1, 2, 3, 4, 5], [6, 7, 8, 9]]


def test_an_image_that_matches_nothing_is_left_out():
    scene = PointScene(images=6)
    scene.view_graph = ViewGraph({pair: g for pair, g in scene.view_graph.pairs.items() if 4 not in pair})
    (model,) = _map(scene, refine_intrinsics=False)
    assert model.image_ids.tolist() == [1, 2, 3, 5, 6]


def test_two_images_make_a_model():
    (model,) = _map(PointScene(images=2, spread_deg=20.0), refine_intrinsics=False)
    assert model.image_ids.tolist() == [1, 2]
    assert len(model.tracks) == 400


def test_no_pair_makes_no_model():
    scene = PointScene(images=3)
    scene.view_graph = ViewGraph({})
    assert _map(scene) == []


def test_a_rotation_in_place_makes_no_model():
    scene = PointScene(images=3)
    pairs = {
        pair: dataclasses.replace(
            g, matches=np.repeat(np.arange(400, dtype=np.int32)[:, None], 2, 1), cam2_from_cam1=g.cam2_from_cam1
        )
        for pair, g in scene.view_graph.pairs.items()
    }
    rays, _ = scene.camera.unproject(scene.keypoints[1])
    for i, pose in enumerate(scene.poses, start=1):
        turned = (pose.rotation @ scene.poses[0].rotation.inverse()) @ rays
        scene.keypoints[i] = scene.camera.project(turned)[0]
    keep = np.all([np.isfinite(xy).all(1) for xy in scene.keypoints.values()], axis=0)
    scene.keypoints = {i: xy[keep] for i, xy in scene.keypoints.items()}
    matches = np.repeat(np.arange(keep.sum(), dtype=np.int32)[:, None], 2, 1)
    scene.view_graph = ViewGraph({p: dataclasses.replace(g, matches=matches) for p, g in pairs.items()})
    assert _map(scene, refine_intrinsics=False) == []


def test_every_registration_is_told():
    events = []
    scene = PointScene(images=5)
    _map(scene, refine_intrinsics=False, observer=events.append)
    told = [e.name for e in events if isinstance(e, ImageRegistered) and not e.reason]
    assert sorted(told) == [f"{i:03d}.jpg" for i in range(1, 6)]


def test_watermarks_are_not_matches():
    scene = PointScene(images=4)
    pairs = {p: dataclasses.replace(g, kind=PairKind.WATERMARK) for p, g in scene.view_graph.pairs.items()}
    scene.view_graph = ViewGraph(pairs)
    assert _map(scene) == []


def test_an_image_that_loses_its_observations_is_taken_out():
    scene = PointScene(images=5, seed=3)
    tracks = build_tracks(scene.view_graph, scene.keypoints)
    built = Scene.build(tracks, scene.keypoints, scene.cameras, scene.image_cameras, scene.image_names)
    state = State.start(built)
    for image, pose in enumerate(scene.poses):
        state.set_pose(image, pose)
    state.triangulate(np.arange(len(tracks)), 4.0, 0.01)
    state.unregister(2)
    assert not state.registered[2]
    assert not state.on[built.observations_of(2)].any()
    assert np.all(np.bincount(built.track_of[state.on], minlength=len(tracks))[state.has_point] >= 2)


@pytest.mark.parametrize("settings", [{"max_error_px": -1.0}, {"loss_scale_px": np.nan}, {"global_growth": 0.5}])
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(ConfigError):
        MappingConfig(**settings)
