"""Settings of mapping."""

from __future__ import annotations

import dataclasses

from sfm.core.errors import ConfigError


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class MappingConfig:
    """How models grow; angles in degrees, errors in px of the full image."""

    min_track_length: int = 3
    """Views that a track must have to make a point: no third view checks a shorter one. Shorter ones are used where
    the images at hand have fewer than `init_min_inliers` of the others."""
    init_min_inliers: int = 100
    """Matches of the first pair; halved and quartered where no pair has them."""
    init_min_angle_deg: float = 16.0
    """Median angle between the rays of the first pair; relaxed before the matches are."""
    init_max_forward: float = 0.95
    """Largest part of the first pair's motion along the optical axis."""
    init_trials: int = 200
    """First pairs that may fail before mapping ends."""
    resection_max_error_px: float = 12.0
    """Reprojection error of a point that agrees with a new pose; wide, as the model is not yet adjusted to it."""
    resection_min_inliers: int = 30
    """Points that must agree with a new pose."""
    resection_min_inlier_ratio: float = 0.25
    """Share of the visible points that must agree."""
    leftover_min_inliers: int = 15
    """Points that must agree with the pose of an image when no other can be registered any more; it then is held
    against its matches with others and against chance, too. From `resection_min_inliers` on there is no such round."""
    join_min_tracks: int = 20
    """Common tracks that must agree with how one model lies in another, so that both become one."""
    resection_trials: int = 3
    """Attempts for an image; it is tried again only when it sees more points than before."""
    min_observations: int = 10
    """Observations below which an image is taken out of the model again."""
    min_agreeing_share: float = 0.15
    """Share of the model's points on its tracks that an image must agree with, or it is taken out again."""
    triangulation_max_error_px: float = 8.0
    """Reprojection error for a view to join a new point, before adjustment."""
    max_error_px: float = 4.0
    """Reprojection error above which an adjusted observation is dropped."""
    min_angle_deg: float = 1.5
    """Points whose widest pair of rays is narrower are dropped: their depth is not known."""
    local_images: int = 5
    """Neighbours adjusted with a new image."""
    global_growth: float = 1.1
    """Everything is adjusted when images or points have grown by this factor."""
    loss_scale_px: float = 1.0
    """Residual at which the soft-L1 loss of the adjustments turns from squared to linear."""
    principal_point_min_images: int = 5
    """Images that a camera must have for its principal point to be adjusted at the end, held by a prior of 1 % of the
    longer side. With it at the centre, the rotations of fountain-P11 and Herz-Jesus-P8 are wrong by 0.4°."""
    min_model_images: int = 3
    """Later models with fewer images are not kept; the first is."""
    max_models: int = 20
    """Models tried for at most."""
    max_unfoldings: int = 3
    """How often mapping starts anew because two places that look alike were laid on top of each other; 0: never."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            # Not `value <= 0`: NaN must fail, too.
            if not (value > 0 or (field.name == "max_unfoldings" and value == 0)):
                raise ConfigError(f"{field.name} must be positive, got {value}")
        if not self.global_growth > 1:
            raise ConfigError(f"global_growth must be above 1, got {self.global_growth}")
