"""Whether so many matches would agree with some geometry by chance.

Let a match at random agree with a given geometry with probability α: it does if it lies in a band of 2ε along an
epipolar line, or in a disc of radius ε around a homography's prediction. Among all models that minimal samples of m out
of n matches define, the expected number with at least k inliers is at most

    NFA = r (n − m) C(n, k) C(k, m) α^(k − m)

where r models come from a sample. What is not well below one is found in noise: of 33 random matches, 17 are within
four px of some fundamental matrix.

Reference:
    Moisan & Stival, A probabilistic criterion to detect rigid point matches between two images, IJCV 2004.
"""

from __future__ import annotations

import math

from sfm.core.cameras import Camera

_SAMPLE_SIZES = {False: 7, True: 4}
_MODELS_OF_A_SAMPLE = 10


def log10_false_alarms(
    inliers: int, count: int, camera1: Camera, camera2: Camera, error_px: float, *, planar: bool
) -> float:
    """log₁₀ NFA of `inliers` among `count` matches; of the two images the one that makes chance likelier decides.

    Args:
        error_px: largest error of an inlier.
        planar: they agree with a homography; otherwise with an epipolar geometry, for which F's seven degrees of
            freedom are counted also where fewer were free.
    """
    m = _SAMPLE_SIZES[planar]
    if inliers <= m:
        return math.inf
    chance = min(0.5, max(_chance(camera, error_px, planar) for camera in (camera1, camera2)))
    tests = math.log10(_MODELS_OF_A_SAMPLE * max(count - m, 1))
    return tests + _log10_binomial(count, inliers) + _log10_binomial(inliers, m) + (inliers - m) * math.log10(chance)


def _chance(camera: Camera, error_px: float, planar: bool) -> float:
    area = camera.width * camera.height
    if planar:
        return math.pi * error_px**2 / area
    return 2 * error_px * math.hypot(camera.width, camera.height) / area


def _log10_binomial(n: int, k: int) -> float:
    return (math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)) / math.log(10)
