"""When a richer model is believed: the rule that lens models, shapes of boards and rigs are chosen by.

From the simplest on, a richer one takes over if its error on photos that were held out is

    clearly lower       than the simpler one's, by more than chance, view by view, and by a fiftieth at least;
    and generalises     no more than 1.05 times its error on the photos that it was fitted to. Where the simpler model
                        does not keep to that either, its excess is the measure.

A right model has errors on unseen photos that are hardly larger than on seen ones. With s numbers that photos share
among n coordinates of corners the squared ratio of the two is about (1 + s/n) / (1 − s/n): a board of 54 points that
lie anywhere (155 numbers) in 14 photos cannot stay below 1.1, whatever the noise. It may still predict best, and that
is said; but its training error misleads whoever sees it, and some of what it predicts by are these photos' own errors.

Reference:
    Hastie, Tibshirani & Friedman, The Elements of Statistical Learning, 2nd ed. 2009, §7.4 (optimism), §7.10.
"""

from __future__ import annotations

import math

import numpy as np

from sfm.core.arrays import Vector

GENERALISES = 1.05
"""Error of photos that were held out over that of the others, up to which a model is believed."""
_AS_MUCH = 1.25
"""Times the excess of the simpler model that one may have, where that is larger."""
_NOTABLE = 0.04
"""Part of the squared error: a fiftieth of the error is no reason for another coefficient."""
_MANY = 200
"""So many photos are not asked of anybody."""


def is_clearly_lower(richer: Vector, simpler: Vector, standard_errors: float) -> bool:
    """Whether squared errors of the same views, in their order, are lower by more than chance, and notably."""
    if not np.all(np.isfinite(richer)):
        return False
    if not np.all(np.isfinite(simpler)):
        return True
    gain = simpler - richer
    error = float(np.std(gain, ddof=1)) / math.sqrt(len(gain)) if len(gain) > 1 else math.inf
    return bool(np.mean(gain) > max(standard_errors * error, _NOTABLE * np.mean(simpler)))


def generalises(ratio: float, simpler: float) -> bool:
    """Whether a model is believed by its error on held-out photos over that on the others, and the simpler one's."""
    return ratio - 1 <= max(GENERALISES - 1, _AS_MUCH * (simpler - 1))


def photos_needed(count: int, ratio: float, what: str = "photos") -> str:
    """How many photos (or frames) like these would bring a ratio down to what is believed, in words.

    The excess of held-out over training errors, (r² − 1) / (r² + 1), is inverse to the number of photos.
    """
    excess, allowed = ((r * r - 1) / (r * r + 1) for r in (ratio, GENERALISES))
    needed = count * excess / allowed
    if not needed <= _MANY:
        return f"many more {what}"
    step = 10 if needed > 20 else 5
    return f"about {step * math.ceil(needed / step)} {what} like these"


def what_it_brings(name: str, errors_px: tuple[float, float], but: str, needs: str, option: str) -> str:
    """One sentence on a richer model that was not taken.

    Args:
        errors_px: of held-out photos, with the model that was taken and with the richer one.
        but: why it was not taken; needs: what it takes; option: of the command, that takes it nevertheless.
    """
    was, would_be = errors_px
    apart = abs(was - would_be)
    digits = min(max(3, 1 - math.floor(math.log10(apart))), 6) if 0 < apart < math.inf else 3
    return (
        f"{name} would bring the error of photos held out from {was:.{digits}f} to {would_be:.{digits}f} px, "
        f"but {but}: it needs {needs}, or {option}"
    )
