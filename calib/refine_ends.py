"""The choice of turns after which views are read, by what each says of what they share; see `refine_turns`.

A view's cost by small changes x of what views share is, its pose eliminated,

    c − bᵀx + ½ xᵀA x

and with R x in place of x if it is read after a turn, where R is what that does to the last entries of x. For a choice
of turns let A and b be those of the views as they are then read, and P a prior. What other views than v say is
x = (Σ A − A_v + P)⁻¹ (Σ b − b_v), and v's cost with it tells after which turn it is read. It is sought in two steps:

1. With M, the inverse of the mean of ΣA + P over the turns, for what turns change, pairs of views agree by the products
   b_uᵀ R_u M R_vᵀ b_v. The choice with the largest sum is sought from many views: the others first as they agree with
   that one, then each as it agrees with all. With f_v = R_vᵀ b_v and F their sum, that is f_vᵀ M (F − f_v).
2. From there, and from the views as they were read, views are turned as the others want them, until none changes. The
   better one has the lower sum of costs.

The sums over all views are kept, and a view is taken out of them and put in, so that the work grows with the number of
views and no faster.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Int64

from sfm.core.arrays import FloatArray, Value, Vector

_FEWEST, _BY_CHANCE = 3, (3.0, 60.0)
"""A choice of V views is believed if their agreement is beyond 3 + 60 / (V − 3). On flat boards the best choice reaches
5 by chance with 5 to 8 views and 3 with more; boards of five sets of 6 to 26 photos are at 15 to 34."""
_LEAST = 2.0
"""Cost that a view must save when it is turned, by what the others say: what saves less stays as it was read."""
_ROUNDS, _TOGETHER = 20, 6
"""Rounds in all, and those in which all views are turned at once that want it; then only the one that gains most."""
_STARTS = 100
_ROUNDING = 1e-6
"""Of costs, which are in units of the noise."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Quadratics(Value):
    """Costs of views by changes of what they share, in units of the noise, as they were read.

    Attributes:
        A: (V, K, K) and b (V, K).
        changes: (G, C, C) R of each turn, which changes the last C entries; the first is none.
        prior: (K, K).
    """

    A: FloatArray
    b: FloatArray
    changes: FloatArray
    prior: FloatArray

    def after(self, chosen: Int64[np.ndarray, " W"], views: Int64[np.ndarray, " W"]) -> tuple[FloatArray, FloatArray]:
        """A and b of some views after the turns that are chosen for them."""
        R, changed = self.changes[chosen], self.changes.shape[1]
        A, b = self.A[views], self.b[views]
        A[:, :, -changed:] = A[:, :, -changed:] @ R
        A[:, -changed:] = R.swapaxes(1, 2) @ A[:, -changed:]
        b[:, -changed:] = np.einsum("wji,wj->wi", R, b[:, -changed:])
        return A, b


@dataclasses.dataclass(slots=True)
class _Read:
    """Views after the turns that are chosen for them (V,), and the sums over them with the prior."""

    chosen: Int64[np.ndarray, " V"]
    A: FloatArray
    b: FloatArray
    all_A: FloatArray
    all_b: Vector

    def turn(self, quadratics: Quadratics, views: Int64[np.ndarray, " W"], turns: Int64[np.ndarray, " W"]) -> None:
        """Takes views out, and puts them in as they are read after other turns."""
        A, b = quadratics.after(turns, views)
        self.all_A += (A - self.A[views]).sum(0)
        self.all_b += (b - self.b[views]).sum(0)
        self.A[views], self.b[views], self.chosen[views] = A, b, turns


def most_likely_turns(quadratics: Quadratics, composed: Int64[np.ndarray, "G G"]) -> Int64[np.ndarray, " V"] | None:
    """Of each view the turn after which it is read; None where the choice is not to be believed.

    The end from which most views were read is the board's.

    Args:
        composed: which turn the second is after the first.
    """
    as_read = np.zeros(len(quadratics.b), np.int64)
    alike = _by_most(_most_alike(quadratics), composed)
    starts = [as_read, alike] if alike.any() else [as_read]
    tried = [_settled(quadratics, start) for start in starts]
    read, costs = min(tried, key=lambda one: float(one[1].min(1).sum()))
    sure = np.partition(costs, 1)[:, 1] - costs.min(1) > _LEAST
    beyond, few = _BY_CHANCE
    views = len(as_read)
    if views <= _FEWEST or _agreement(quadratics, read) <= beyond + few / (views - _FEWEST):
        return None
    return np.where(sure, _by_most(read.chosen, composed), 0)


def _by_most(chosen: Int64[np.ndarray, " V"], composed: Int64[np.ndarray, "G G"]) -> Int64[np.ndarray, " V"]:
    """The same choice, with most views as they are."""
    counts = [int(np.sum(composed[chosen, g] == 0)) for g in range(len(composed))]
    return composed[chosen, int(np.argmax(counts))]


def _most_alike(quadratics: Quadratics) -> Int64[np.ndarray, " V"]:
    """The choice with the largest sum of products of different views that was found."""
    R, changed, count = quadratics.changes, quadratics.changes.shape[1], len(quadratics.b)
    mean = (R.swapaxes(1, 2) @ quadratics.A[:, -changed:, -changed:].sum(0) @ R).mean(0)
    root = np.linalg.cholesky(np.linalg.inv(mean + quadratics.prior[-changed:, -changed:]))
    f = np.einsum("gji,vj->vgi", R, quadratics.b[:, -changed:], optimize=True) @ root
    every, starts = np.arange(count), np.unique(np.linspace(0, count - 1, min(count, _STARTS)).astype(int))
    own = f @ f.swapaxes(1, 2)
    best, most = np.zeros(count, np.int64), -np.inf
    sums = f[starts, 0]
    before = np.full((len(starts), count), -1)
    for _ in range(_ROUNDS):
        products = np.einsum("sc,vgc->svg", sums, f, optimize=True)
        # A view has no say in its own turn.
        known = before >= 0
        products -= np.where(known[:, :, None], own[every, :, np.where(known, before, 0)], 0.0)
        chosen = products.argmax(2)
        if before[0, 0] < 0:
            chosen[np.arange(len(starts)), starts] = 0
        now = f[every, chosen]
        sums = now.sum(1)
        values = np.sum(sums**2, 1) - np.sum(now**2, (1, 2))
        if values.max() > most + 1e-9 * abs(most):
            best, most = chosen[values.argmax()], float(values.max())
        if np.array_equal(chosen, before):
            break
        before = chosen
    return best


def _settled(quadratics: Quadratics, start: Int64[np.ndarray, " V"]) -> tuple[_Read, FloatArray]:
    """Views turned as the others want them, until none changes; and their costs (V, G) by what these say."""
    every = np.arange(len(start))
    A, b = quadratics.after(start, every)
    read = _Read(start.copy(), A, b, A.sum(0) + quadratics.prior, b.sum(0))
    costs = _costs(quadratics, read)
    for k in range(_ROUNDS):
        wanted = costs.argmin(1)
        gains = costs[every, read.chosen] - costs.min(1)
        views = np.flatnonzero(gains > _ROUNDING)
        if not len(views):
            break
        views = views if k < _TOGETHER else views[[gains[views].argmax()]]
        read.turn(quadratics, views, wanted[views])
        costs = _costs(quadratics, read)
    return read, costs


def _costs(quadratics: Quadratics, read: _Read) -> FloatArray:
    """(V, G) of each view after each turn, with what the other views say."""
    x = np.linalg.solve(read.all_A - read.A, (read.all_b - read.b)[:, :, None])
    changed = quadratics.changes.shape[1]
    tried = np.repeat(x, len(quadratics.changes), 2)
    tried[:, -changed:] = np.einsum("gij,vj->vig", quadratics.changes, x[:, -changed:, 0], optimize=True)
    bent = 0.5 * quadratics.A @ tried - quadratics.b[:, :, None]
    return np.sum(tried * bent, 1)


def _agreement(quadratics: Quadratics, read: _Read) -> float:
    """Mean over the views of the logarithm of how much likelier all is as chosen than with this one read otherwise."""
    count, turns = len(read.chosen), len(quadratics.changes)
    most = _likelihoods(read.all_A, read.all_b)
    other = np.full(count, -np.inf)
    rest_A, rest_b = read.all_A - read.A, read.all_b - read.b
    for k in range(1, turns):
        A, b = quadratics.after((read.chosen + k) % turns, np.arange(count))
        other = np.maximum(other, _likelihoods(rest_A + A, rest_b + b))
    return float(np.mean(most - other))


def _likelihoods(A: FloatArray, b: FloatArray) -> FloatArray:
    """Logarithm of the integral over x of exp(bᵀx − ½ xᵀA x), less a constant."""
    x = np.linalg.solve(A, b[..., None])[..., 0]
    return 0.5 * (np.sum(b * x, -1) - np.linalg.slogdet(A)[1])
