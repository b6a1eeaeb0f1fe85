"""Verification of a pair, also where the images show many things of a kind.

Matches between things that repeat prove little: of all the tiles of a wall some are always matched as a geometry wants
that is off by whole tiles, and along an epipolar line the next tile fits as well. So where an image repeats itself, one
of these must hold:

    the distinct matches, of things that an image shows once, agree with a geometry by themselves, and those that do
    outnumber those that do not;
    or nearly all matches agree with one homography, which leaves no choice among equal things: the wall is not as
    regular as it seems. Matches of equal tiles scatter, even where the photos differ by exactly one tile.

A homography that the distinct matches agree with also tells the right ones among the others. They are added, so that
the geometry of a wall does not rest on the door in it alone.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from sfm.core.arrays import Mask
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.scene import Matches, TwoViewGeometry
from sfm.verification.matched_pair import MatchedPair
from sfm.verification.two_view import VerificationConfig, two_view_geometry

_NEARLY_ALL = 0.75
"""Share of the matches by which a homography proves itself. Of photos of a wall of equal windows exactly one window
apart 0.69 agree with the wrong one; of those of a real chessboard 0.69 to 0.93 with the right one."""


def verify_pair(
    points2D_1: Float64[np.ndarray, "N1 2"],
    points2D_2: Float64[np.ndarray, "N2 2"],
    matches: Matches,
    camera1: Camera,
    camera2: Camera,
    config: VerificationConfig = VerificationConfig(),
    *,
    distinct1: Bool[np.ndarray, " N1"] | None = None,
    distinct2: Bool[np.ndarray, " N2"] | None = None,
    rng: np.random.Generator,
) -> TwoViewGeometry | Rejected:
    """The geometry that explains the matches of two images, with its inliers; see `two_view` for the rule.

    Args:
        points2D_1, points2D_2: all keypoints of the images, px; `matches` are rows of them.
        distinct1, distinct2: which keypoints look like nothing else in their image, if it repeats itself.
    Returns:
        The pose has a translation of unit length (zero if panoramic); its matches are those of the winning model.
    Raises:
        IndexError: a match names a keypoint that does not exist.
    """

    def geometry_of(chosen: Mask) -> TwoViewGeometry | Rejected:
        some = Matches(matches.indices[chosen])
        return two_view_geometry(points2D_1, points2D_2, some, camera1, camera2, config, rng)

    every = np.ones(len(matches), np.bool_)
    whole = geometry_of(every)
    if (distinct1 is None and distinct2 is None) or len(matches) < config.ransac.min_inliers:
        return whole
    distinct = _distinct(matches, distinct1, distinct2)
    alone = geometry_of(distinct)
    points1, points2 = points2D_1[matches.indices[:, 0]], points2D_2[matches.indices[:, 1]]
    pair = MatchedPair(points1, points2, camera1, camera2, config.ransac, trust_focal=config.trust_focal, rng=rng)
    placed1, placed2 = _placed(pair, whole), _placed(pair, alone)
    agreeing = 0 if isinstance(alone, Rejected) else len(alone)
    if _prevails(agreeing, distinct, config):
        for placed in (placed1, placed2):
            if (placed & distinct).sum() > config.max_homography_ratio * agreeing:
                more = geometry_of(placed | distinct)
                return alone if isinstance(more, Rejected) else more
        return alone
    if placed1.mean() > _NEARLY_ALL and _prevails(int(placed1.sum()), every, config):
        return geometry_of(placed1)
    return Rejected("repeated_texture", f"{agreeing} of {distinct.sum()} distinct matches agree")


def _distinct(
    matches: Matches, distinct1: Bool[np.ndarray, " N1"] | None, distinct2: Bool[np.ndarray, " N2"] | None
) -> Mask:
    """The matches of which both keypoints are distinct."""
    keep = np.ones(len(matches), np.bool_)
    for column, distinct in enumerate((distinct1, distinct2)):
        if distinct is not None:
            keep &= distinct[matches.indices[:, column]]
    return keep


def _placed(pair: MatchedPair, found: TwoViewGeometry | Rejected) -> Mask:
    """The matches that the homography of a geometry explains, if it has one."""
    if isinstance(found, Rejected) or found.H is None:
        return np.zeros(pair.count, np.bool_)
    return pair.transferred(found.H)


def _prevails(agreeing: int, matches: Mask, config: VerificationConfig) -> bool:
    """Whether so many of some matches outnumber the others by enough."""
    return 2 * agreeing - int(matches.sum()) >= config.min_distinct_lead
