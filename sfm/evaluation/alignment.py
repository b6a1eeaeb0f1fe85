"""The similarity that brings one reconstruction into the frame of another.

Two reconstructions of the same photos agree up to S = (s, R, t), `b_from_a`: with camera k's centre a_k and
b_k, and its poses `cam_from_a`, `cam_from_b`,

    b_k = s R a_k + t        and        R = (R_k^b)ᵀ R_k^a      for every k.

The centres alone fix S as soon as they span a plane: Umeyama's solution, the customary one, which leaves the
rotations as an independent witness. Centres on a line (forward motion, two images) leave the roll about that line
to noise. Then the direction of the line, the scale and the position come from the centres, and the roll from the
rotations: with R₀ the average of the rotations, u_a and u_b the directions of the lines in the two frames,

    R = R₁ R₀,   R₁ the smallest rotation that takes R₀ u_a to u_b,
    s = √(Σ ‖b_k − b̄‖² / Σ ‖a_k − ā‖²)    of the components along the lines,      t = b̄ − s R ā.

Centres that coincide (pure rotation, a single image) fix no scale: R = R₀, s = 1.

R₀ is the geodesic median of the K rotations, Σ ∠(R₀, R_k) → min, by Weiszfeld's iteration from their chordal
mean, the dominant eigenvector of Σ q_k q_kᵀ. Wrong rotations, if fewer than half, hardly move it.

References:
    Umeyama, Least-squares estimation of transformation parameters between two point patterns, PAMI 1991.
    Hartley, Trumpf, Dai & Li, Rotation averaging, IJCV 2013.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from sfm.core.arrays import Mask, Points3D, Value, readonly
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.geometry.similarity import Sim3, estimate_similarity
from sfm.core.robust.alignment import align_robust

LINE_RATIO = 0.02
"""Centres whose spread across their main direction is below this share of the spread along it count as a line.

Centre noise σ turns K cameras of spread w across the line about it by σ / (w √K) radians: at 2 % and a position
accuracy of 1/1000 of the length this is a degree for ten cameras, more than their rotations err by.
"""

_COINCIDENT = 1e-9


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Alignment(Value):
    """`b_from_a`, and how it came about.

    Attributes:
        method: `centers`, `robust_centers`, `line_and_rotations` or `rotations` (scale not defined, 1).
        inliers: (K,) the cameras that were used.
    """

    b_from_a: Sim3
    method: str
    inliers: Mask

    def __post_init__(self) -> None:
        object.__setattr__(self, "inliers", readonly(self.inliers, (None,), np.bool_))


def average_rotation(rotations: Rotation3, *, iterations: int = 50) -> Rotation3:
    """The geodesic median of a batch (K,) of rotations.

    Raises:
        ValueError: the batch is empty.
    """
    if rotations.shape == () or len(rotations) == 0:
        raise ValueError("expected a batch of at least one rotation")
    q = rotations.wxyz
    median = Rotation3(np.linalg.eigh(q.T @ q)[1][:, -1])
    for _ in range(iterations):
        steps = (rotations @ median.inverse()).log()
        lengths = np.linalg.norm(steps, axis=1)
        weights = 1 / np.maximum(lengths, 1e-9)
        step = (weights[:, None] * steps).sum(0) / weights.sum()
        median = Rotation3.exp(step) @ median
        if np.linalg.norm(step) < 1e-12:
            break
    return median


def align_poses(
    cams_from_a: Rigid3,
    cams_from_b: Rigid3,
    *,
    max_error: float | None = None,
    rng: np.random.Generator | None = None,
) -> Alignment | Rejected:
    """The similarity `b_from_a` between two sets of poses (K,) of the same images, row by row.

    Args:
        max_error: in units of b; if given, centres farther off than this are outliers and do not take part.
        rng: for the samples of the robust estimate.
    Raises:
        ValueError: the batches differ in length, or `max_error` is given without `rng`.
    """
    if len(cams_from_a) != len(cams_from_b):
        raise ValueError(f"{len(cams_from_a)} poses against {len(cams_from_b)}")
    if len(cams_from_a) == 0:
        return Rejected("too_few_images", "no image in common")
    centers_in_a, centers_in_b = cams_from_a.center, cams_from_b.center
    everyone = np.ones(len(cams_from_a), dtype=bool)
    rank = min(_rank(centers_in_a), _rank(centers_in_b))
    if rank >= 2 and max_error is not None:
        if rng is None:
            raise ValueError("the robust alignment needs a generator")
        return _align_robust(centers_in_a, centers_in_b, max_error, rng)
    if rank >= 2:
        b_from_a = estimate_similarity(centers_in_a, centers_in_b)
        return Alignment(b_from_a, "centers", everyone) if not isinstance(b_from_a, Rejected) else b_from_a
    rotation = average_rotation(cams_from_b.rotation.inverse() @ cams_from_a.rotation)
    if rank == 1:
        return Alignment(_align_lines(centers_in_a, centers_in_b, rotation), "line_and_rotations", everyone)
    translation = centers_in_b.mean(0) - rotation @ centers_in_a.mean(0)
    return Alignment(Sim3(np.ones(()), rotation, translation), "rotations", everyone)


def _rank(centers: Points3D) -> int:
    """0 for coincident centres, 1 for centres on a line, 2 otherwise."""
    spread = np.linalg.svd(centers - centers.mean(0), compute_uv=False)
    if spread[0] <= _COINCIDENT * max(1.0, float(np.abs(centers).max())):
        return 0
    return 1 if len(centers) < 3 or spread[1] < LINE_RATIO * spread[0] else 2


def _align_lines(centers_in_a: Points3D, centers_in_b: Points3D, rotation: Rotation3) -> Sim3:
    """The similarity of centres on a line, its roll taken from `rotation`, an estimate of `b_from_a`."""
    mean_a, mean_b = centers_in_a.mean(0), centers_in_b.mean(0)
    a, b = centers_in_a - mean_a, centers_in_b - mean_b
    line_a, line_b = np.linalg.svd(a)[2][0], np.linalg.svd(b)[2][0]
    along_a, along_b = a @ line_a, b @ line_b
    if along_a @ along_b < 0:  # the sign of a singular vector is arbitrary; the order of the cameras is not
        line_b, along_b = -line_b, -along_b
    r = _smallest_rotation(rotation @ line_a, line_b) @ rotation
    s = np.sqrt(np.square(along_b).sum() / np.square(along_a).sum())
    return Sim3(s, r, mean_b - s * (r @ mean_a))


def _smallest_rotation(direction: np.ndarray, target: np.ndarray) -> Rotation3:
    """The rotation of least angle that takes one unit vector to another; about any axis where they are opposite."""
    axis, w = np.cross(direction, target), 1.0 + float(direction @ target)
    if w < 1e-12:
        axis, w = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))]), 0.0
    return Rotation3(np.array([w, *axis]))


def _align_robust(
    centers_in_a: Points3D, centers_in_b: Points3D, max_error: float, rng: np.random.Generator
) -> Alignment | Rejected:
    found = align_robust(centers_in_a, centers_in_b, max_error, rng=rng)
    if isinstance(found, Rejected):
        return found
    b_from_a, inliers = found
    return Alignment(b_from_a, "robust_centers", inliers)
