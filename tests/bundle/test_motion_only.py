import dataclasses

import jaxtyping
import numpy as np
import pytest
from scipy.linalg import expm

from sfm.bundle import BundleConfig, BundleProblem, adjust
from sfm.bundle.motion_only import MotionConfig, MotionSystem, refine_motion
from sfm.bundle.motion_problem import MotionProblem, motion_problem
from sfm.core.cameras import Camera
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.geometry.epipolar import essential_from_pose, squared_tangent_sampson_errors
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.optim import System, evaluate_loss
from sfm.core.scene import PairKind, TwoViewGeometry, ViewGraph
from sfm.evaluation.pose_errors import relative_pose_errors
from tests.bundle.conftest import PARAMS, looking_inwards

LEAST_SQUARES = MotionConfig(loss="trivial", relative_cost_tolerance=1e-12)


class Scene:
    """Points that all cameras see, matched between all pairs or those given."""

    def __init__(self, rng, *, images=6, points=80, noise_px=0.5, model="SIMPLE_RADIAL", flat=False, pairs=None):
        self.camera = Camera(model, 1000, 760, np.array(PARAMS[model]))
        self.poses = looking_inwards(images, rng)
        self.points3D = rng.uniform(-1.5, 1.5, (points, 3)) * ([1, 1, 0] if flat else [1, 1, 1])
        self.keypoints = {}
        for k in range(images):
            points2D, valid = self.camera.project(self.poses[k] @ self.points3D)
            assert valid.all()
            self.keypoints[k + 1] = points2D + noise_px * rng.normal(size=points2D.shape)
        everyone = np.stack([np.arange(points)] * 2, 1).astype(np.int32)
        pairs = [(i, j) for i in self.keypoints for j in self.keypoints if i < j] if pairs is None else pairs
        self.view_graph = ViewGraph({pair: TwoViewGeometry(PairKind.CALIBRATED, everyone) for pair in pairs})

    def problem(self, poses=None) -> MotionProblem:
        poses = self.poses if poses is None else poses
        by_id = {k + 1: poses[k] for k in range(len(poses))}
        return motion_problem(by_id, dict.fromkeys(by_id, self.camera), self.keypoints, self.view_graph)

    def bundle(self, poses) -> BundleProblem:
        images, points = len(poses), len(self.points3D)
        params = np.zeros((1, MAX_PARAMS))
        params[0, : len(self.camera.params)] = self.camera.params
        return BundleProblem(
            model_ids=np.array([self.camera.model_info.model_id], np.int32),
            camera_params=params,
            image_cameras=np.zeros(images, np.int32),
            cams_from_world=poses,
            points3D=self.points3D,
            obs_images=np.repeat(np.arange(images), points).astype(np.int32),
            obs_points=np.tile(np.arange(points), images).astype(np.int32),
            obs_points2D=np.concatenate(list(self.keypoints.values())),
            free_params=np.zeros((1, MAX_PARAMS), bool),
            free_poses=np.ones(images, bool),
            free_points=np.ones(points, bool),
        )


def disturbed(poses, rng, degrees=1.0, part=0.01):
    """Each turned by a degree, each centre moved by a part of the distance from the origin."""
    size = np.linalg.norm(poses.center, axis=1).mean()
    turns = Rotation3.exp(np.deg2rad(degrees) * unit(rng, len(poses)))
    rotation = turns @ poses.rotation
    return Rigid3(rotation, -(rotation @ (poses.center + part * size * unit(rng, len(poses)))))


def unit(rng, count):
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def mean_error_deg(poses, scene):
    errors = relative_pose_errors(poses, scene.poses)
    return errors.error_deg.mean()


def skew_of(vector):
    x, y, z = vector
    return np.array([[0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x]])


def residual(R1, C1, R2, C2, match):
    """The tangent Sampson error of one match, from the essential matrix; analytic in the poses."""
    r1, r2, J1, J2 = match
    R = R2 @ R1.T
    E = skew_of(R2 @ (C1 - C2)) @ R
    n1, n2 = J1 @ (E.T @ r2), J2 @ (E @ r1)
    return (r2 @ E @ r1) / np.sqrt(n1 @ n1 + n2 @ n2)


def moved(R, C, tangent):
    turn = expm(skew_of(tangent[:3]))
    return R @ turn, C - turn.T @ tangent[3:]


def matches_of(problem, pair):
    rows = range(problem.offsets[pair], problem.offsets[pair + 1])
    return [(problem.rays1[o], problem.rays2[o], problem.tangents1[o], problem.tangents2[o]) for o in rows]


def normal_equations(problem, config, threads=1):
    system = MotionSystem(problem, config, threads)
    return system, *system.linearize()


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_RADIAL", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("loss", ["trivial", "huber", "cauchy"])
def test_the_cost_is_that_of_the_tangent_sampson_errors(rng, model, loss):
    scene = Scene(rng, model=model)
    problem = scene.problem(disturbed(scene.poses, rng))
    _, cost, _ = normal_equations(problem, MotionConfig(loss=loss, loss_scale_px=2.0))
    expected = 0.0
    for m, (i, j) in enumerate(zip(problem.first, problem.second, strict=True)):
        motion = problem.cams_from_world[int(j)] @ problem.cams_from_world[int(i)].inverse()
        rows = slice(problem.offsets[m], problem.offsets[m + 1])
        squared = squared_tangent_sampson_errors(
            essential_from_pose(motion), problem.rays1[rows], problem.rays2[rows],
            problem.tangents1[rows].swapaxes(1, 2), problem.tangents2[rows].swapaxes(1, 2),
        )  # fmt: skip
        expected += 0.5 * evaluate_loss(loss, squared, 2.0)[0].sum()
    assert cost == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(("degrees", "part"), [(0.0, 0.0), (3.0, 0.05), (180.0, 0.9)])
def test_jacobians_agree_with_complex_steps(rng, degrees, part):
    """One match has H = Jᵀ J and g = Jᵀ r, with J by twelve numbers: from complex steps of both poses."""
    scene = Scene(rng, images=2, points=1, noise_px=5.0)
    problem = scene.problem(disturbed(scene.poses, rng, degrees, part))
    (match,), R, C = matches_of(problem, 0), problem.cams_from_world.rotation.matrix, problem.cams_from_world.center
    r, J = residual(R[0], C[0], R[1], C[1], match), np.empty(12)
    for k in range(12):
        step = np.zeros((2, 6), complex)
        step.flat[k] = 1e-20j
        J[k] = residual(*moved(R[0], C[0], step[0]), *moved(R[1], C[1], step[1]), match).imag / 1e-20
    config = MotionConfig(loss="trivial")
    system = MotionSystem(problem, config, 1)
    system.linearize()
    blocks, gradient = system._assemble()
    np.testing.assert_allclose(gradient.ravel(), J * r, rtol=1e-6, atol=1e-9 * np.abs(J * r).max())
    H = np.block([[blocks[0], blocks[1].T], [blocks[1], blocks[2]]])
    np.testing.assert_allclose(H, np.outer(J, J), rtol=1e-6, atol=1e-9 * np.abs(H).max())


@pytest.mark.parametrize("loss", ["trivial", "soft_l1", "cauchy"])
def test_the_gradient_agrees_with_central_differences(rng, loss):
    scene = Scene(rng, images=4, points=20)
    problem = scene.problem(disturbed(scene.poses, rng))
    config = MotionConfig(loss=loss)
    system, _, _ = normal_equations(problem, config)
    gradient = system._assemble()[1]
    poses = problem.cams_from_world
    for image in range(4):
        for k in range(6):
            ends = []
            for sign in (1, -1):
                tangent = np.zeros(6)
                tangent[k] = sign * 1e-6
                turn = Rotation3.exp(tangent[:3])
                rotation = poses[image].rotation @ turn
                center = poses[image].center - turn.inverse() @ tangent[3:]
                there = Rigid3(rotation, -(rotation @ center))
                other = Rigid3.stack([there if n == image else poses[n] for n in range(4)])
                ends.append(normal_equations(dataclasses.replace(problem, cams_from_world=other), config)[1])
            assert gradient[image, k] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-6, abs=1e-2)


def test_the_system_is_one_that_the_damping_loop_takes(rng):
    assert isinstance(MotionSystem(Scene(rng).problem(), MotionConfig(), 1), System)


def test_without_noise_the_true_poses_are_found(rng):
    scene = Scene(rng, noise_px=0.0)
    result = refine_motion(scene.problem(disturbed(scene.poses, rng)), LEAST_SQUARES)
    assert result.final_cost < 1e-12 * result.initial_cost
    assert mean_error_deg(result.cams_from_world, scene) < 1e-5


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV_FISHEYE"])
def test_poses_are_nearly_as_good_as_those_of_bundle_adjustment(rng, model):
    scene = Scene(rng, images=8, points=150, model=model)
    start = disturbed(scene.poses, rng)
    ours = mean_error_deg(refine_motion(scene.problem(start), LEAST_SQUARES).cams_from_world, scene)
    best = adjust(scene.bundle(scene.poses), BundleConfig(relative_cost_tolerance=1e-12)).problem.cams_from_world
    assert ours < 0.1 * mean_error_deg(start, scene)
    assert ours < 1.5 * mean_error_deg(best, scene)


def test_wrong_matches_do_little_harm(rng):
    scene = Scene(rng, images=6, points=150)
    pairs = {}
    for pair, geometry in scene.view_graph.pairs.items():
        matches = geometry.matches.copy()
        wrong = np.flatnonzero(rng.random(len(matches)) < 0.1)
        matches[wrong, 1] = rng.permutation(matches[wrong, 1])
        pairs[pair] = TwoViewGeometry(PairKind.CALIBRATED, matches)
    clean, scene.view_graph = scene.view_graph, ViewGraph(pairs)
    start = disturbed(scene.poses, rng)
    found = refine_motion(scene.problem(start)).cams_from_world
    scene.view_graph = clean
    best = refine_motion(scene.problem(start)).cams_from_world
    assert mean_error_deg(found, scene) < 2 * mean_error_deg(best, scene)


def test_a_flat_scene_is_no_trouble(rng):
    scene = Scene(rng, flat=True)
    start = disturbed(scene.poses, rng)
    result = refine_motion(scene.problem(start))
    assert mean_error_deg(result.cams_from_world, scene) < 0.2 * mean_error_deg(start, scene)


def test_one_pair_keeps_the_length_of_its_baseline_nearly(rng):
    scene = Scene(rng, images=2, points=100)
    start = disturbed(scene.poses, rng)
    result = refine_motion(scene.problem(start))
    lengths = [np.linalg.norm(p.center[1] - p.center[0]) for p in (start, result.cams_from_world)]
    assert lengths[1] == pytest.approx(lengths[0], rel=0.1)
    assert mean_error_deg(result.cams_from_world, scene) < 0.2 * mean_error_deg(start, scene)


def test_a_chain_of_pairs_finds_its_relative_poses(rng):
    scene = Scene(rng, images=4, points=100, noise_px=0.0, pairs=[(1, 2), (2, 3), (3, 4)])
    result = refine_motion(scene.problem(disturbed(scene.poses, rng)), LEAST_SQUARES)
    assert np.isfinite(result.cams_from_world.matrix).all()
    for k in range(3):
        errors = relative_pose_errors(result.cams_from_world[k : k + 2], scene.poses[k : k + 2])
        assert errors.error_deg.max() < 1e-4


def test_parts_that_no_pair_ties_are_refined_side_by_side(rng):
    scene = Scene(rng, images=7, noise_px=0.0, pairs=[(1, 2), (2, 3), (1, 3), (4, 5), (5, 6), (4, 6)])
    start = disturbed(scene.poses, rng)
    found = refine_motion(scene.problem(start), LEAST_SQUARES).cams_from_world
    for part in ([0, 1, 2], [3, 4, 5]):
        assert relative_pose_errors(found[part], scene.poses[part]).error_deg.max() < 1e-4
    np.testing.assert_array_equal(found.matrix[6], start.matrix[6])


def test_without_matches_nothing_changes(rng):
    scene = Scene(rng, pairs=[])
    result = refine_motion(scene.problem())
    assert (result.reason, result.final_cost) == ("no_free_parameters", 0.0)
    np.testing.assert_array_equal(result.cams_from_world.matrix, scene.poses.matrix)
    nobody = refine_motion(motion_problem({}, {}, {}, ViewGraph({})))
    assert nobody.cams_from_world.shape == (0,)


def test_pairs_that_only_turn_take_no_part(rng):
    scene = Scene(rng, images=3, pairs=[(1, 2), (2, 3)])
    turned = Rigid3.stack([scene.poses[0], scene.poses[1], Rigid3.exp(np.eye(6)[0] * 0.1) @ scene.poses[1]])
    result = refine_motion(scene.problem(turned))
    assert result.without_baseline in (0, 80)  # exactly the same place, or but for rounding
    assert np.isfinite(result.cams_from_world.matrix).all()
    pairs = {(1, 2): TwoViewGeometry(PairKind.PANORAMIC, scene.view_graph.pairs[1, 2].matches)}
    scene.view_graph = ViewGraph(pairs)
    assert refine_motion(scene.problem()).reason == "no_free_parameters"


def test_cameras_at_one_place_are_counted_and_left_alone(rng):
    scene = Scene(rng, images=2)
    same = Rigid3(scene.poses.rotation, np.zeros((2, 3)))
    result = refine_motion(scene.problem(same))
    assert (result.reason, result.without_baseline) == ("no_free_parameters", 80)
    np.testing.assert_array_equal(result.cams_from_world.matrix, same.matrix)


def test_constant_poses_stay_to_the_last_bit(rng):
    scene = Scene(rng)
    problem = scene.problem(disturbed(scene.poses, rng))
    free = np.array([True, False, True, True, False, True])
    result = refine_motion(dataclasses.replace(problem, free_poses=free))
    np.testing.assert_array_equal(result.cams_from_world.matrix[~free], problem.cams_from_world.matrix[~free])
    assert not np.any(result.cams_from_world.matrix[free] == problem.cams_from_world.matrix[free])
    assert result.final_cost < result.initial_cost


def test_the_result_is_the_same_for_any_number_of_threads(rng):
    scene = Scene(rng, images=7)
    problem = scene.problem(disturbed(scene.poses, rng))
    one, many = (refine_motion(problem, threads=threads) for threads in (1, 5))
    np.testing.assert_array_equal(one.cams_from_world.matrix, many.cams_from_world.matrix)
    assert one.final_cost == many.final_cost


def test_the_frame_of_the_world_does_not_matter(rng):
    scene = Scene(rng)
    start = disturbed(scene.poses, rng)
    here = refine_motion(scene.problem(start), LEAST_SQUARES).cams_from_world
    elsewhere = Rigid3.exp(rng.normal(size=6) * 2)
    there = refine_motion(scene.problem(start @ elsewhere), LEAST_SQUARES).cams_from_world
    errors = relative_pose_errors(there, here @ elsewhere)
    assert errors.error_deg.max() < 1e-4


def test_keypoints_that_are_not_numbers_are_left_out(rng):
    scene = Scene(rng, images=3)
    scene.keypoints[2][:7] = np.nan
    problem = scene.problem()
    np.testing.assert_array_equal(np.diff(problem.offsets), [73, 80, 73])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rays1": np.full((80, 3), np.nan)}, "rays1 must be finite"),
        ({"first": np.array([5], np.int32)}, r"first must lie in 0\.\.1, got 5"),
        ({"second": np.array([0], np.int32)}, "two images"),
        ({"offsets": np.array([0, 79])}, "rise from 0 to 80"),
        ({"free_poses": np.ones(3, bool)}, None),
        ({"tangents1": np.zeros((79, 2, 3))}, None),
        ({"cams_from_world": Rigid3(Rotation3.identity((2,)), np.full((2, 3), np.nan))}, "poses must be finite"),
    ],
)
def test_impossible_problems_are_refused(rng, changes, words):
    with pytest.raises((ValueError, jaxtyping.TypeCheckError), match=words):
        dataclasses.replace(Scene(rng, images=2).problem(), **changes)


@pytest.mark.parametrize(
    "settings",
    [
        {"loss": "median"},
        {"loss_scale_px": 0.0},
        {"loss_scale_px": float("nan")},
        {"loss_scale_px": 1e-160},
        {"max_iterations": -1},
        {"relative_cost_tolerance": float("nan")},
        {"relative_cost_tolerance": -1.0},
        {"gradient_tolerance": 1.0},
    ],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises((ValueError, jaxtyping.TypeCheckError)):
        MotionConfig(**settings)
