import dataclasses

import jaxtyping
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import multivariate_normal

from sfm.bundle.mounted_terms import by_sensors, on_frames
from sfm.bundle.prior_gauge import entries_to_hold, open_motions
from sfm.bundle.prior_terms import (
    PriorTerms,
    bias_count,
    linearize_point_priors,
    linearize_priors,
    point_prior_cost,
    prior_cost,
    prior_residuals,
)
from sfm.bundle.priors import DistancePrior, GravityPrior, PointPrior, PositionPrior, check_rows
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew

IMAGES = 5
REFUSED = (ValueError, jaxtyping.TypeCheckError)
ROBUST = ("huber", "soft_l1", "cauchy", "tukey")


def rows(*numbers):
    return np.array(numbers, np.int32)


def units(rng, count):
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def covariances(rng, count, spread=1.0):
    roots = rng.normal(size=(count, 3, 3)) * 10.0 ** (spread * rng.uniform(-1, 1, (count, 3, 1)))
    return roots @ roots.swapaxes(1, 2) + 0.01 * np.eye(3)


def poses(rng, scale=3.0):
    return Rotation3.exp(rng.normal(size=(IMAGES, 3)) * 2).matrix, scale * rng.normal(size=(IMAGES, 3))


def groups(rng, loss="trivial"):
    """One of each kind, two with a bias, one image twice."""
    settings = {"loss": loss, "loss_scale": 1.7}
    return (
        PositionPrior(rows(0, 3, 3), rng.normal(size=(3, 3)), covariances(rng, 3), 0.4, **settings),
        GravityPrior(rows(1, 4), units(rng, 2), np.array([0.3, 0.5]), units(rng, 1)[0], **settings),
        DistancePrior(rows(0, 4), rows(2, 1), np.array([2.0, 5.0]), np.array([0.5, 2.0]), **settings),
        PositionPrior(rows(2), rng.normal(size=(1, 3)), covariances(rng, 1), 2.0, **settings),
        PositionPrior(rows(1), rng.normal(size=(1, 3)), covariances(rng, 1), None, **settings),
    )


def moved(rotations, centers, biases, delta):
    """The tangent of `prior_terms` in closed form; also of complex numbers."""
    turns = np.array([expm(skew_of(step[:3])) for step in delta[: len(centers)]])
    shifts = np.einsum("iba,ib->ia", turns, delta[: len(centers), 3:])
    return rotations @ turns, centers - shifts, biases + delta[len(centers) :, :3]


def skew_of(vector):
    x, y, z = vector
    return np.array([[0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x]])


def analytic_residuals(priors, rotations, centers, biases, sigmas):
    """Residuals written with analytic functions only, for complex steps: no absolute values, no conjugates."""
    found, bias = [], 0
    for prior in priors:
        for k in range(len(getattr(prior, "images", getattr(prior, "first", None)))):
            match prior:
                case PositionPrior():
                    W = np.linalg.inv(np.linalg.cholesky(prior.covariances[k]))
                    b = biases[bias] if prior.bias_sigma else 0
                    found.append(W @ (centers[prior.images[k]] - prior.positions[k] - b))
                case GravityPrior():
                    g, p = prior.directions_in_camera[k], rotations[prior.images[k]] @ prior.down
                    n = skew_of(g) @ p
                    sine = np.sqrt(np.sum(n * n))
                    found.append(2 * np.arctan(sine / (1 + np.sum(g * p))) / sine * n / prior.sigmas_rad[k])
                case DistancePrior():
                    apart = centers[prior.first[k]] - centers[prior.second[k]]
                    length = np.sqrt(np.sum(apart * apart))
                    found.append(np.array([(length - prior.distances[k]) / prior.sigmas[k], 0, 0]))
        bias += isinstance(prior, PositionPrior) and prior.bias_sigma is not None
    return np.array(found + [b / s for b, s in zip(biases, sigmas, strict=True)])


def dense(terms, unknowns):
    """The Jacobian (3 n, 6 U) of sparse terms."""
    out = np.zeros((len(terms.residuals), 3, unknowns, 6))
    for row in range(len(out)):
        out[row, :, terms.first[row]] += terms.jacobian_first[row]
        if terms.second[row] >= 0:
            out[row, :, terms.second[row]] += terms.jacobian_second[row]
    return out.reshape(3 * len(out), -1)


@pytest.mark.parametrize("scale", [3.0, 1e-3, 1e5])
def test_every_jacobian_agrees_with_complex_steps(rng, scale):
    priors, biases = groups(rng), rng.normal(size=(2, 3))
    rotations, centers = poses(rng, scale)
    _, terms = linearize_priors(priors, rotations, centers, biases)
    np.testing.assert_allclose(
        terms.residuals, analytic_residuals(priors, rotations, centers, biases, (0.4, 2.0)), rtol=1e-10, atol=1e-12
    )
    unknowns = IMAGES + 2
    numeric = np.empty((terms.residuals.size, 6 * unknowns))
    for column in range(6 * unknowns):
        delta = np.zeros((unknowns, 6), complex)
        delta.flat[column] = 1e-20j
        stepped = analytic_residuals(priors, *moved(rotations, centers, biases, delta), (0.4, 2.0))
        numeric[:, column] = stepped.ravel().imag / 1e-20
    numeric[:, [c for c in range(6 * IMAGES, 6 * unknowns) if c % 6 > 2]] = 0
    np.testing.assert_allclose(dense(terms, unknowns), numeric, rtol=1e-6, atol=1e-9 * np.abs(numeric).max())


def test_images_on_rigs_move_with_them(rng):
    """Frames 0 to 2 carry images 0 and 1, 2 and 3, 4; mounts are fixed."""
    frame_of, biases = rows(0, 0, 1, 1, 2), rng.normal(size=(2, 3))
    priors = (*groups(rng), DistancePrior(rows(2), rows(3), np.ones(1), np.ones(1)))
    turns, places = (values[:3] for values in poses(rng))
    mounts, arms = Rotation3.exp(rng.normal(size=(IMAGES, 3))).matrix, rng.normal(size=(IMAGES, 3))

    def images(delta):
        """Rotations and centres of the images; an arm is in the axes of its frame."""
        rotations, centers, moved_biases = moved(turns, places, biases, delta)
        arms_in_world = np.einsum("iba,ib->ia", rotations[frame_of], arms)
        return mounts @ rotations[frame_of], centers[frame_of] + arms_in_world, moved_biases

    still = images(np.zeros((5, 6)))
    _, terms = linearize_priors(priors, *still)
    terms = on_frames(terms, frame_of, still[1] - places[frame_of], 3)
    assert not np.any(terms.first == terms.second)
    numeric = np.empty((terms.residuals.size, 30))
    for column in range(30):
        delta = np.zeros((5, 6), complex)
        delta.flat[column] = 1e-20j
        stepped = analytic_residuals(priors, *images(delta), (0.4, 2.0))
        numeric[:, column] = stepped.ravel().imag / 1e-20
    numeric[:, [c for c in range(18, 30) if c % 6 > 2]] = 0
    np.testing.assert_allclose(dense(terms, 5), numeric, rtol=1e-6, atol=1e-9 * np.abs(numeric).max())


def test_derivatives_by_sensors_agree_with_complex_steps(rng):
    """A sensor moves by exp(ω) R and exp(ω) t + υ, and its image with it; biases do not."""
    priors, biases = groups(rng), rng.normal(size=(2, 3))
    rotations, centers = poses(rng)
    translations = -np.einsum("iab,ib->ia", rotations, centers)
    _, terms = linearize_priors(priors, rotations, centers, biases)
    numeric = np.empty((terms.residuals.size, 6 * IMAGES))
    for column in range(6 * IMAGES):
        delta = np.zeros((IMAGES, 6), complex)
        delta.flat[column] = 1e-20j
        turns = np.array([expm(skew_of(step[:3])) for step in delta])
        turned = turns @ rotations
        shifted = np.einsum("iab,ib->ia", turns, translations) + delta[:, 3:]
        stepped = analytic_residuals(priors, turned, -np.einsum("iba,ib->ia", turned, shifted), biases, (0.4, 2.0))
        numeric[:, column] = stepped.ravel().imag / 1e-20
    numbers = (np.where(n < IMAGES, n, -1).astype(np.int32) for n in (terms.first, terms.second))
    found = dense(PriorTerms(terms.residuals, *numbers, *by_sensors(terms, rotations)), IMAGES)
    np.testing.assert_allclose(found, numeric, rtol=1e-6, atol=1e-9 * np.abs(numeric).max())


@pytest.mark.parametrize("loss", ["trivial", *ROBUST])
def test_the_gradient_of_the_cost_agrees_with_central_differences(rng, loss):
    priors, biases = groups(rng, loss), rng.normal(size=(2, 3))
    rotations, centers = poses(rng)
    cost, terms = linearize_priors(priors, rotations, centers, biases)
    assert cost == pytest.approx(prior_cost(priors, rotations, centers, biases), rel=1e-14)
    gradient = dense(terms, IMAGES + 2).T @ terms.residuals.ravel()
    for column in range(6 * (IMAGES + 2)):
        if column >= 6 * IMAGES and column % 6 > 2:
            assert gradient[column] == 0
            continue
        delta = np.zeros((IMAGES + 2, 6))
        delta.flat[column] = step = 1e-5
        up = prior_cost(priors, *moved(rotations, centers, biases, delta))
        down = prior_cost(priors, *moved(rotations, centers, biases, -delta))
        assert gradient[column] == pytest.approx((up - down) / (2 * step), rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-6, 0.9e-3, 1.1e-3, 1.0, 3.0, np.pi - 1e-5])
def test_gravity_is_right_at_every_angle(rng, angle):
    d, axis = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    R = Rotation3.exp(angle * axis).matrix[None]
    prior = GravityPrior(rows(0), d[None], np.ones(1), d)
    _, terms = linearize_priors([prior], R, np.zeros((1, 3)), np.zeros((0, 3)))
    np.testing.assert_allclose(terms.residuals[0], angle * axis, rtol=1e-10, atol=1e-14)
    numeric = np.empty((3, 3))
    for k in range(3):
        steps = np.eye(3)[k] * min(1e-6, 1e-2 * (np.pi - angle))
        ends = [Rotation3.exp(s * steps).matrix for s in (1, -1)]
        up, down = (prior_residuals(prior, R @ end, np.zeros((1, 3)), np.zeros(3))[0] for end in ends)
        numeric[:, k] = (up - down) / (2 * steps[k])
    np.testing.assert_allclose(terms.jacobian_first[0, :, :3], numeric, rtol=1e-4, atol=1e-7 * np.abs(numeric).max())


def test_gravity_upside_down_has_a_way_back():
    down = np.array([0.0, 1.0, 0.0])
    prior = GravityPrior(rows(0), -down[None], np.array([0.1]), down)
    cost, terms = linearize_priors([prior], np.eye(3)[None], np.zeros((1, 3)), np.zeros((0, 3)))
    assert cost == pytest.approx(0.5 * (np.pi / 0.1) ** 2)
    gradient = terms.jacobian_first[0].T @ terms.residuals[0]
    assert np.linalg.norm(gradient) == pytest.approx(np.pi / 0.01)
    assert np.all(np.isfinite(terms.jacobian_first))
    turned = Rotation3.exp(-1e-3 * gradient[:3] / np.linalg.norm(gradient)).matrix[None]
    assert prior_cost([prior], turned, np.zeros((1, 3)), np.zeros((0, 3))) < cost


def test_cameras_that_coincide_have_a_distance_and_no_derivative():
    prior = DistancePrior(rows(0), rows(1), np.array([2.0]), np.array([0.5]))
    cost, terms = linearize_priors([prior], np.stack([np.eye(3)] * 2), np.ones((2, 3)), np.zeros((0, 3)))
    assert cost == 8.0
    assert not terms.jacobian_first.any()
    assert not terms.jacobian_second.any()


def test_whitened_residuals_are_mahalanobis_distances(rng):
    prior = dataclasses.replace(groups(rng)[0], covariances=covariances(rng, 3, spread=4.0))
    rotations, centers = poses(rng)
    residuals = prior_residuals(prior, rotations, centers, np.zeros(3))
    for k, image in enumerate(prior.images):
        density = multivariate_normal(prior.positions[k], prior.covariances[k], allow_singular=False)
        distance = -2 * (density.logpdf(centers[image]) - density.logpdf(prior.positions[k]))
        assert np.sum(residuals[k] ** 2) == pytest.approx(distance, rel=1e-8)


def test_a_coordinate_that_was_not_measured_has_no_say(rng):
    position = np.array([[1.0, 2.0, np.nan]])
    prior = PositionPrior.of_sigmas(rows(1), position, np.array([[0.5, 2.0, np.inf]]))
    rotations, centers = poses(rng)
    _, terms = linearize_priors([prior], rotations, centers, np.zeros((0, 3)))
    np.testing.assert_allclose(
        terms.residuals[0], [(centers[1, 0] - 1) / 0.5, (centers[1, 1] - 2) / 2, 0.0], rtol=1e-12
    )
    np.testing.assert_array_equal(terms.jacobian_first[0, :, 3:], np.diag([-2.0, -0.5, 0.0]))


def test_the_bias_of_a_group_takes_what_is_common():
    centers, biases = np.array([[1.0, 0, 0], [2.0, 0, 0]]), np.array([[0.5, 0, 0]])
    prior = PositionPrior.of_sigmas(rows(0, 1), centers - biases, 0.1, bias_sigma=2.0)
    assert bias_count([prior]) == 1
    cost = prior_cost([prior], np.stack([np.eye(3)] * 2), centers, biases)
    assert cost == pytest.approx(0.5 * (0.5 / 2.0) ** 2)


def test_no_priors_cost_nothing():
    cost, terms = linearize_priors((), np.eye(3)[None], np.zeros((1, 3)), np.zeros((0, 3)))
    assert cost == 0
    assert terms.residuals.shape == (0, 3)
    assert terms.jacobian_first.shape == (0, 3, 6)


@pytest.mark.parametrize("loss", ["trivial", *ROBUST])
def test_control_points_give_the_gradient_and_information_of_their_cost(rng, loss):
    points = rng.normal(size=(6, 3))
    priors = (
        PointPrior(rows(1, 4, 4), rng.normal(size=(3, 3)), covariances(rng, 3), loss, 1.3),
        PointPrior.of_sigmas(rows(0), rng.normal(size=(1, 3)), 0.2, loss=loss, loss_scale=0.7),
    )
    cost, V, g = linearize_point_priors(priors, points)
    assert cost == pytest.approx(point_prior_cost(priors, points), rel=1e-14)
    for p in range(6):
        for a in range(3):
            step = np.zeros((6, 3))
            step[p, a] = 1e-5
            difference = point_prior_cost(priors, points + step) - point_prior_cost(priors, points - step)
            assert g[p, a] == pytest.approx(difference / 2e-5, rel=1e-6, abs=1e-6)
    assert not V[[2, 3, 5]].any()
    assert not g[[2, 3, 5]].any()
    if loss == "trivial":
        expected = np.linalg.inv(priors[0].covariances[0])
        np.testing.assert_allclose(V[1], expected[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], rtol=1e-9)


def position(**changes):
    parts = {"images": rows(0), "positions": np.zeros((1, 3)), "covariances": np.eye(3)[None]}
    return PositionPrior(**(parts | changes))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"covariances": np.diag([1.0, 0.0, 1.0])[None]}, "variances"),
        ({"covariances": np.ones((1, 3, 3))}, "positive definite"),
        ({"covariances": np.array([[[1.0, 0.5, 0], [0.4, 1, 0], [0, 0, 1]]])}, "symmetric"),
        ({"covariances": np.diag([1.0, np.nan, 1.0])[None]}, "variances"),
        ({"positions": np.array([[0.0, np.nan, 0.0]])}, "positions must be finite"),
        ({"images": rows(-1)}, "negative"),
        ({"images": rows(0, 1)}, None),
        ({"bias_sigma": 0.0}, "bias_sigma"),
        ({"bias_sigma": float("nan")}, "bias_sigma"),
        ({"loss_scale": -1.0}, "loss_scale"),
    ],
)
def test_impossible_positions_are_refused(changes, words):
    with pytest.raises(REFUSED, match=words):
        position(**changes)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: PositionPrior.of_sigmas(rows(0), np.zeros((1, 3)), 0.0), "variances"),
        (lambda: GravityPrior(rows(0), np.zeros((1, 3)), np.ones(1), np.eye(3)[0]), "unit length"),
        (lambda: GravityPrior(rows(0), np.eye(3)[:1], np.ones(1), 2 * np.eye(3)[0]), "down must have unit"),
        (lambda: GravityPrior(rows(0), np.eye(3)[:1] * np.nan, np.ones(1), np.eye(3)[0]), "unit length"),
        (lambda: GravityPrior(rows(0), np.eye(3)[:1], np.zeros(1), np.eye(3)[0]), "sigmas_rad"),
        (lambda: DistancePrior(rows(2), rows(2), np.ones(1), np.ones(1)), "image 2 has a distance to itself"),
        (lambda: DistancePrior(rows(0), rows(2), -np.ones(1), np.ones(1)), "distances"),
        (lambda: DistancePrior(rows(0), rows(2), np.ones(1), np.zeros(1)), "sigmas"),
        (lambda: PointPrior.of_sigmas(rows(0), np.full((1, 3), np.inf), 1.0), "positions"),
    ],
)
def test_other_impossible_priors_are_refused(make, words):
    with pytest.raises(REFUSED, match=words):
        make()


def test_rows_that_do_not_exist_are_refused(rng):
    check_rows(groups(rng), IMAGES, 0)
    with pytest.raises(ValueError, match=r"images of GravityPrior must lie in 0\.\.3, got 4"):
        check_rows(groups(rng)[1:2], 4, 0)
    with pytest.raises(ValueError, match="points of PointPrior"):
        check_rows((PointPrior.of_sigmas(rows(7), np.zeros((1, 3)), 1.0),), 4, 7)


def test_the_number_of_biases_must_fit(rng):
    with pytest.raises(ValueError, match="1 biases for 2 groups"):
        prior_cost(groups(rng), *poses(rng), np.zeros((1, 3)))


def at_positions(centers, images, **settings):
    return PositionPrior.of_sigmas(np.array(images, np.int32), centers[list(images)], 1.0, **settings)


def gravity(down=(0.0, 0.0, 1.0)):
    return GravityPrior(rows(0), np.eye(3)[:1], np.ones(1), np.array(down))


def distance():
    return DistancePrior(rows(0), rows(1), np.ones(1), np.ones(1))


def test_priors_leave_open_what_they_cannot_see(rng):
    centers, line = rng.normal(size=(5, 3)), np.arange(15.0).reshape(5, 3)
    points = rng.normal(size=(4, 3))

    def count(*priors, at=centers):
        return open_motions(priors, at, points).shape[1]

    assert count() == 7
    assert count(at_positions(centers, range(5))) == 0
    assert count(at_positions(centers, range(5), bias_sigma=1.0)) == 0
    assert count(at_positions(line, range(5)), at=line) == 1
    assert count(at_positions(centers, [0])) == 4
    assert count(at_positions(centers, [0, 1])) == 1
    assert count(gravity()) == 5
    assert count(distance()) == 6
    assert count(gravity(), distance()) == 4
    assert count(gravity(), at_positions(centers, [0, 1])) == 0
    assert count(PointPrior.of_sigmas(rows(0, 2, 3), points[[0, 2, 3]], 1.0)) == 0
    horizontal = PositionPrior.of_sigmas(rows(0, 1, 2), centers[:3], np.array([[1.0, 1.0, np.inf]] * 3))
    assert count(horizontal) == 1  # height


def held_without_priors(centers, anchor, second):
    axis = int(np.argmax(np.abs(centers[second] - centers[anchor])))
    return np.ones(6, bool), np.arange(6) == 3 + axis


def test_without_priors_two_cameras_are_held(rng):
    centers = rng.normal(size=(5, 3)) * 10 + 100
    found = entries_to_hold((), centers, np.zeros((0, 3)), centers[1], centers[3])
    np.testing.assert_array_equal(found, held_without_priors(centers, 1, 3))


def test_only_what_priors_leave_open_is_held(rng):
    centers, points = rng.normal(size=(5, 3)), np.zeros((0, 3))

    def held(*priors):
        first, second = entries_to_hold(priors, centers, points, centers[0], centers[1])
        return first.astype(int).tolist(), int(second.sum())

    assert held(at_positions(centers, range(5))) == ([0] * 6, 0)
    assert held(distance()) == ([1] * 6, 0)
    assert held(gravity((0.6, 0.0, 0.8))) == ([0, 0, 1, 1, 1, 1], 1)
    assert held(gravity((1.0, 0.0, 0.0)), distance()) == ([1, 0, 0, 1, 1, 1], 0)
    alone, nothing = entries_to_hold((), centers[:1], points, centers[0], None)
    assert alone.all()
    assert not nothing.any()


def test_a_scene_that_is_held_cannot_move(rng):
    """The open motions, seen by the held entries alone, have full rank."""
    poses_now = Rigid3.exp(rng.normal(size=(5, 6)))
    centers = poses_now.center
    for priors in ((), (gravity(),), (distance(),), (at_positions(centers, [0]),), (at_positions(centers, [2, 3]),)):
        basis = open_motions(priors, centers, np.zeros((0, 3)))
        first, second = entries_to_hold(priors, centers, np.zeros((0, 3)), centers[0], centers[1])
        assert first.sum() + second.sum() == basis.shape[1]
        origin = centers.mean(axis=0)
        size = np.linalg.norm(centers - origin, axis=1).max()
        shown = []
        for image, held in ((0, first), (1, second)):
            place = (centers[image] - origin) / size
            tangent = np.zeros((6, 7))
            tangent[:3, :3], tangent[3:] = -np.eye(3), -np.c_[-skew(place), np.eye(3), place]
            shown.append((tangent @ basis)[held])
        assert np.linalg.svd(np.concatenate(shown))[1].min() > 0.05
