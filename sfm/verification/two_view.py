"""Two-view geometry of matched images: which model explains the matches, and which of them are inliers.

With I_E, I_F, I_H the inliers of the essential matrix, the fundamental matrix and a homography at one px threshold:

    both focal lengths known     I_E ≥ 0.95 I_F    CALIBRATED, else UNCALIBRATED: the calibration must be wrong
    otherwise                                      UNCALIBRATED
    then                         I_H > 0.8 I       PANORAMIC if a rotation alone explains the matches, else PLANAR
    then                         WATERMARK if the inliers are a translation of things at the border, or stand still
                                 in a small part of the image while nothing else matches

Where focal lengths are guessed, the rotation may have another focal length than the guess, but must then explain the
matches as closely as the homography does. Exact copies of an image leave F open, and are decided by H alone.

F and H live on the pixels of undistorted pinhole cameras with the given focal lengths and principal points, which are
the pixels themselves for cameras without distortion. Fisheye and omnidirectional cameras have no such pixels: they
are always treated as calibrated, and are panoramic by the rotation test alone.

The poses of uncalibrated pairs come from E = K2ᵀ F K1 with the guessed focal lengths: good enough to begin with.

Sampling of F and of H stops early where they can no longer change the decision.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float64

from sfm.core.arrays import Mask, Matrix3, Points2D
from sfm.core.cameras import Camera
from sfm.core.errors import ConfigError, Rejected
from sfm.core.geometry.epipolar import essential_from_fundamental, essential_from_pose, pose_from_essential
from sfm.core.geometry.homography import decompose_homography
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.robust.fundamental import MatrixEstimate
from sfm.core.robust.ransac import RansacConfig, polish
from sfm.core.robust.relative_pose import (
    essential_problem,
    flat,
    relative_pose_of_bearings,
    scatter,
)
from sfm.core.scene import Matches, PairKind, TwoViewGeometry
from sfm.verification.matched_pair import MatchedPair
from sfm.verification.rotation_only import fit_rotation, focal_factor_of_rotation
from sfm.verification.significance import log10_false_alarms
from sfm.verification.watermark import overlay_of, watermark_of


@dataclasses.dataclass(frozen=True, kw_only=True)
class VerificationConfig:
    """What counts as a verified pair."""

    ransac: RansacConfig = dataclasses.field(default_factory=RansacConfig)
    """Threshold, confidence and limits of the sampling, and the fewest inliers."""
    trust_focal: bool = False
    """Treat every camera as calibrated, also those whose focal length is only a guess."""
    min_calibrated_ratio: float = 0.95
    """A pair is calibrated if E keeps this fraction of the inliers of F, which has two more degrees of freedom."""
    max_homography_ratio: float = 0.8
    """A homography that explains more than this fraction of the inliers means a plane or a rotation."""
    min_inlier_ratio: float = 0.3
    """A smaller fraction of the matches is a rejection. Of 2,354 verified pairs of ten real sets three had less than
    0.35 and none less than 0.25; walls of equal tiles, of which some always agree with a geometry, have 0.1 to 0.3."""
    max_log10_false_alarms: float = -3.0
    """The inliers must be fewer by chance than this, see `significance`. Of 1,800 pairs of seven real sets with known
    poses this rejects 35 with wrong poses and 8 with right ones."""
    min_rotation_ratio: float = 0.9
    """A pair is panoramic if a rotation alone explains this fraction of the inliers."""
    detect_watermark: bool = True
    """Look for matches between watermarks, frames and time stamps."""
    watermark_border: float = 0.1
    """Width of the border in which watermarks are looked for, as a fraction of the image diagonal."""
    min_watermark_ratio: float = 0.7
    """Fraction of the inliers that must lie in the border, and of all that must share one translation there."""
    detect_repetition: bool = True
    """Do not trust matches of things that an image shows many of, if there is hardly anything else (see `verify`)."""
    min_distinct_lead: int = 10
    """By how many those of the other matches that agree must outnumber those that do not. On 90 rendered pairs of
    photos of walls of equal tiles, bricks or windows too few agreed for any geometry; with a door, some pictures or a
    room in front of them 111 or more, and all of them."""

    def __post_init__(self) -> None:
        if self.min_distinct_lead < 0:
            raise ConfigError(f"min_distinct_lead must not be negative, got {self.min_distinct_lead}")
        for name in ("min_calibrated_ratio", "max_homography_ratio", "min_rotation_ratio", "min_watermark_ratio"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"{name} must be in (0, 1], got {getattr(self, name)}")


def two_view_geometry(
    points2D_1: Float64[np.ndarray, "N1 2"],
    points2D_2: Float64[np.ndarray, "N2 2"],
    matches: Matches,
    camera1: Camera,
    camera2: Camera,
    config: VerificationConfig,
    rng: np.random.Generator,
) -> TwoViewGeometry | Rejected:
    """The geometry that explains most matches, be they of things that repeat or not; otherwise as `verify_pair`."""
    if len(matches) < config.ransac.min_inliers:
        return Rejected("too_few_matches", f"{len(matches)} of {config.ransac.min_inliers} needed")
    points1, points2 = points2D_1[matches.indices[:, 0]], points2D_2[matches.indices[:, 1]]
    pair = MatchedPair(points1, points2, camera1, camera2, config.ransac, trust_focal=config.trust_focal, rng=rng)
    found = _classify(pair, config)
    if isinstance(found, Rejected):
        return found
    geometry, inliers = found
    seen = points1[inliers], points2[inliers]
    mark = _mark(seen, (points2D_1, points2D_2), camera1, camera2, config) if config.detect_watermark else None
    if mark is not None:
        # A logo on every photo may have more matches than what two of them share, and agree with its geometry.
        others = np.delete(matches.indices, np.flatnonzero(inliers)[mark], axis=0)
        beneath = two_view_geometry(points2D_1, points2D_2, Matches(others), camera1, camera2, config, rng)
        if beneath:
            return beneath
        geometry = TwoViewGeometry(PairKind.WATERMARK, geometry.matches)
    return dataclasses.replace(geometry, matches=matches.indices[inliers])


def _mark(
    seen: tuple[Points2D, Points2D],
    keypoints: tuple[np.ndarray, np.ndarray],
    camera1: Camera,
    camera2: Camera,
    config: VerificationConfig,
) -> Mask | None:
    """Which inliers belong to a watermark or a logo, if they are one."""
    limits = {"border": config.watermark_border, "min_ratio": config.min_watermark_ratio}
    mark = watermark_of(*seen, camera1, camera2, max_error_px=config.ransac.max_error_px, **limits)
    return overlay_of(*seen, *keypoints, camera1, camera2) if mark is None else mark


def _classify(pair: MatchedPair, config: VerificationConfig) -> tuple[TwoViewGeometry, Mask] | Rejected:
    """Geometry, with its matches yet to be filled in, and the inlier mask."""
    found = _calibrated(pair, config) if pair.calibrated else _uncalibrated(pair, config)
    if isinstance(found, Rejected):
        open_ = pair.perspective and found.reason == "no_model"
        return _by_homography_alone(pair, config, found) if open_ else found
    geometry, inliers = found
    too_few = _too_few(inliers, pair, config)
    if too_few:
        return too_few
    homography = None
    if pair.perspective:
        enough = config.max_homography_ratio * inliers.sum()
        estimate = pair.homography(pair.limited(4, enough))
        if isinstance(estimate, MatrixEstimate) and estimate.inliers.sum() > enough:
            homography = estimate
            if estimate.inliers.sum() > inliers.sum():
                inliers = estimate.inliers
    by_chance = _by_chance(inliers, pair, config, planar=homography is not None)
    if by_chance:
        return by_chance
    if homography is None and pair.perspective:
        return geometry, inliers
    return _without_parallax(pair, config, geometry, homography, inliers), inliers


def _too_few(inliers: Mask, pair: MatchedPair, config: VerificationConfig) -> Rejected | None:
    needed = max(config.min_inlier_ratio, config.ransac.min_inlier_ratio) * pair.count
    return Rejected("low_inlier_ratio", f"{inliers.sum() / pair.count:.2f}") if inliers.sum() < needed else None


def _by_chance(inliers: Mask, pair: MatchedPair, config: VerificationConfig, *, planar: bool) -> Rejected | None:
    sizes = int(inliers.sum()), pair.count, pair.camera1, pair.camera2
    if log10_false_alarms(*sizes, config.ransac.max_error_px, planar=planar) <= config.max_log10_false_alarms:
        return None
    return Rejected("maybe_by_chance", f"{inliers.sum()} of {pair.count} matches")


def _by_homography_alone(
    pair: MatchedPair, config: VerificationConfig, rejected: Rejected
) -> tuple[TwoViewGeometry, Mask] | Rejected:
    """The geometry where no sample gave an F: every F agrees with matches that do not move at all."""
    estimate = pair.homography(config.ransac)
    if isinstance(estimate, Rejected):
        return rejected
    too_few = _too_few(estimate.inliers, pair, config) or _by_chance(estimate.inliers, pair, config, planar=True)
    if too_few:
        return too_few
    nothing = TwoViewGeometry(PairKind.PLANAR_OR_PANORAMIC, _NO_MATCHES)
    return _without_parallax(pair, config, nothing, estimate, estimate.inliers), estimate.inliers


def _calibrated(pair: MatchedPair, config: VerificationConfig) -> tuple[TwoViewGeometry, Mask] | Rejected:
    essential = relative_pose_of_bearings(pair.bearings1, pair.bearings2, config.ransac, rng=pair.rng)
    if isinstance(essential, Rejected):
        mendable = pair.perspective and essential.reason != "too_few_points"
        return _uncalibrated(pair, config) if mendable else essential
    matrix, decisive = None, essential.inliers.sum() / config.min_calibrated_ratio
    # F cannot win where E already explains nearly all matches.
    if pair.perspective and decisive < pair.count:
        fundamental = pair.fundamental(pair.limited(7, decisive))
        if isinstance(fundamental, MatrixEstimate):
            if fundamental.inliers.sum() > decisive:
                return _uncalibrated(pair, config, fundamental)
            matrix = fundamental.matrix
    pose = essential.cam2_from_cam1
    geometry = TwoViewGeometry(
        *(PairKind.CALIBRATED, _NO_MATCHES, pose, essential.essential, matrix),
        tri_angle=pair.tri_angle(pose, essential.inliers),
    )
    return geometry, essential.inliers


def _uncalibrated(
    pair: MatchedPair, config: VerificationConfig, fundamental: MatrixEstimate | None = None
) -> tuple[TwoViewGeometry, Mask] | Rejected:
    estimate = fundamental or pair.fundamental(config.ransac)
    if isinstance(estimate, Rejected):
        return estimate
    pose, angle = None, 0.0
    seen = pair.with_rays(estimate.inliers)
    k1, k2 = pair.camera1.calibration_matrix, pair.camera2.calibration_matrix
    if seen.any():
        essential = essential_from_fundamental(estimate.matrix, k1, k2)
        pose, _ = pose_from_essential(essential, pair.bearings1.rays[seen], pair.bearings2.rays[seen])
        angle = pair.tri_angle(pose, seen)
    geometry = TwoViewGeometry(PairKind.UNCALIBRATED, _NO_MATCHES, pose, F=estimate.matrix, tri_angle=angle)
    return geometry, estimate.inliers


def _without_parallax(
    pair: MatchedPair,
    config: VerificationConfig,
    geometry: TwoViewGeometry,
    homography: MatrixEstimate | None,
    inliers: Mask,
) -> TwoViewGeometry:
    """The geometry as it is, or as a panoramic or planar one."""
    seen = pair.with_rays(inliers)
    matrix = homography.matrix if homography else None
    rotation = _pure_rotation(pair, config, matrix, seen, config.min_rotation_ratio * inliers.sum())
    if rotation is not None:
        pose = Rigid3(rotation, np.zeros(3))
        return dataclasses.replace(
            geometry, kind=PairKind.PANORAMIC, cam2_from_cam1=pose, E=None, H=matrix, tri_angle=0.0
        )
    if matrix is None:
        return geometry
    pose = _planar_pose(pair, config, geometry.cam2_from_cam1, matrix, seen)
    if pose is None:
        return dataclasses.replace(geometry, kind=PairKind.PLANAR_OR_PANORAMIC, H=matrix)
    return dataclasses.replace(
        geometry,
        kind=PairKind.PLANAR,
        cam2_from_cam1=pose,
        E=essential_from_pose(pose) if geometry.E is not None else None,
        H=matrix,
        tri_angle=pair.tri_angle(pose, seen),
    )


def _pure_rotation(
    pair: MatchedPair, config: VerificationConfig, homography: Matrix3 | None, inliers: Mask, needed: float
) -> Rotation3 | None:
    """The rotation that explains at least `needed` inliers, under guessed focal lengths or a multiple of them."""
    limit = config.ransac.max_error_px
    rotation, explained = fit_rotation(pair.bearings1, pair.bearings2, inliers, limit)
    if explained.sum() >= needed:
        return rotation
    if homography is None or not any(pair.guessed):
        return None
    k1, k2 = pair.camera1.calibration_matrix, pair.camera2.calibration_matrix
    factor = focal_factor_of_rotation(homography, k1, k2, pair.guessed)
    limit = min(limit, max(_CLOSELY_PX, _CLOSELY * pair.transfer_error(homography, inliers)))
    rotation, explained = fit_rotation(*pair.bearings_under(factor), inliers, limit)
    return rotation if explained.sum() >= needed else None


def _planar_pose(
    pair: MatchedPair, config: VerificationConfig, pose: Rigid3 | None, homography: Matrix3, inliers: Mask
) -> Rigid3 | None:
    """The best pose among the given one and those of the homography, each refined on the epipolar errors.

    F of a plane is not determined, so that the pose of an uncalibrated pair is only one candidate. The best has most
    inliers in front of both cameras; among equals, the lowest error.
    """
    motions, normals = decompose_homography(
        homography, pair.camera1.calibration_matrix, pair.camera2.calibration_matrix
    )
    visible = (pair.bearings1.rays[inliers] @ normals.T > 0).mean(0) > 0.5
    moving = np.linalg.norm(motions.translation, axis=1) > 1e-9
    candidates = [motions[int(k)] for k in np.flatnonzero(visible & moving)] + ([pose] if pose is not None else [])
    problem, usable = essential_problem(pair.bearings1, pair.bearings2, config.ransac.max_error_px)
    best, best_key = None, (-1.0, 0.0)
    for candidate in candidates:
        start = flat(essential_from_pose(candidate) / np.linalg.norm(candidate.translation))
        model, squares = polish(problem, start)
        kept = scatter(squares < problem.max_error**2, usable)
        if not kept.any():
            continue
        essential = model[:9].reshape(3, 3)
        refined, front = pose_from_essential(essential, pair.bearings1.rays[kept], pair.bearings2.rays[kept])
        key = (float(front.sum()), -float(np.minimum(squares, problem.max_error**2).sum()))
        if key > best_key:
            best, best_key = refined, key
    return best


_CLOSELY, _CLOSELY_PX = 3.0, 1.0
"""What counts as explained as closely as by a homography: an error of this multiple of its median, or this small."""
_NO_MATCHES = np.zeros((0, 2), np.int32)
