"""Images as Fisher vectors: how a mixture of Gaussians would have to change to explain the descriptors of an image.

Descriptors x, reduced to some dimensions, are taken for draws from Σ_k w_k N(μ_k, diag σ_k²). With γ_k(x) the posterior
of component k and z = (x − μ_k) / σ_k, the gradients with respect to means and deviations are

    u_k = Σ_x γ_k(x) z / (N √w_k),    v_k = Σ_x γ_k(x) (z² − 1) / (N √(2 w_k)),

both for all k, end to end; then the signed root of every number, and unit length.

Reference:
    Perronnin, Sánchez & Mensink, Improving the Fisher kernel for large-scale image classification, ECCV 2010.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.special import logsumexp

from sfm.core.arrays import Value
from sfm.retrieval.vlad import unit
from sfm.retrieval.vocabulary import k_means, nearest

_ROUNDS = 10
_LEAST_VARIANCE = 1e-3
"""Share of the variance of all descriptors that a component keeps in every direction, lest it shrink to a point."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Mixture(Value):
    """A mixture of K Gaussians over principal components of descriptors.

    Attributes:
        mean, axes: reduced are `(descriptors - mean) @ axes`.
        weights, means, variances: of the components; variances along the axes.
    """

    mean: Float64[np.ndarray, " D"]
    axes: Float64[np.ndarray, "D P"]
    weights: Float64[np.ndarray, " K"]
    means: Float64[np.ndarray, "K P"]
    variances: Float64[np.ndarray, "K P"]


def train_mixture(
    descriptors: UInt8[np.ndarray, "N D"], components: int = 32, dimensions: int = 64, *, rng: np.random.Generator
) -> Mixture:
    """A mixture that explains `descriptors`, by expectation maximisation from k-means.

    Raises:
        ValueError: there are fewer descriptors than two for each component.
    """
    if len(descriptors) < 2 * components:
        raise ValueError(f"{components} components need {2 * components} descriptors, got {len(descriptors)}")
    rows = descriptors.astype(np.float64)
    mean = rows.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov(rows.T))
    axes = vectors[:, ::-1][:, :dimensions]
    reduced = (rows - mean) @ axes
    least = _LEAST_VARIANCE * reduced.var(axis=0).mean()
    labels = nearest(rows.astype(np.float32), k_means(rows.astype(np.float32), components, rng))
    mixture = _refitted(mean, axes, reduced, np.eye(components)[labels], least)
    for _ in range(_ROUNDS):
        mixture = _refitted(mean, axes, reduced, _posterior(mixture, reduced), least)
    return mixture


def fisher_vector(mixture: Mixture, descriptors: UInt8[np.ndarray, "N D"]) -> Float32[np.ndarray, " V"]:
    """The vector of an image, 2 K P numbers; zeros for an image without descriptors."""
    components, dimensions = mixture.means.shape
    if len(descriptors) == 0:
        return np.zeros(2 * components * dimensions, np.float32)
    rows = (descriptors - mixture.mean) @ mixture.axes
    posterior = _posterior(mixture, rows)
    zeroth = posterior.sum(axis=0)[:, None]
    first, second = posterior.T @ rows, posterior.T @ rows**2
    deviation, weights = np.sqrt(mixture.variances), mixture.weights[:, None]
    of_means = (first - zeroth * mixture.means) / deviation / np.sqrt(weights)
    spread = second - 2 * first * mixture.means + zeroth * mixture.means**2
    of_deviations = (spread / mixture.variances - zeroth) / np.sqrt(2 * weights)
    both = np.concatenate([of_means, of_deviations]).ravel() / len(rows)
    return unit((np.sign(both) * np.sqrt(np.abs(both)))[None])[0].astype(np.float32)


def _refitted(mean: np.ndarray, axes: np.ndarray, rows: np.ndarray, posterior: np.ndarray, least: float) -> Mixture:
    """The mixture of largest likelihood for given posteriors."""
    total = posterior.sum(axis=0) + 1e-9
    means = posterior.T @ rows / total[:, None]
    variances = np.maximum(posterior.T @ rows**2 / total[:, None] - means**2, least)
    return Mixture(mean, axes, total / total.sum(), means, variances)


def _posterior(mixture: Mixture, rows: np.ndarray) -> np.ndarray:
    """(N, K) how probable each component is for each row."""
    precision = 1 / mixture.variances
    squared = rows**2 @ precision.T - 2 * rows @ (mixture.means * precision).T
    squared += np.sum(mixture.means**2 * precision, axis=1)
    logs = np.log(mixture.weights) - 0.5 * (squared + np.log(mixture.variances).sum(axis=1))
    return np.exp(logs - logsumexp(logs, axis=1, keepdims=True))
