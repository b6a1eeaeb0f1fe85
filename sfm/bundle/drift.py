"""A scene that drifts with the bias of its positions.

Where only positions with a common unknown bias b say where a scene lies, all of it may shift along with b, and nothing
but the prior of the bias, |b|² / (2 σ²), minds. In the normal matrix that is a tiny number beside the information of
the positions themselves: with σ 10⁷ times theirs it is lost in rounding, and long before it is inexact. But with Q the
shift of everything by b, S = S₀ + E Eᵀ / σ² with E the columns of the identity for the bias, S₀ Q = 0 and Eᵀ Q = 1:

    S⁻¹ = F + σ² Q Qᵀ        F = S⁻¹ where the bias is held, with zeros for it

as S (F + σ² Q Qᵀ) = S F + E Qᵀ = 1 shows. So the bias is taken for known, and its variance added to every place.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from sfm.bundle.priors import PositionPrior
from sfm.bundle.problem import BundleProblem
from sfm.bundle.system import BundleSystem


class Drift(NamedTuple):
    """The problem with its bias known, the variance σ² of each coordinate of the drift, and the cost of the bias."""

    problem: BundleProblem
    variance: float
    cost: float


def drift_of(problem: BundleProblem, system: BundleSystem) -> Drift | None:
    """How the scene of `problem` drifts, `system` being its own; None where it does not, or the gauge holds some."""
    layout, places = system.layout, [prior for prior in problem.pose_priors if isinstance(prior, PositionPrior)]
    if len(places) != 1 or places[0].bias_sigma is None or problem.point_priors:
        return None
    frames = np.r_[layout.image_frame[layout.image], layout.image_frame[places[0].images]]
    poses = len(layout.slot_frame)
    if np.any(layout.frame_slot[frames] < 0) or not np.all(problem.free_points[layout.point]):
        return None
    if not places[0].images.size or system.held[:poses].any():
        return None
    bias, sigma = system.biases[0], places[0].bias_sigma
    known = dataclasses.replace(places[0], positions=places[0].positions + bias, bias_sigma=None)
    priors = tuple(known if isinstance(prior, PositionPrior) else prior for prior in problem.priors)
    return Drift(dataclasses.replace(problem, priors=priors), sigma**2, 0.5 * float(bias @ bias) / sigma**2)
