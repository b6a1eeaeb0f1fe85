"""Two models of one scene that have no image in common, and how one lies in the other.

Models that grew apart still share tracks: some images of a track are in one model, some in the other. Where both give
the track a point, three such points determine the similarity a_from_b between the two worlds. Points are poor judges
of it, since their depths are uncertain where cameras stand close; so it is the observations that judge: the points of
a as the images of b see them, and those of b as the images of a do,

    e = f r × d / |d|    in px,    with r the ray of the observation and d the point in the frame of its camera.

Samples of three points are scored by Σ min(|e|², e_max²), and the best is refined over all observations.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.optimize import least_squares

from sfm.core.arrays import FloatArray
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.similarity import Sim3, estimate_similarity
from sfm.mapping.state import State

_SAMPLES = 300
_MIN_AGREEING_SHARE = 0.5
_LOSS_SCALE_PX = 2.0
_MAX_LOST_SHARE = 0.05
_MIN_COMMON_SHARE = 0.6
"""Points on common tracks that both models must see after adjustment. On thinned graphs of real photos 0.33 to 0.56 of
them do where a join is wrong by 5° or more, and, but for one of 50, 0.64 or more where it is right."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Join:
    """How model b lies in model a, and how many tracks of how many shared ones agree with it."""

    a_from_b: Sim3
    agreeing: int
    shared: int


def find_join(a: State, b: State, max_error_px: float, min_agreeing: int, rng: np.random.Generator) -> Join | Rejected:
    """The similarity between the worlds of two models over the same tracks, if enough of these agree with it."""
    in_a, in_b = _Views.of(a, b), _Views.of(b, a)
    tracks = np.concatenate([in_a.tracks, in_b.tracks])
    shared = len(np.unique(tracks))
    common = np.flatnonzero(a.has_point & b.has_point)
    if shared < min_agreeing or len(common) < 3:
        return Rejected("too_few_common_tracks", f"{shared}, {min_agreeing} needed")

    def residuals(a_from_b: Sim3) -> FloatArray:
        """(n, 3) px."""
        return np.concatenate([in_a.residuals(a_from_b), in_b.residuals(a_from_b.inverse())])

    def score(a_from_b: Sim3) -> float:
        return float(np.minimum(np.square(residuals(a_from_b)).sum(axis=1), max_error_px**2).sum())

    samples = (rng.choice(common, 3, replace=False) for _ in range(_SAMPLES))
    candidates = [estimate_similarity(b.points[sample], a.points[sample]) for sample in samples]
    usable = [candidate for candidate in candidates if isinstance(candidate, Sim3)]
    if not usable:
        return Rejected("no_similarity", f"none of {_SAMPLES} samples of {len(common)} common points gave one")
    best = min(usable, key=score)
    size = np.median(np.linalg.norm(a.points[common] - a.points[common].mean(axis=0), axis=1))
    unit_from_a = Sim3(np.asarray(1 / size), Rotation3.identity(), -a.points[common].mean(axis=0) / size)

    def moved(zeta: FloatArray) -> Sim3:
        return unit_from_a.inverse() @ Sim3.exp(zeta) @ unit_from_a @ best

    found = least_squares(
        lambda zeta: residuals(moved(zeta)).ravel(), np.zeros(7), loss="soft_l1", f_scale=_LOSS_SCALE_PX, max_nfev=50
    )
    best = moved(found.x)
    agrees = np.linalg.norm(residuals(best), axis=1) <= max_error_px
    agreeing = len(np.unique(tracks[agrees]))
    if agreeing < max(min_agreeing, _MIN_AGREEING_SHARE * shared):
        return Rejected("models_disagree", f"{agreeing} of {shared} common tracks agree, {min_agreeing} needed")
    return Join(best, agreeing, shared)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """Points of another model as the images of one see them: columns over the observations."""

    tracks: np.ndarray
    points: np.ndarray
    rays: np.ndarray
    R: np.ndarray
    t: np.ndarray
    focal_px: np.ndarray

    @staticmethod
    def of(model: State, other: State) -> _Views:
        """Of all tracks that have a point in the other model and an observation in this one."""
        scene = model.scene
        rows = np.flatnonzero(model.registered[scene.image] & other.has_point[scene.track_of])
        rows = rows[np.isfinite(model.ray[rows]).all(axis=1)]
        image, tracks = scene.image[rows], scene.track_of[rows]
        focals = np.array([model.camera(row).mean_focal_length for row in range(len(scene.cameras))])
        return _Views(
            tracks, other.points[tracks], model.ray[rows], model.R[image], model.t[image],
            focals[scene.image_camera[image]],
        )  # fmt: skip

    def residuals(self, world_from_other: Sim3) -> FloatArray:
        """(n, 3) px, of the length of the focal length where a point is behind its camera."""
        away = np.einsum("nij,nj->ni", self.R, world_from_other @ self.points) + self.t
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        error = np.cross(self.rays, away)
        behind = np.einsum("ni,ni->n", self.rays, away) <= 0
        error[behind] /= np.maximum(np.linalg.norm(error[behind], axis=1, keepdims=True), 1e-12)
        return self.focal_px[:, None] * error


def merged(a: State, b: State, a_from_b: Sim3) -> State:
    """Both models in the world of a, with its cameras and points where both have them; neither is changed."""
    result = a.copy()
    images = np.flatnonzero(b.registered)
    poses = a_from_b.transform_pose(Rigid3(Rotation3.from_matrix(b.R[images]), b.t[images]))
    result.R[images], result.t[images] = poses.rotation.matrix, poses.translation
    result.registered[images] = True
    only_b = b.has_point & ~a.has_point
    result.points[only_b] = a_from_b @ b.points[only_b]
    result.has_point |= b.has_point
    result.on |= b.on
    used_by_a = set(a.scene.image_camera[a.registered].tolist())
    for camera in sorted(set(a.scene.image_camera[images].tolist()) - used_by_a):
        result.set_camera(camera, b.camera(camera).params)
    return result


def join_doubt(state: State, first: np.ndarray, second: np.ndarray, min_common: int) -> Rejected | None:
    """Why two joined and adjusted models may not belong together; None: they do.

    Args:
        first, second: (I,) which images came from which model.
    """
    scene = state.scene
    lost = int(np.sum((first | second) & ~state.registered))
    if lost > _MAX_LOST_SHARE * min(first.sum(), second.sum()):
        return Rejected("lost_images", f"{lost} images no longer fit where the models are joined")
    reached, seen = (
        _on_both_sides(scene.track_of, rows, first[scene.image], second[scene.image])
        for rows in (state.registered[scene.image], state.on)
    )
    shared, common = int(np.sum(reached & state.has_point)), int(np.sum(seen))
    if common < max(min_common, _MIN_COMMON_SHARE * shared):
        return Rejected("few_common_points", f"{common} of {shared} points on common tracks fit both models")
    return None


def _on_both_sides(track_of: np.ndarray, rows: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Which tracks (T,) have one of these observations in either group of images; all masks are over observations."""
    tracks = int(track_of[-1]) + 1
    return (np.bincount(track_of[rows & first], minlength=tracks) > 0) & (
        np.bincount(track_of[rows & second], minlength=tracks) > 0
    )
