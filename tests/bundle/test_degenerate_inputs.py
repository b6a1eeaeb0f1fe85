"""Whatever is asked for: a named error or a sane result, and no number that is not finite where there was one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from sfm.bundle import BundleConfig, BundleCovariance, BundleProblem, adjust, covariance, squared_errors
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from tests.bundle.conftest import build, perturb

Degenerate = Callable[[BundleProblem, np.random.Generator], BundleProblem]


def keep(problem: BundleProblem, rows: np.ndarray) -> BundleProblem:
    """Only these observations."""
    return dataclasses.replace(
        problem,
        obs_images=problem.obs_images[rows],
        obs_points=problem.obs_points[rows],
        obs_points2D=problem.obs_points2D[rows],
    )


def with_points(problem: BundleProblem, points3D: np.ndarray, noise_px: float, rng: np.random.Generator):
    """Other points, seen where a PINHOLE camera sees them; those behind a camera keep their old pixel."""
    f, c = problem.camera_params[0, :2], problem.camera_params[0, 2:4]
    x = problem.cams_from_world[problem.obs_images] @ points3D[problem.obs_points]
    noise = noise_px * rng.normal(size=problem.obs_points2D.shape)
    with np.errstate(all="ignore"):
        points2D = np.where(x[:, 2:] > 0, f * x[:, :2] / x[:, 2:] + c + noise, problem.obs_points2D)
    return dataclasses.replace(problem, points3D=points3D, obs_points2D=points2D)


def with_poses(problem: BundleProblem, rotation: Rotation3, center: np.ndarray) -> BundleProblem:
    """Other poses by their centres; the pixels stay."""
    translation = -np.einsum("iab,ib->ia", rotation.matrix, center)
    return dataclasses.replace(problem, cams_from_world=Rigid3(rotation, translation))


def moved(problem: BundleProblem, scale: float, offset: np.ndarray) -> BundleProblem:
    """The same scene in other units and elsewhere; the pixels stay right."""
    poses = problem.cams_from_world
    return dataclasses.replace(
        with_poses(problem, poses.rotation, scale * poses.center + offset), points3D=scale * problem.points3D + offset
    )


def seeing_few(count: int) -> Degenerate:
    return lambda p, rng: keep(p, (p.obs_images != 1) | (p.obs_points < count))


def a_point_behind(p: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    points = p.points3D.copy()
    points[0] = 3 * p.cams_from_world.center[0] - 2 * points[0]
    return dataclasses.replace(p, points3D=points)


def all_behind(p: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    turned = Rotation3.exp(np.tile([0.0, np.pi, 0.0], (len(p.free_poses), 1))) @ p.cams_from_world.rotation
    return with_poses(p, turned, p.cams_from_world.center)


def identical_cameras(p: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    """Images 0 and 1 at one place, with the same measurements."""
    wxyz, t = p.cams_from_world.rotation.wxyz.copy(), p.cams_from_world.translation.copy()
    wxyz[1], t[1] = wxyz[0], t[0]
    mine = np.flatnonzero(p.obs_images == 0)
    rows = np.concatenate([np.flatnonzero(p.obs_images != 1), mine])
    twice = keep(p, rows)
    images = twice.obs_images.copy()
    images[len(rows) - len(mine) :] = 1
    return dataclasses.replace(twice, obs_images=images, cams_from_world=Rigid3(Rotation3(wxyz), t))


def all_cameras_identical(p: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    wxyz, t = p.cams_from_world.rotation.wxyz, p.cams_from_world.translation
    same = Rigid3(Rotation3(np.tile(wxyz[0], (len(t), 1))), np.tile(t[0], (len(t), 1)))
    return with_points(dataclasses.replace(p, cams_from_world=same), p.points3D, 0.5, rng)


def pure_rotation(p: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    center = np.tile([0.0, 0.0, -6.0], (len(p.free_poses), 1))
    turned = Rotation3.exp(0.05 * rng.normal(size=(len(p.free_poses), 3)))
    return with_points(with_poses(p, turned, center), p.points3D, 0.5, rng)


def flattened(*axes: int) -> Degenerate:
    """All points on a plane, a line, at one place."""

    def make(p: BundleProblem, rng: np.random.Generator) -> BundleProblem:
        points = p.points3D.copy()
        points[:, axes] = 0.1
        return with_points(p, points, 0.5, rng)

    return make


def repeated(p: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    return keep(p, np.concatenate([np.arange(len(p.obs_images)), np.repeat(np.arange(20), 50)]))


def with_value(name: str, where: object, value: float) -> Degenerate:
    def make(p: BundleProblem, rng: np.random.Generator) -> BundleProblem:
        column = getattr(p, name).copy()
        column[where] = value
        return dataclasses.replace(p, **{name: column})

    return make


def with_translation(value: float) -> Degenerate:
    def make(p: BundleProblem, rng: np.random.Generator) -> BundleProblem:
        t = p.cams_from_world.translation.copy()
        t[1, 2] = value
        return dataclasses.replace(p, cams_from_world=Rigid3(p.cams_from_world.rotation, t))

    return make


def first_observations(count: int) -> Degenerate:
    return lambda p, rng: keep(p, np.arange(count))


def of_images(count: int) -> Degenerate:
    return lambda p, rng: keep(p, np.flatnonzero(p.obs_images < count))


def seen_once(p: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    return keep(p, np.unique(p.obs_points, return_index=True)[1])


def at_a_centre(p: BundleProblem, rng: np.random.Generator) -> BundleProblem:
    points = p.points3D.copy()
    points[0] = p.cams_from_world.center[0]
    return dataclasses.replace(p, points3D=points)


CASES: dict[str, Degenerate] = {
    "a camera with two points": seeing_few(2),
    "a camera with one point": seeing_few(1),
    "a camera without points": seeing_few(0),
    "a point behind a camera": a_point_behind,
    "all points behind all cameras": all_behind,
    "a point at the centre of a camera": at_a_centre,
    "no observations": first_observations(0),
    "one observation": first_observations(1),
    "three observations": first_observations(3),
    "one image": of_images(1),
    "two images": of_images(2),
    "points seen once": seen_once,
    "two identical cameras": identical_cameras,
    "cameras all identical": all_cameras_identical,
    "pure rotation": pure_rotation,
    "points on a plane": flattened(2),
    "points on a line": flattened(1, 2),
    "points at one place": flattened(0, 1, 2),
    "observations repeated": repeated,
    "NaN in a point": with_value("points3D", 3, np.nan),
    "NaN in all points": with_value("points3D", slice(None), np.nan),
    "an infinite point": with_value("points3D", (3, 0), np.inf),
    "NaN in a pose": with_translation(np.nan),
    "an infinite pose": with_translation(np.inf),
    "a pose far away": with_translation(1e100),
    "NaN in an observation": with_value("obs_points2D", 3, np.nan),
    "an observation far outside": with_value("obs_points2D", 3, 1e9),
    "an observation at 1e200": with_value("obs_points2D", 3, 1e200),
    "NaN in a camera": with_value("camera_params", (0, 0), np.nan),
    "an infinite camera": with_value("camera_params", (0, 0), np.inf),
    "a focal length of zero": with_value("camera_params", (0, 0), 0.0),
    "a negative focal length": with_value("camera_params", (0, slice(0, 2)), -800.0),
    "far from the origin": lambda p, rng: moved(p, 1.0, np.array([4e6, -7e6, 1e7])),
    "tiny": lambda p, rng: moved(p, 1e-6, np.zeros(3)),
    "huge": lambda p, rng: moved(p, 1e6, np.zeros(3)),
}


def case(name: str, rng: np.random.Generator, free_params: tuple[int, ...] = ()) -> BundleProblem:
    """Six PINHOLE images of 60 points, disturbed, and then made degenerate."""
    start = perturb(build(rng, noise_px=0.5, free_params=free_params), rng, 0.002)
    with np.errstate(all="ignore"):
        return CASES[name](start, rng)


def assert_nothing_got_lost(before: BundleProblem, after: BundleProblem) -> None:
    """What was finite is finite, and rotations are rotations."""
    for name in ("points3D", "camera_params"):
        was, now = getattr(before, name), getattr(after, name)
        assert np.isfinite(now[np.isfinite(was)]).all(), name
    was, now = before.cams_from_world, after.cams_from_world
    assert np.isfinite(now.translation[np.isfinite(was.translation)]).all()
    np.testing.assert_allclose(np.linalg.norm(now.rotation.wxyz, axis=1), 1, atol=1e-9)


@pytest.mark.parametrize(("gauge", "free_params"), [("two_cameras", (0, 1)), ("free", ())])
@pytest.mark.parametrize("name", list(CASES))
def test_adjustment_ends_with_numbers(name, gauge, free_params, rng):
    try:
        start = case(name, rng, free_params)
        result = adjust(start, BundleConfig(gauge=gauge, max_iterations=30))
    except ValueError:
        return
    assert_nothing_got_lost(start, result.problem)
    assert np.isfinite([result.initial_cost, result.final_cost]).all()
    assert result.final_cost <= result.initial_cost
    seen = np.isfinite(squared_errors(start))
    assert result.invalid == np.sum(~seen)
    assert all(np.isfinite(row.cost) and np.isfinite(row.gradient_max) for row in result.table)


@pytest.mark.parametrize("loss", ["huber", "cauchy", "tukey", "truncated"])
@pytest.mark.parametrize("name", ["a point at the centre of a camera", "an observation at 1e200", "NaN in a point"])
def test_graduated_losses_end_with_numbers(name, loss, rng):
    start = case(name, rng, (0, 1))
    result = adjust(start, BundleConfig(loss=loss, graduated=True, max_iterations=20))
    assert_nothing_got_lost(start, result.problem)
    assert np.isfinite(result.final_cost)


@pytest.mark.parametrize(("gauge", "free_params"), [("two_cameras", (0, 1)), ("free", ())])
@pytest.mark.parametrize("name", list(CASES))
def test_a_covariance_is_one_or_is_refused_by_name(name, gauge, free_params, rng):
    """NaN only where it is announced: a pose that nothing sees, a point that its views do not determine."""
    try:
        problem = case(name, rng, free_params)
        found = covariance(problem, BundleConfig(gauge=gauge))
    except ValueError:
        return
    if isinstance(found, Rejected):
        assert found.reason.startswith("undetermined_")
        return
    seen = np.zeros(len(problem.free_poses), bool)
    seen[problem.obs_images[np.isfinite(squared_errors(problem))]] = True
    assert np.isfinite(found.poses[seen]).all()
    assert np.isnan(found.poses[~seen]).all()
    assert np.isfinite(found.params).all()
    with_numbers = found.points3D[np.isfinite(found.points3D).all(axis=(1, 2))]
    for blocks in (found.poses[seen], found.centers[seen], found.params, with_numbers):
        values = np.linalg.eigvalsh(blocks)
        assert (values >= -1e-6 * np.abs(values).max(axis=1, keepdims=True)).all()


@pytest.mark.parametrize(
    "name",
    ["a camera with two points", "a camera with one point", "points seen once", "points at one place", "pure rotation",
     "points on a line", "all points behind all cameras", "cameras all identical"],
)  # fmt: skip
def test_what_is_not_determined_has_no_covariance(name, rng):
    found = covariance(case(name, rng))
    if isinstance(found, Rejected):
        assert found.reason == "undetermined_pose"
    else:
        assert np.isnan(found.points3D).all()


def test_one_image_is_the_gauge_and_knows_no_point(rng):
    found = covariance(case("one image", rng))
    assert isinstance(found, BundleCovariance)
    assert not found.poses[0].any()
    assert np.isnan(found.points3D).all()


@pytest.mark.parametrize("name", ["far from the origin", "tiny", "huge"])
def test_where_and_how_large_a_scene_is_does_not_matter(name, rng):
    plain = perturb(build(rng, noise_px=0.5, free_params=(0, 1)), rng, 0.005)
    elsewhere = CASES[name](plain, rng)
    config = BundleConfig(relative_cost_tolerance=1e-10)
    assert adjust(elsewhere, config).final_cost == pytest.approx(adjust(plain, config).final_cost, rel=1e-6)


@pytest.mark.parametrize(
    "name",
    ["a camera with two points", "a point behind a camera", "two identical cameras", "points on a plane",
     "observations repeated", "NaN in a point", "NaN in an observation", "two images", "a camera without points"],
)  # fmt: skip
def test_what_is_well_posed_in_a_degenerate_scene_is_solved(name, rng):
    """The noise of 0.5 px in both directions gives ½ σ² for each equation at most."""
    start = case(name, rng)
    result = adjust(start)
    count = np.isfinite(squared_errors(start)).sum()
    assert result.final_cost < 1.3 * 0.5**2 * count
