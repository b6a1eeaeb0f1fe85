"""Levenberg–Marquardt with Nielsen's rule for the damping.

At x with gradient g, normal matrix H and D = diag(H), the step solves  (H + λ D) δ = −g.  The gain

    ϱ = (F(x) − F(x ⊕ δ)) / (−½ gᵀδ + ½ λ δᵀDδ)

compares what a step brings with what the quadratic model promised. A step with positive gain is taken and the
damping becomes λ max(1/5, 1 − (2ϱ − 1)³); otherwise λ grows by ν = 2, 4, 8, … until a step brings something.
Nielsen's bound is 1/3: with 1/5, adjustments of sixteen kinds take one step in eight less and none of them more;
with 1/10 one takes twice as many. Where ϱ is within 0.5 % of 1 the model was right, and the bound is 1/25: of 27
kinds ten take fewer steps, up to a half, and one takes more (23 instead of 15). Within 2 % one took 17 instead of 12.

A small decrease of the cost means convergence only where the damping is small: a heavily damped step is short for
that reason alone. The gradient says so whatever its units are by the *steepness*

    max_i |g_i| / √(2 F H_ii)

the largest cosine of the angles between the residuals and the columns of their derivative: 0 at a minimum, 1 where one
parameter alone could take all residuals to zero. Robust losses, whose weighted squares sum to less than 2F, keep it
below 1.

Reference:
    Moré, The Levenberg–Marquardt algorithm: implementation and theory, 1978 (the cosine).
    Madsen, Nielsen & Tingleff, Methods for non-linear least squares problems, 2nd ed. 2004, §3.2.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np

from sfm.core.arrays import FloatArray

StopReason: TypeAlias = Literal["relative_cost", "gradient", "step", "max_iterations", "no_free_parameters"]

_INITIAL_DAMPING, _MAX_DAMPING = 1e-4, 1e20
_EXACT = 0.005
_FREE_DAMPING = 1.0
"""Above it a step is less than half of the undamped one, and a small decrease says nothing."""
_MIN_GAIN = 1e-3
_RELATIVE_STEP = 1e-14
"""Steps below this part of the parameters' norm are rounding."""


@dataclasses.dataclass(frozen=True, slots=True)
class Trial:
    """A step that was computed but not taken: its cost, the promised decrease, its length and that of x.

    `steepness` is that at x, see the module; a system that does not tell never stops by its gradient.
    """

    cost: float
    predicted_decrease: float
    step_norm: float
    parameter_norm: float
    steepness: float = math.inf


@runtime_checkable
class System(Protocol):
    """What the loop needs of a problem; it keeps the current parameters and those of the last trial."""

    def linearize(self) -> tuple[float, float]:
        """Cost and largest absolute entry of the gradient at the current parameters."""
        ...

    def try_step(self, damping: float) -> Trial | None:
        """Solves for a step and evaluates it; None where the damped matrix is not positive definite."""
        ...

    def accept(self) -> None:
        """Makes the parameters of the last trial the current ones."""
        ...


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class StopRules:
    """When to stop: after a number of trials, at a relative decrease of the cost, at a steepness."""

    max_iterations: int = 100
    relative_cost_tolerance: float = 1e-6
    gradient_tolerance: float = 1e-10


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Damping:
    """How the damping falls."""

    least: float = 1e-10
    """Less changes no step, but rounding makes a matrix indefinite in directions that are free, as those of a scene
    are: with 1e-16 robust losses take up to twice the steps."""
    least_factor: float = 0.2
    """The most that a step takes off it; see the module."""
    least_factor_of_exact: float = 0.04
    """The same where the quadratic model was right."""


USUAL_DAMPING = Damping()


@dataclasses.dataclass(frozen=True, slots=True)
class Iteration:
    """One row of the table: the state after a trial. Row 0 is the start.

    `gradient_max` is the last that was computed: after the step that ends the loop it is not computed again.
    """

    cost: float
    cost_change: float
    gradient_max: float
    step_norm: float
    damping: float
    gain: float
    accepted: bool


@dataclasses.dataclass(frozen=True, slots=True)
class Summary:
    """Why the loop ended, and its table."""

    reason: StopReason
    iterations: tuple[Iteration, ...]

    @staticmethod
    def at_once(reason: StopReason, cost: float, gradient: float) -> Summary:
        """A loop that ended before its first step."""
        return Summary(reason, (Iteration(cost, 0.0, gradient, 0.0, _INITIAL_DAMPING, 0.0, True),))

    @property
    def initial_cost(self) -> float:
        """The cost at the start."""
        return self.iterations[0].cost

    @property
    def final_cost(self) -> float:
        """The cost at the end."""
        return self.iterations[-1].cost


def minimize(system: System, rules: StopRules, fall: Damping = USUAL_DAMPING) -> Summary:
    """Runs the loop on `system`, which holds the solution afterwards. The cost never rises."""
    cost, gradient = system.linearize()
    if gradient == 0:
        return Summary.at_once("gradient", cost, gradient)
    table = list(Summary.at_once("max_iterations", cost, gradient).iterations)
    damping, growth = _INITIAL_DAMPING, 2.0
    for _ in range(rules.max_iterations):
        used, trial = damping, system.try_step(damping)
        if trial is not None and trial.steepness <= rules.gradient_tolerance:
            return Summary("gradient", tuple(table))
        gain, change, accepted = _gain(cost, trial)
        if accepted and trial is not None:
            system.accept()
            cost = trial.cost
        reason = _stop(rules, cost, change, used, trial)
        if accepted and reason is None:
            cost, gradient = system.linearize()
            reason = "gradient" if gradient == 0 else None
            least = fall.least_factor_of_exact if abs(gain - 1) < _EXACT else fall.least_factor
            damping = max(fall.least, damping * max(least, 1 - (2 * min(gain, 1.5) - 1) ** 3))
            growth = 2.0
        elif not accepted:
            damping, growth = damping * growth, growth * 2
        step = trial.step_norm if trial else 0.0
        table.append(Iteration(cost, change if accepted else 0.0, gradient, step, used, gain, accepted))
        if reason is not None:
            return Summary(reason, tuple(table))
    return Summary("max_iterations", tuple(table))


def steepness(gradient: FloatArray, diagonal: FloatArray, cost: float) -> float:
    """The largest |g_i| / √(2 F H_ii) of entries of any shape, 0 for those whose residuals do not depend on them."""
    scale = np.sqrt(2 * cost * diagonal)
    cosines = np.divide(np.abs(gradient), scale, out=np.zeros(np.shape(gradient)), where=scale > 0)
    return float(cosines.max(initial=0.0))


def _gain(cost: float, trial: Trial | None) -> tuple[float, float, bool]:
    """Gain ratio, decrease of the cost, and whether the step is worth taking."""
    if trial is None or not trial.cost <= cost or not trial.predicted_decrease > 0:
        return 0.0, cost - trial.cost if trial else float("inf"), False
    change = cost - trial.cost
    gain = change / trial.predicted_decrease
    return gain, change, bool(gain > _MIN_GAIN)


def _stop(rules: StopRules, cost: float, change: float, damping: float, trial: Trial | None) -> StopReason | None:
    """Why to end after a trial, but for the gradient."""
    if trial is None:
        return "step" if damping > _MAX_DAMPING else None
    small = rules.relative_cost_tolerance * cost
    if damping <= _FREE_DAMPING and abs(change) <= small and trial.predicted_decrease <= small:
        return "relative_cost"
    if trial.step_norm <= _RELATIVE_STEP * trial.parameter_norm or damping > _MAX_DAMPING:
        return "step"
    return None
