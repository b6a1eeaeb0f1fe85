from __future__ import annotations

import numpy as np
import pytest

from sfm.core.optim import Damping, StopRules, Trial, minimize
from sfm.core.optim.levenberg_marquardt import steepness


class Curve:
    """A small dense problem: residuals and Jacobian of functions of x; keeps the history of what was accepted."""

    def __init__(self, residuals, jacobian, x):
        self.residuals, self.jacobian, self.x = residuals, jacobian, np.array(x, float)
        self.fails = 0

    def linearize(self):
        self.r, self.J = self.residuals(self.x), self.jacobian(self.x)
        self.g, self.H = self.J.T @ self.r, self.J.T @ self.J
        return 0.5 * self.r @ self.r, float(np.abs(self.g).max())

    def try_step(self, damping):
        if self.fails:
            self.fails -= 1
            return None
        D = np.diag(self.H)
        delta = np.linalg.solve(self.H + damping * np.diag(D), -self.g)
        self.tried = self.x + delta
        r = self.residuals(self.tried)
        predicted = -0.5 * self.g @ delta + 0.5 * damping * delta @ (D * delta)
        step, norm = float(np.linalg.norm(delta)), float(np.linalg.norm(self.x))
        return Trial(0.5 * r @ r, float(predicted), step, norm, steepness(self.g, D, 0.5 * self.r @ self.r))

    def accept(self):
        self.x = self.tried


def rosenbrock(x=(-1.2, 1.0)):
    return Curve(
        lambda x: np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]),
        lambda x: np.array([[-20 * x[0], 10.0], [-1.0, 0.0]]),
        x,
    )


def decay(unit=1.0, rate=1.0):
    """A curve with residuals that stay; its residuals times `unit`, its second parameter in 1 / `rate`."""
    times = np.linspace(0, 3, 20)
    values = 2 * np.exp(-1.3 * times) + 0.01 * np.cos(40 * times)
    return Curve(
        lambda x: unit * (x[0] * np.exp(-x[1] * rate * times) - values),
        lambda x: (
            unit * np.stack([np.exp(-x[1] * rate * times), -rate * times * x[0] * np.exp(-x[1] * rate * times)], 1)
        ),
        (1.0, 0.1 / rate),
    )


def test_the_valley_of_rosenbrock_is_followed_to_its_end():
    system = rosenbrock()
    summary = minimize(system, StopRules(relative_cost_tolerance=0.0, gradient_tolerance=1e-12))
    assert summary.reason == "gradient"
    np.testing.assert_allclose(system.x, 1, atol=1e-10)


def test_the_cost_never_rises_and_only_gains_are_accepted():
    summary = minimize(rosenbrock(), StopRules())
    costs = np.array([row.cost for row in summary.iterations])
    assert np.all(np.diff(costs) <= 0)
    for before, row in zip(summary.iterations[:-1], summary.iterations[1:], strict=True):
        assert row.accepted == (row.gain > 0)
        assert row.cost_change == pytest.approx(before.cost - row.cost, abs=1e-12)


def test_the_damping_falls_no_faster_and_no_lower_than_it_may():
    fall = Damping(least=1e-6, least_factor=0.5, least_factor_of_exact=0.25)
    table = minimize(rosenbrock(), StopRules(), fall).iterations
    damping = np.array([row.damping for row in table])
    assert damping.min() == 1e-6
    assert np.min(damping[1:] / damping[:-1]) >= 0.25
    assert min(row.damping for row in minimize(rosenbrock(), StopRules()).iterations) < 1e-6


def test_a_small_relative_decrease_ends_the_loop_where_the_gradient_is_small():
    system = decay()
    summary = minimize(system, StopRules(relative_cost_tolerance=1e-8))
    assert summary.reason == "relative_cost"
    np.testing.assert_allclose(system.x, [2, 1.3], atol=0.02)
    assert summary.iterations[-1].gradient_max < 1e-5


def test_the_gradient_ends_the_loop_alike_in_all_units():
    rules = StopRules(relative_cost_tolerance=0.0, gradient_tolerance=1e-6)
    plain = minimize(decay(), rules)
    assert plain.reason == "gradient"
    for unit, rate in ((1e-6, 1.0), (1e6, 1.0), (1.0, 1e5), (1e-3, 1e-4)):
        system = decay(unit, rate)
        summary = minimize(system, rules)
        assert summary.reason == "gradient"
        assert len(summary.iterations) == len(plain.iterations)
        # It ends where the gradient is flat, before a step from there is taken.
        assert steepness(system.g, np.diag(system.H), summary.final_cost) <= 1e-6
        assert summary.iterations[-1].accepted


def test_steepness_is_the_largest_cosine_between_residuals_and_columns(rng):
    J, r = rng.normal(size=(20, 5)), rng.normal(size=20)
    cosines = np.abs(J.T @ r) / np.linalg.norm(J, axis=0) / np.linalg.norm(r)
    found = steepness(J.T @ r, np.sum(J**2, axis=0), 0.5 * float(r @ r))
    assert found == pytest.approx(cosines.max())
    assert steepness(np.zeros(5), np.zeros(5), 1.0) == 0
    assert steepness(np.zeros((0, 6)), np.zeros((0, 6)), 1.0) == 0


def test_a_start_at_the_solution_ends_at_once():
    summary = minimize(rosenbrock((1.0, 1.0)), StopRules())
    assert summary.reason == "gradient"
    assert len(summary.iterations) == 1
    assert summary.initial_cost == summary.final_cost == 0


def test_the_limit_of_iterations_is_reported():
    summary = minimize(rosenbrock(), StopRules(max_iterations=3))
    assert summary.reason == "max_iterations"
    assert len(summary.iterations) == 4


def test_a_singular_system_raises_the_damping_and_goes_on():
    system = decay()
    system.fails = 2
    summary = minimize(system, StopRules())
    damping = [row.damping for row in summary.iterations[1:4]]
    assert damping[1] == 2 * damping[0]
    assert damping[2] == 4 * damping[1]
    assert summary.reason == "relative_cost"


def test_a_system_that_never_solves_ends_with_its_reason():
    system = decay()
    system.fails = 1000
    start = system.x.copy()
    summary = minimize(system, StopRules(max_iterations=200))
    assert summary.reason == "step"
    assert np.array_equal(system.x, start)


def test_a_trial_that_is_not_finite_is_never_accepted():
    system = decay()
    honest, calls = system.try_step, []

    def sometimes_broken(damping):
        trial = honest(damping)
        calls.append(damping)
        return Trial(float("nan"), *list(trial_fields(trial))[1:]) if len(calls) % 2 else trial

    def trial_fields(trial):
        return trial.cost, trial.predicted_decrease, trial.step_norm, trial.parameter_norm

    system.try_step = sometimes_broken
    summary = minimize(system, StopRules(max_iterations=60))
    assert np.isfinite(summary.final_cost)
    assert not any(row.accepted for row in summary.iterations[1::2])
