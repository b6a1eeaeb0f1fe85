"""Each step of the lanes against one observation at a time."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from sfm.bundle import _lane_kernels as lanes
from sfm.core.cameras import _lane_kernels as camera_lanes
from sfm.core.cameras._kernels import MAX_PARAMS
from sfm.core.cameras._lane_kernels import LANES
from sfm.core.geometry.rotation import Rotation3, skew
from sfm.core.optim.losses import LOSSES, Loss, evaluate_loss, loss_id

SCALE, LOST_COST = 1.7, 1234.5
R, T = Rotation3.exp(np.array([0.3, -0.8, 0.5])).matrix, np.array([0.2, -0.1, 4.0])
UNSEEN, ENDED = (5, 17), (60, 61, 62, 63)
"""Lanes without a projection, and those beyond the end of the image."""


@dataclasses.dataclass
class Workspace:
    """A workspace of which the camera has filled its rows, and what is in it by lane."""

    w: np.ndarray
    world: np.ndarray
    observed: np.ndarray
    precision: np.ndarray
    points2D: np.ndarray
    by_point: np.ndarray
    seen: np.ndarray

    def rows(self, first: int, count: int) -> np.ndarray:
        """(LANES, count) some rows as columns."""
        return self.w.reshape(-1, LANES)[first : first + count].T

    def residuals(self) -> np.ndarray:
        """(LANES, 2) over their standard deviations, 0 where there is none."""
        return np.where(self.seen[:, None], (self.points2D - self.observed) * self.precision[:, None], 0.0)

    def roots(self, loss: Loss) -> np.ndarray:
        """(LANES,) by which derivatives are multiplied."""
        _, weight = evaluate_loss(loss, np.sum(self.residuals() ** 2, axis=1), SCALE)
        return np.where(self.seen, np.sqrt(weight) * self.precision, 0.0)

    def P(self, loss: Loss) -> np.ndarray:
        """(LANES, 2, 3) derivatives of the weighted residuals by the point in the world."""
        return np.array(
            [
                root * A @ R if root > 0 else np.zeros((2, 3))
                for root, A in zip(self.roots(loss), self.by_point, strict=True)
            ]
        )


def workspace(rng: np.random.Generator) -> Workspace:
    """Sixty observations, two without a projection and with NaN where the derivatives would be."""
    w = np.full(lanes.ROWS * LANES, np.nan)
    world, points2D = rng.normal(size=(LANES, 3)), rng.normal(size=(LANES, 2))
    observed, by_point = points2D + 2 * rng.normal(size=(LANES, 2)), rng.normal(size=(LANES, 2, 3))
    precision, seen = rng.uniform(0.5, 2, LANES), np.ones(LANES, bool)
    seen[list(UNSEEN)] = seen[list(ENDED)] = False
    precision[list(ENDED)] = 0
    by_point[UNSEEN[0]], world[UNSEEN[1]], observed[ENDED[0]] = np.nan, np.inf, np.nan
    observed[8] = points2D[8]
    rows = w.reshape(-1, LANES)
    rows[[camera_lanes.U, camera_lanes.V]] = points2D.T
    rows[camera_lanes.OK] = ~np.isin(np.arange(LANES), (*UNSEEN, ENDED[1]))
    rows[camera_lanes.BY_POINT : camera_lanes.BY_POINT + 6] = by_point.reshape(LANES, 6).T
    rows[lanes._WORLD : lanes._WORLD + 3] = world.T
    rows[lanes._OBSERVED : lanes._OBSERVED + 2] = observed.T
    rows[lanes._PRECISION] = precision
    return Workspace(w, world, observed, precision, points2D, by_point, seen)


def close(found: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


def test_lanes_are_fetched_up_to_the_end_of_the_image_and_then_repeat_the_last(rng):
    points3D, point = rng.normal(size=(9, 3)), rng.integers(0, 9, 100).astype(np.int32)
    observed, precision = rng.normal(size=(100, 2)), rng.uniform(0.5, 2, 100)
    for first, last in ((0, 100), (70, 100), (99, 100)):
        w = np.full(lanes.ROWS * LANES, np.nan)
        lanes.fetch(first, last, point, observed, precision, points3D, R, T, w)
        rows = w.reshape(-1, LANES)
        for n in range(LANES):
            o = min(first + n, last - 1)
            np.testing.assert_array_equal(rows[lanes._WORLD : lanes._WORLD + 3, n], points3D[point[o]])
            np.testing.assert_array_equal(rows[lanes._OBSERVED : lanes._OBSERVED + 2, n], observed[o])
            assert rows[lanes._PRECISION, n] == (precision[o] if first + n < last else 0)
            close(rows[camera_lanes.X : camera_lanes.X + 3, n], R @ points3D[point[o]] + T)


@pytest.mark.parametrize("lost_cost", [LOST_COST, np.nan])
@pytest.mark.parametrize("loss", LOSSES)
def test_residuals_are_weighed_by_the_loss(rng, loss, lost_cost):
    space = workspace(rng)
    lanes.weigh(loss_id(loss), SCALE, lost_cost, space.w)
    for n, e in enumerate(space.residuals()):
        rho, weight = (float(value) for value in evaluate_loss(loss, np.array(e @ e), SCALE))
        lost = n in UNSEEN
        assert space.rows(lanes.COST, 1)[n, 0] == pytest.approx(2 * lost_cost if lost else rho, rel=1e-12, nan_ok=True)
        close(space.rows(lanes.ERROR, 2)[n], np.sqrt(weight) * e)
    close(space.rows(lanes._ROOT, 1)[:, 0], space.roots(loss))
    assert np.sum(space.rows(lanes.COST, 1)[list(ENDED)]) == 0
    if loss in ("tukey", "truncated"):
        assert np.sum(space.roots(loss) == 0) > len(UNSEEN) + len(ENDED)


@pytest.mark.parametrize("loss", LOSSES)
def test_derivatives_by_points_and_frames_are_those_of_single_observations(rng, loss):
    space, center = workspace(rng), np.array([0.4, -0.3, 0.9])
    lanes.weigh(loss_id(loss), SCALE, LOST_COST, space.w)
    lanes.derive_by_point(R, space.w)
    lanes.derive_by_turn(center, space.w)
    errors = space.rows(lanes.ERROR, 2)
    for n, P in enumerate(space.P(loss)):
        close(space.rows(lanes.BY_POINT_IN_WORLD, 6)[n], P.ravel())
        close(space.rows(lanes.OUT, 6)[n], (P.T @ P)[np.triu_indices(3)])
        close(space.rows(lanes.OUT + 6, 3)[n], P.T @ errors[n])
        u = space.world[n] - center if P.any() else np.zeros(3)
        close(space.rows(lanes.BY_TURN, 6)[n], (-P @ skew(u)).ravel())


def test_derivatives_by_a_sensor_are_those_of_its_tangent(rng):
    space, x = workspace(rng), rng.normal(size=(LANES, 3))
    space.w.reshape(-1, LANES)[camera_lanes.X : camera_lanes.X + 3] = x.T
    for place in range(6):
        lanes.derive_by_sensor(place, space.w)
        for n in np.flatnonzero(space.seen):
            expected = space.by_point[n] @ np.c_[-skew(x[n]), np.eye(3)]
            close(space.rows(lanes.BY_SENSOR, 2)[n], expected[:, place])


@pytest.mark.parametrize("k", [0, 3, 17])
def test_columns_are_weighed_and_multiplied_with_the_derivatives_by_the_point(rng, k):
    space, source = workspace(rng), camera_lanes.BY_PARAMS + 4
    raw = rng.normal(size=(LANES, 2))
    raw[UNSEEN[0]] = np.nan
    space.w.reshape(-1, LANES)[source : source + 2] = raw.T
    lanes.weigh(loss_id("cauchy"), SCALE, LOST_COST, space.w)
    lanes.derive_by_point(R, space.w)
    lanes.derive_by_column(k, source, space.w)
    roots, P = space.roots("cauchy"), space.P("cauchy")
    for n in range(LANES):
        q = roots[n] * raw[n] if roots[n] > 0 else np.zeros(2)
        close(space.rows(lanes.BY_COLUMN + 2 * k, 2)[n], q)
        close(space.rows(lanes.OUT + 9 + 3 * k, 3)[n], P[n].T @ q)


def test_a_total_is_the_sum_of_two_products_of_rows(rng):
    w = rng.normal(size=lanes.ROWS * LANES)
    rows = w.reshape(-1, LANES)
    expected = sum(rows[3, n] * rows[9, n] + rows[7, n] * rows[2, n] for n in range(LANES))
    assert lanes.total(3, 9, 7, 2, w) == pytest.approx(expected, rel=1e-12)
    assert lanes.total(3, 9, 7, 2, w) == lanes.total(3, 9, 7, 2, w.copy())


def test_no_two_quantities_share_a_row():
    blocks = [
        (camera_lanes.ROWS, 0), (lanes._WORLD, 3), (lanes._OBSERVED, 2), (lanes._PRECISION, 1), (lanes.ERROR, 2),
        (lanes.COST, 1), (lanes._ROOT, 1), (lanes.BY_POINT_IN_WORLD, 6), (lanes.OUT, 9 + 3 * (MAX_PARAMS + 6)),
        (lanes.BY_TURN, 6), (lanes.BY_COLUMN, 2 * (MAX_PARAMS + 6)), (lanes.BY_SENSOR, 2),
    ]  # fmt: skip
    used = [row for first, count in blocks for row in range(first, first + count)]
    assert len(used) == len(set(used))
    assert min(used) == camera_lanes.ROWS
    assert max(used) < lanes.ROWS
