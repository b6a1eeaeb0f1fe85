"""The kernels of an adjustment, one observation and one point at a time, against residuals and Jacobians written out.

Two rigs of two sensors and two images beside; a sensor moves on its rig, cameras of different models have free
parameters of different number, some points do not move, one image sees a point twice, and some observations have no
projection.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import _kernels as kernels
from sfm.bundle.layout import Layout, lay_out
from sfm.bundle.problem import BundleProblem
from sfm.bundle.rig_arrays import RigArrays
from sfm.bundle.shared_rows import SENSOR_COLUMN
from sfm.core.cameras._kernels import MAX_PARAMS, project_with_jacobians
from sfm.core.cameras._lane_kernels import LANES
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew
from sfm.core.optim.losses import Loss, evaluate_loss, loss_id
from tests.bundle.conftest import PARAMS, looking_inwards

SCALE, LOST_COST, DAMPING = 1.5, 300.0, 0.07
SIX = np.triu_indices(3)


def scene(rng: np.random.Generator, points: int = 100) -> BundleProblem:
    """As the module says; observations are random in the neighbourhood of the projections."""
    frames = looking_inwards(4, rng)
    mounts = Rigid3.exp(np.array([[0.05, -0.1, 0.02, 0.4, 0.1, -0.2], [0.0, 0.1, 0.0, -0.3, 0.2, 0.1]]))
    image_frames, image_sensors = np.array([0, 0, 1, 1, 2, 3], np.int32), np.array([-1, 0, -1, 0, 1, -1], np.int32)
    rigs = RigArrays(image_frames, image_sensors, frames, mounts, np.array([True, False]))
    poses, params, free = rigs.cams_from_world, np.zeros((3, MAX_PARAMS)), np.zeros((3, MAX_PARAMS), bool)
    for c, name in enumerate(("FULL_OPENCV", "OPENCV_FISHEYE", "SIMPLE_RADIAL")):
        params[c, : len(PARAMS[name])] = PARAMS[name]
    free[0, :12], free[1, [0, 4]] = True, True
    points3D = rng.uniform(-1.5, 1.5, (points, 3))
    points3D[3] = 30 * poses[0].center  # behind most
    rows = np.argwhere(rng.random((points, len(poses))) < 0.8)
    rows = np.concatenate([rows, rows[:2]])
    return BundleProblem(
        model_ids=np.array([6, 5, 2], np.int32),
        camera_params=params,
        image_cameras=np.array([0, 1, 0, 1, 2, 0], np.int32),
        cams_from_world=poses,
        points3D=points3D,
        obs_images=rows[:, 1].astype(np.int32),
        obs_points=rows[:, 0].astype(np.int32),
        obs_points2D=rng.uniform(300, 600, (len(rows), 2)),
        free_params=free,
        free_poses=np.array([True, True, True, True, False, True]),
        free_points=np.arange(points) % 4 > 0,
        obs_sigmas=rng.uniform(50, 200, len(rows)),
        rigs=rigs,
    )


@dataclasses.dataclass
class Slow:
    """Observations one by one, in the order by points: their rows of the weighted residuals and Jacobians."""

    problem: BundleProblem
    layout: Layout
    loss: Loss

    def frame_centers(self) -> np.ndarray:
        """(F, 3)."""
        assert self.problem.rigs is not None
        return self.problem.rigs.rigs_from_world.center

    def observation(self, o: int, points3D: np.ndarray | None = None) -> tuple:
        """ρ (NaN: no projection), and the weighted e (2,), P (2, 3), turn (2, 3), columns (2, k)."""
        problem, lay = self.problem, self.layout
        row, image = lay.original[o], lay.image[o]
        c, X = problem.image_cameras[image], (problem.points3D if points3D is None else points3D)[lay.point[o]]
        pose = problem.cams_from_world[int(image)]
        R, count, columns = pose.rotation.matrix, lay.column_count[image], lay.columns[image]
        x = R @ X + pose.translation
        pixel, by_point, by_params, ok = project_with_jacobians(problem.model_ids[c], problem.camera_params[c], x[None])
        none = np.zeros(2), np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, count))
        if not ok[0]:
            return np.nan, *none
        assert problem.obs_sigmas is not None
        sigma = problem.obs_sigmas[row]
        e = (pixel[0] - problem.obs_points2D[row]) / sigma
        rho, weight = evaluate_loss(self.loss, np.array(e @ e), SCALE)
        root, A = np.sqrt(float(weight)), by_point[0] / sigma
        by_sensor = A @ np.c_[-skew(x), np.eye(3)]
        Q = np.zeros((2, count))
        for k in range(count):
            column = columns[k]
            Q[:, k] = by_params[0][:, column] / sigma if column < MAX_PARAMS else by_sensor[:, column - SENSOR_COLUMN]
        u = X - self.frame_centers()[lay.image_frame[image]]
        return float(rho), root * e, root * A @ R, -root * A @ R @ skew(u), root * Q


@pytest.fixture(params=["trivial", "soft_l1"])
def slow(request, rng) -> Slow:
    problem = scene(rng)
    return Slow(problem, lay_out(problem, rng.random(len(problem.obs_images)) < 0.95), request.param)


def ranges(count: int) -> list[tuple[int, int]]:
    """Two chunks."""
    return [(0, count // 3), (count // 3, count)]


def evaluated(slow: Slow, derive: bool, lost_cost: float = LOST_COST) -> dict[str, np.ndarray]:
    """What `evaluate_images` fills where it derives, and the cost."""
    lay, problem = slow.layout, slow.problem
    images, widest = len(problem.image_cameras), lay.columns.shape[1]
    out = {
        "rows": np.zeros((len(lay.image), 9 + 3 * widest)), "h": np.zeros((images, 6)),
        "F": np.zeros((images, 6, widest)), "G": np.zeros((images, widest, widest)), "f": np.zeros((images, widest)),
    }  # fmt: skip
    ids, costs = problem.model_ids.astype(np.int64), np.full(len(lay.image), -1.0)
    poses, centers = problem.cams_from_world, slow.frame_centers()[lay.slot_frame]
    cost = sum(
        kernels.evaluate_images(
            first, last, lay.image_offsets, lay.image_point, lay.place, lay.observed, lay.precision, lay.image_slot,
            problem.image_cameras.copy(), ids, kernels.squared_limits(ids, problem.camera_params.copy()),
            lay.column_count, lay.columns, poses.rotation.matrix, poses.translation.copy(), centers,
            problem.camera_params.copy(), problem.points3D.copy(), loss_id(slow.loss), SCALE, lost_cost,
            derive, costs, *out.values(),
        )
        for first, last in ranges(images)
    )  # fmt: skip
    return {**out, "cost": np.array(cost), "costs": costs}


def close(found: np.ndarray, expected: np.ndarray) -> None:
    size = np.abs(expected).max(initial=1e-300)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * size)


def test_images_put_into_rows_and_sums_what_their_observations_do_one_by_one(slow):
    found, lay = evaluated(slow, derive=True), slow.layout
    assert np.all(found.pop("costs") == -1)
    expected = {name: np.zeros_like(value) for name, value in found.items()}
    lost = 0
    for o in range(len(lay.image)):
        rho, e, P, turn, Q = slow.observation(o)
        i, count = lay.image[o], lay.column_count[lay.image[o]]
        expected["cost"] += LOST_COST if np.isnan(rho) else 0.5 * rho
        lost += np.isnan(rho)
        expected["rows"][o, : 9 + 3 * count] = np.concatenate([(P.T @ P)[SIX], P.T @ e, (P.T @ Q).T.ravel()])
        expected["f"][i, :count] += Q.T @ e
        expected["G"][i, :count, :count] += np.tril(Q.T @ Q)
        if lay.image_slot[i] >= 0:
            J = np.c_[turn, P]
            expected["h"][i] += J.T @ e
            expected["F"][i, :, :count] += J.T @ Q
    assert lost > 2
    assert np.any(lay.image_slot < 0)
    assert np.diff(lay.image_offsets).max() > LANES
    assert lay.column_count.max() == 12
    assert SENSOR_COLUMN in lay.columns
    for name, value in expected.items():
        scale = np.maximum(np.abs(value).max(axis=0, keepdims=True), 1e-300) if value.ndim else 1.0
        close(found[name] / scale, value / scale)


def test_costs_of_images_are_those_of_their_observations(slow):
    found = evaluated(slow, derive=False, lost_cost=np.nan)
    expected = np.array([slow.observation(o)[0] for o in range(len(found["costs"]))])
    assert 0 < np.isnan(expected).sum() < len(expected) / 2
    np.testing.assert_allclose(found["costs"], expected, rtol=1e-10)
    assert not any(found[name].any() for name in ("rows", "h", "F", "G", "f"))


def couplings_of(lay: Layout, p: int) -> tuple[range, range]:
    """The numbers of the couplings of a point with poses and with shared rows."""
    return range(lay.starts[p], lay.starts[p + 1]), range(lay.shared_starts[p], lay.shared_starts[p + 1])


def gathered(slow: Slow, rows: np.ndarray) -> tuple[np.ndarray, ...]:
    """V, g, N and B as `gather_points` sums them from `rows`."""
    lay, problem, points = slow.layout, slow.problem, len(slow.problem.points3D)
    V, g = np.full((points, 6), np.nan), np.full((points, 3), np.nan)
    N, B = np.full((len(lay.slot), 6), np.nan), np.zeros((len(lay.shared_slot), 3, 6))
    for first, last in ranges(points):
        kernels.gather_points(
            first, last, lay.offsets, lay.obs_slot, lay.column_count, lay.column_place, lay.image, lay.obs_shared,
            lay.starts, problem.free_points.copy(), rows, V, g, N, B,
        )  # fmt: skip
    return V, g, N, B


def test_points_gather_what_their_observations_put_into_rows(slow, rng):
    lay, free = slow.layout, slow.problem.free_points
    rows = rng.normal(size=(len(lay.image), 9 + 3 * lay.columns.shape[1]))
    V, g, N, B = gathered(slow, rows)
    expected = np.zeros_like(V), np.zeros_like(g), np.zeros_like(N), np.zeros_like(B)
    for o, p in enumerate(lay.point):
        image = lay.image[o]
        if free[p]:
            expected[0][p] += rows[o, :6]
            expected[1][p] += rows[o, 6:9]
        own, shared = couplings_of(lay, int(p))
        for e in own:
            if lay.slot[e] == lay.image_slot[image]:
                expected[2][e] += rows[o, :6]
        for e in shared:
            row = lay.shared_slot[e] - len(lay.slot_frame)
            for k in range(lay.column_count[image]):
                mine = lay.column_place[image, k]
                if lay.image_shared[image, mine // 6] == lay.shared_slot[e]:
                    assert lay.shared.columns[row, mine % 6] == lay.columns[image, k]
                    expected[3][e][:, mine % 6] += rows[o, 9 + 3 * k : 12 + 3 * k]
    assert not np.all(free)
    assert len(N) < len(lay.image)
    for found, wanted in zip((V, g, N, B), expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-13)


def symmetric(six: np.ndarray) -> np.ndarray:
    return six[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3)


def test_points_move_by_what_back_substitution_says(slow, rng):
    lay, X = slow.layout, slow.problem.points3D.copy()
    centers, M, g = slow.frame_centers()[lay.slot_frame], rng.normal(size=(len(X), 6)), rng.normal(size=X.shape)
    M[:, [0, 3, 5]] = np.abs(M[:, [0, 3, 5]])
    M[5] = 0
    N, B = rng.normal(size=(len(lay.slot), 6)), rng.normal(size=(len(lay.shared_slot), 3, 6))
    delta, moved = rng.normal(size=(lay.rows, 6)), np.full_like(X, np.nan)
    for first, last in ranges(len(X)):
        kernels.move_points(
            first, last, lay.starts, lay.slot, N, lay.shared_starts, lay.shared_slot, B, centers, X, M, g, delta, moved
        )
    for p in range(len(X)):
        right, (own, shared) = g[p].copy(), couplings_of(lay, p)
        for e in own:
            row = lay.slot[e]
            right += symmetric(N[e]) @ np.c_[-skew(X[p] - centers[row]), np.eye(3)] @ delta[row]
        for e in shared:
            right += B[e] @ delta[lay.shared_slot[e]]
        np.testing.assert_allclose(moved[p], X[p] - symmetric(M[p]) @ right, atol=1e-10)
    assert np.array_equal(moved[5], X[5])


def test_points_settle_where_they_keep_the_most_projections(slow, rng):
    lay, problem = slow.layout, slow.problem
    X, count = problem.points3D.copy(), len(problem.points3D)
    trial = X + 0.3 * rng.normal(size=X.shape)
    trial[7] = X[7] - 20 * problem.cams_from_world[0].rotation.matrix[2]  # behind its cameras
    costs = np.array([slow.observation(o, trial)[0] for o in range(len(lay.image))])
    costs_here = np.array([slow.observation(o)[0] for o in range(len(lay.image))])
    V, g = np.abs(rng.normal(size=(count, 6))), rng.normal(size=(count, 3))
    V[9, [0, 3]] = 1e-20, 1e10  # at least a part of the trace counts, 100 here
    moved, totals = trial.copy(), np.full((2, 5), np.nan)
    for (first, last), total in zip(ranges(count), totals, strict=True):
        kernels.settle_points(
            first, last, lay.offsets, X, LOST_COST, DAMPING, V, g, costs, costs_here, moved, total
        )  # fmt: skip
    expected, stayed = np.zeros(5), []
    for p in range(count):
        mine = range(lay.offsets[p], lay.offsets[p + 1])
        if not len(mine):
            continue
        there, here = costs[mine], np.array([slow.observation(o)[0] for o in mine])
        stays = np.isnan(here).sum() < np.isnan(there).sum()
        stayed += [p] * bool(stays)
        chosen, where = (here, X[p]) if stays else (there, trial[p])
        step, diagonal = where - X[p], V[p, [0, 3, 5]]
        D = np.maximum(diagonal, 1e-8 * diagonal.sum())
        expected += [
            np.where(np.isnan(chosen), LOST_COST, 0.5 * chosen).sum(),
            0.5 * (DAMPING * D * step - g[p]) @ step,
            step @ step, X[p] @ X[p], np.isnan(chosen).sum(),
        ]  # fmt: skip
        np.testing.assert_array_equal(moved[p], where)
    assert 7 in stayed
    assert expected[4] > 0
    np.testing.assert_allclose(totals.sum(axis=0), expected, rtol=1e-10)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 0.99e-4, 1.01e-4, 0.3, 3.1, 20.0])
def test_poses_turn_on_the_right_and_their_centres_go_against_the_shift(rng, angle):
    before, centers = Rotation3.exp(rng.normal(size=(6, 3))), rng.normal(size=(6, 3))
    delta, frames = rng.normal(size=(4, 6)), np.array([4, 0, 3, 1], np.int32)
    delta[:, :3] *= angle / np.linalg.norm(delta[:, :3], axis=1, keepdims=True)
    delta[2] = 0
    poses = before.wxyz.copy(), centers, before.matrix, rng.normal(size=(6, 3))
    moved = tuple(np.full_like(part, np.nan) for part in poses)
    kernels.turn_poses(frames, delta, *poses, *moved)
    for k, frame in enumerate(frames):
        R, place = before.matrix[frame] @ Rotation3.exp(delta[k, :3]).matrix, centers[frame] - delta[k, 3:]
        np.testing.assert_allclose(Rotation3(moved[0][frame]).matrix, R, rtol=0, atol=1e-14 * max(1, angle))
        np.testing.assert_allclose(np.linalg.norm(moved[0][frame]), 1, rtol=0, atol=1e-15)
        np.testing.assert_array_equal(moved[1][frame], place)
        if k != 2:
            np.testing.assert_allclose(moved[2][frame], R, rtol=0, atol=1e-14 * max(1, angle))
            np.testing.assert_allclose(moved[3][frame], -R @ place, rtol=0, atol=1e-13 * max(1, angle))
    for part, old in zip(moved, poses, strict=True):
        assert np.array_equal(part[3], old[3])  # the one that does not move, to the last bit
        assert np.isnan(part[[2, 5]]).all()


def test_a_limit_is_the_square_of_the_radius_within_which_points_have_a_projection():
    params = np.zeros((2, MAX_PARAMS))
    params[0, :4], params[1, :4] = [800, 500, 400, -0.2], [800, 500, 400, 0.1]
    limits = kernels.squared_limits(np.array([2, 2]), params)
    radii = np.linspace(0.01, 5, 5000)
    *_, valid = project_with_jacobians(2, params[0], np.c_[radii, 0 * radii, 1 + 0 * radii])
    assert np.sqrt(limits[0]) == pytest.approx(radii[valid].max(), abs=2e-3)
    assert limits[1] == np.inf
