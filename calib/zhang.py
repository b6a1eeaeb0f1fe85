"""A first camera and first poses from photos of a flat board, in closed form.

A board point (x, y, 0) goes to  H (x, y, 1)ᵀ ~ K [r1 r2 t] (x, y, 1)ᵀ.  As r1 and r2 are orthonormal, ω = (K Kᵀ)⁻¹
obeys

    h1ᵀ ω h2 = 0        h1ᵀ ω h1 = h2ᵀ ω h2

two linear equations a view. Without skew, in pixels shifted to the principal point's first guess and scaled to about 1,
ω ∝ [[a, 0, d], [0, b, e], [d, e, c]] has four degrees of freedom, so two views in general position are enough. Boards
that are parallel to one another give the same equations over again; a board parallel to the image plane says nothing
but fx = fy. The second smallest singular value of the equations tells, and then fewer unknowns are asked for, one rung
of a ladder after the other:

    1. fx, fy, cx, cy        2. fx, fy with the centre of the image        3. one f        4. focal lengths are tried

The last needs no perspective image: rays of a trial lens fit a homography if it is the right one. Wide lenses start
there.

Reference:
    Zhang, A flexible new technique for camera calibration, PAMI 2000.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np

from calib import _zhang_kernels as kernels
from calib.refine_lenses import Lens
from calib.refine_views import Observations
from sfm.core.arrays import BoolArray, FloatArray, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.errors import Rejected

_Solver: TypeAlias = Callable[[FloatArray], tuple[float, float, float, float] | str]
Rung: TypeAlias = Literal["closed_form", "centred", "one_focal", "tried", "given"]

_SMALLEST, _LARGEST = 0.2, 20.0
"""Focal lengths over the longer side that are believed."""
_FARTHEST = 0.5
"""Principal point from the image's centre, over its width and height, that is believed."""
_SINGULAR = 1e-3
"""Second smallest singular value of the equations over the largest, below which there are two solutions."""
_TRIALS = np.geomspace(0.15, 6.0, 24)
"""Focal lengths over the longer side that are tried: steps of 17 %."""
_VIEWS_TRIED = 12
_ROBUST_PASSES = 12
_ENOUGH, _ENOUGH_OF_MANY, _MANY_VIEWS = 9, 6, 60
"""Corners that a first pose is taken from, and where there are many views: the rays of nine would take a quarter of the
time, and the steps that follow are the same."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Start(Value):
    """A first camera, and by which rung of the ladder it was found."""

    camera: Camera
    rung: Rung
    detail: str = ""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Homographies(Value):
    """(V, 3, 3) board → px, positive at the board's centre; NaN where a view has none; and rms errors (V,) in px.

    `spreads` (V,) are the root mean squared distances of a view's corners from their mean, px.
    """

    matrices: FloatArray
    errors: Vector
    spreads: Vector


def fit_view_homographies(observations: Observations, *, robust: bool = False) -> Homographies:
    """The homography of each view; robust ones minimise about the sum of absolute errors."""
    count = len(observations)
    matrices, errors, spreads = np.empty((count, 3, 3)), np.empty(count), np.empty(count)
    kernels.fit_homographies(
        observations.offsets, observations.rows, observations.board, observations.points2D,
        np.ones(len(observations.rows), bool), _ROBUST_PASSES if robust else 1, matrices, errors, spreads,
    )  # fmt: skip
    return Homographies(matrices, errors, spreads)


def find_start(
    observations: Observations, homographies: Homographies, lens: Lens, focal_px: float | None = None
) -> Start | Rejected:
    """A first camera without distortion.

    Args:
        homographies: of these views.
        focal_px: if given, it is taken and nothing else is tried.
    Returns:
        `undetermined_focal` where no rung of the ladder holds.
    """
    width, height = observations.width, observations.height
    if focal_px is not None:
        return Start(lens.camera(width, height, focal_px, focal_px, width / 2, height / 2), "given")
    if lens.start == "perspective":
        found = intrinsics_from_homographies(homographies.matrices, width, height)
        if not isinstance(found, Rejected):
            (fx, fy, cx, cy), rung, detail = found
            return Start(lens.camera(width, height, fx, fy, cx, cy), rung, detail)
    return _try_focal_lengths(observations, lens)


def intrinsics_from_homographies(
    matrices: FloatArray, width: int, height: int
) -> tuple[tuple[float, float, float, float], Rung, str] | Rejected:
    """fx, fy, cx, cy in px from homographies (V, 3, 3), the rung that held, and why not a higher one.

    Returns:
        `undetermined_focal` where no rung holds, with the reasons in words.
    """
    scale = max(width, height) / 2
    to_unit = np.array([[1 / scale, 0, -width / 2 / scale], [0, 1 / scale, -height / 2 / scale], [0, 0, 1]])
    H = to_unit @ matrices[np.isfinite(matrices).all((1, 2))]
    if not len(H):
        return Rejected("undetermined_focal", "no view has a homography")
    # Columns belong together: with the norm of both as unit, each view weighs the same.
    H = H / np.sqrt(np.sum(H[:, :, :2] ** 2, axis=(1, 2)))[:, None, None]
    equations, reasons = _equations(H), []
    rungs: tuple[tuple[Rung, _Solver], ...] = (
        ("closed_form", _solve_all), ("centred", _solve_two), ("one_focal", _solve_one),
    )  # fmt: skip
    for rung, solve in rungs:
        found = solve(equations)
        if isinstance(found, str):
            reasons.append(found)
            continue
        fx, fy, cx, cy = (scale * value for value in found)
        reason = _implausible(fx, fy, cx, cy, width, height)
        if not reason:
            return (fx, fy, cx + width / 2, cy + height / 2), rung, "; ".join(reasons)
        reasons.append(reason)
    return Rejected("undetermined_focal", "; ".join(reasons))


def centred_focal_lengths(matrices: FloatArray, width: int, height: int) -> tuple[float, float] | None:
    """fx, fy in px from homographies (V, 3, 3) if the principal point is the image's centre; None if not believed.

    Each pair of orthogonal directions of a board, along its sides and along its diagonals, gives an equation of unit
    directions, so that boards seen from afar weigh as much as those nearby. This is where OpenCV starts from.
    """
    to_centre = np.array([[1.0, 0, -width / 2], [0, 1.0, -height / 2], [0, 0, 1]])
    H = to_centre @ matrices[np.isfinite(matrices).all((1, 2))]
    x, y = H[:, :, 0], H[:, :, 1]
    pairs = np.stack([np.stack([x, y]), np.stack([x + y, x - y])])
    one, other = (pairs / np.linalg.norm(pairs, axis=3, keepdims=True)).swapaxes(0, 1).reshape(2, -1, 3)
    products = one * other
    found, _, rank, _ = np.linalg.lstsq(products[:, :2], -products[:, 2], rcond=None)
    if rank < 2 or not np.all(found > 0):
        return None
    fx, fy = (1 / np.sqrt(found)).tolist()
    return None if _implausible(fx, fy, 0.0, 0.0, width, height) else (fx, fy)


def poses_of_views(
    observations: Observations, camera: Camera, *, robust: bool = False
) -> tuple[FloatArray, FloatArray, Vector]:
    """Rotations (V, 3, 3), translations (V, 3) `cam_from_board` and the rms of tangents of angular errors (V,).

    All are NaN for a view with too few corners, or whose corners have no ray. Of views with many corners only some are
    taken unless it must be `robust`.
    """
    if not robust:
        observations = _thinned(observations)
    rays, used = camera.unproject(observations.points2D)
    count = len(observations)
    rotations, translations, errors = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty(count)
    kernels.poses_from_rays(
        observations.offsets, observations.rows, observations.board, rays, used, _ROBUST_PASSES if robust else 1,
        rotations, translations, errors,
    )  # fmt: skip
    return rotations, translations, errors


def _thinned(observations: Observations) -> Observations:
    """A few corners of each view, in steps of the golden section so that they lie on no line."""
    counts = np.diff(observations.offsets)
    enough = _ENOUGH if len(counts) <= _MANY_VIEWS else _ENOUGH_OF_MANY
    if counts.max(initial=0) <= enough:
        return observations
    kept = np.zeros(len(observations.rows), bool)
    turns = np.arange(enough) * 0.6180339887498949 % 1.0
    steps = observations.offsets[:-1, None] + (turns * counts[:, None]).astype(int)
    kept[steps[counts > 0].ravel()] = True
    return observations.of_corners(kept)


def largest_angle_between(normals: FloatArray, mask: BoolArray | None = None) -> float:
    """The largest angle in radians between any two of the unit vectors (V, 3)."""
    n = normals if mask is None else normals[mask]
    return float(np.arccos(np.clip((n @ n.T).min(initial=1.0), -1.0, 1.0)))


def _equations(H: FloatArray) -> FloatArray:
    """(V, 2, 5) rows by (a, b, c, d, e)."""

    def products(g: FloatArray, h: FloatArray) -> FloatArray:
        return np.stack(
            [
                g[:, 0] * h[:, 0],
                g[:, 1] * h[:, 1],
                g[:, 2] * h[:, 2],
                g[:, 0] * h[:, 2] + g[:, 2] * h[:, 0],
                g[:, 1] * h[:, 2] + g[:, 2] * h[:, 1],
            ],
            -1,
        )

    h1, h2 = H[:, :, 0], H[:, :, 1]
    return np.stack([products(h1, h2), products(h1, h1) - products(h2, h2)], 1)


def _solve_all(equations: FloatArray) -> tuple[float, float, float, float] | str:
    A = equations.reshape(-1, 5)
    if len(A) < 4:
        return "one view does not determine fx, fy, cx and cy"
    squares, vectors = np.linalg.eigh(A.T @ A)
    ratio = math.sqrt(max(squares[1], 0.0) / squares[4])
    if not ratio > _SINGULAR:
        return f"boards are nearly parallel or tilted about one axis only (singular values {ratio:.1e})"
    a, b, c, d, e = vectors[:, 0] * np.sign(vectors[0, 0])
    rest = c - d * d / a - e * e / b if a > 0 and b > 0 else -1.0
    if not rest > 0:
        return "the closed form has no real solution"
    return math.sqrt(rest / a), math.sqrt(rest / b), -d / a, -e / b


def _solve_two(equations: FloatArray) -> tuple[float, float, float, float] | str:
    A = equations.reshape(-1, 5)
    x, _, _, s = np.linalg.lstsq(A[:, :2], -A[:, 2], rcond=None)
    if not (s[1] > _SINGULAR * s[0] and np.all(x > 0)):
        return "fx and fy are not determined even with the principal point at the centre"
    return 1 / math.sqrt(x[0]), 1 / math.sqrt(x[1]), 0.0, 0.0


def _solve_one(equations: FloatArray) -> tuple[float, float, float, float] | str:
    A = equations.reshape(-1, 5)
    by_inverse, rest = A[:, 0] + A[:, 1], A[:, 2]
    x = -float(by_inverse @ rest) / max(float(by_inverse @ by_inverse), 1e-300)
    if not x > 0:
        return "no focal length explains the views"
    return 1 / math.sqrt(x), 1 / math.sqrt(x), 0.0, 0.0


def _implausible(fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> str:
    longer = max(width, height)
    if not (_SMALLEST * longer < min(fx, fy) and max(fx, fy) < _LARGEST * longer):
        return f"focal lengths {fx:.0f} and {fy:.0f} px are not believed"
    if not 0.5 < fx / fy < 2.0:
        return f"focal lengths {fx:.0f} and {fy:.0f} px differ too much"
    if abs(cx) > _FARTHEST * width or abs(cy) > _FARTHEST * height:
        return f"the principal point would be {cx:.0f}, {cy:.0f} px from the centre"
    return ""


def _try_focal_lengths(observations: Observations, lens: Lens) -> Start | Rejected:
    """The trial focal length whose rays fit homographies best, in px, by some corners of some views."""
    width, height = observations.width, observations.height
    some = np.unique(np.linspace(0, len(observations) - 1, _VIEWS_TRIED).astype(int)).tolist()
    views, best = _thinned(observations.of_views(some)), (math.inf, 0.0)
    for focal in _TRIALS * max(width, height):
        camera = lens.camera(width, height, focal, focal, width / 2, height / 2)
        R, t, errors = poses_of_views(views, camera)
        if np.isfinite(errors).all():
            best = min(best, (_pixel_error(views, camera, R, t), float(focal)))
    if not math.isfinite(best[0]):
        return Rejected("undetermined_focal", "no focal length explains the views")
    focal = best[1]
    return Start(lens.camera(width, height, focal, focal, width / 2, height / 2), "tried")


def _pixel_error(observations: Observations, camera: Camera, R: FloatArray, t: FloatArray) -> float:
    """Median distance in px of corners from where poses put them; what is not seen is infinitely far."""
    view = observations.view_of
    points = np.einsum("nij,nj->ni", R[view], observations.board[observations.rows]) + t[view]
    pixels, valid = camera.project(points)
    distances = np.where(valid, np.linalg.norm(pixels - observations.points2D, axis=1), np.inf)
    return float(np.median(distances))
