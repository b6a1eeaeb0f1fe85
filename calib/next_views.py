"""Where to hold the board next: of many poses those that would make the camera most certain.

A view of a board at a pose tells  R = A − W H⁻¹ Wᵀ  about the free parameters θ of the camera (its pose eliminated, see
`refine_system`), over the variance σ² of a coordinate. With Σ the covariance of θ so far,

    Σ' = (Σ⁻¹ + R / σ²)⁻¹

is what is left with that view. What counts is the pixel of a fixed point far away when the camera's frame is turned as
suits best: with J = ∂q/∂θ over a grid of pixels, less what a turn explains, the mean of tr(J Σ Jᵀ). The best pose is
taken, then the best beside it that is not nearly the same, and so on. All poses show the whole board.

Reference:
    Kogan, mrcal (documentation): uncertainty of projection as the measure of a calibration, and of a choreography.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from calib.uncertainty import pixel_grid
from sfm.core.arrays import FloatArray, Points2D, Points3D, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3, skew

_PLACES = tuple(itertools.product((-1, 0, 1), repeat=2))
"""Left, middle, right and top, middle, bottom."""
_SIZES = (0.45, 0.7, 0.95)
"""The larger of the parts of the image's width and height that the board takes up."""
_TILTS = (math.radians(25), math.radians(45))
_DIRECTIONS = 8
_MARGIN = 0.02
"""Of the image's width, that stays free around the board."""
_APART = 0.15
"""Of the image's width, rms over corners: less is the same photo once more."""
_ROUNDS = 6
_CAMERA_GRID = 16


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class SuggestedView(Value):
    """A pose of the board, and what it is worth.

    Attributes:
        points2D: (P, 2) where its corners would be seen, px.
        words: where and how to hold it.
        before_px, after_px: rms over the image of the uncertainty of a pixel, one standard deviation of its length,
            without this view (but with those suggested before) and with it.
    """

    cam_from_board: Rigid3
    points2D: Points2D
    words: str
    before_px: float
    after_px: float


def suggest_views(
    camera: Camera, columns: Sequence[int] | np.ndarray, covariance: FloatArray, sigma_px: float, board: Points3D, *,
    count: int = 3, y_up: bool = False,
) -> tuple[SuggestedView, ...]:  # fmt: skip
    """The next views that would help most, the best first; fewer where no more poses fit into the image.

    Args:
        columns: positions of the free parameters.
        covariance: (K, K) of these.
        sigma_px: standard deviation of one coordinate of a corner.
        y_up: the board's y runs up and its z out of the paper, as in an AprilGrid.
    """
    measure = _measure(camera, columns)
    poses, pixels = _candidates(camera, board, y_up)
    if not len(pixels) or not sigma_px > 0:
        return ()
    told = _information(camera, columns, poses, board) / sigma_px**2
    S, chosen, apart = np.asarray(covariance, np.float64), [], np.ones(len(poses), bool)
    while len(chosen) < count and apart.any():
        after = np.linalg.inv(np.linalg.inv(S) + told)
        worth = np.einsum("ij,cji->c", measure, after)
        best = int(np.argmin(np.where(apart, worth, np.inf)))
        before, left = (math.sqrt(max(float(v), 0.0)) for v in (np.sum(measure * S.T), worth[best]))
        words = _in_words(camera, poses[best], board, pixels[best])
        chosen.append(SuggestedView(poses[best], pixels[best], words, before, left))
        S = after[best]
        away = np.sqrt(np.mean(np.sum((pixels - pixels[best]) ** 2, axis=2), axis=1))
        apart &= away > _APART * camera.width
    return tuple(chosen)


def camera_uncertainty(camera: Camera, columns: Sequence[int] | np.ndarray, covariance: FloatArray) -> float:
    """Rms over the image of the uncertainty of a pixel far away, one standard deviation of its length, px."""
    return math.sqrt(max(float(np.sum(_measure(camera, columns) * np.asarray(covariance).T)), 0.0))


def _measure(camera: Camera, columns: Sequence[int] | np.ndarray) -> Float64[np.ndarray, "K K"]:
    """M such that tr(M Σ) is the mean squared length by which pixels move, turns of the frame taken out."""
    pixels, _ = pixel_grid(camera, _CAMERA_GRID)
    rays, valid = camera.unproject(pixels)
    rays = rays[valid]
    _, by_point, by_params, seen = camera.project_with_jacobians(rays)
    J = by_params[seen][:, :, columns].reshape(-1, len(columns))
    turns = (-by_point[seen] @ skew(rays[seen])).reshape(-1, 3)
    J = J - turns @ np.linalg.lstsq(turns, J, rcond=None)[0]
    return J.T @ J / max(len(J) / 2, 1)


def _candidates(camera: Camera, board: Points3D, y_up: bool) -> tuple[list[Rigid3], Float64[np.ndarray, "C P 2"]]:
    """Poses that show the whole board, and its corners there."""
    upright = Rotation3.exp(np.array([np.pi, 0.0, 0.0])) if y_up else Rotation3.identity()
    leans = [Rotation3.identity()]
    for tilt, k in itertools.product(_TILTS, range(_DIRECTIONS)):
        a = 2 * math.pi * k / _DIRECTIONS
        leans.append(Rotation3.exp(tilt * np.array([math.cos(a), math.sin(a), 0.0])))
    poses, pixels = [], []
    for place, size, lean in itertools.product(_PLACES, _SIZES, leans):
        held = _held(camera, board, np.array(place, float), size, lean @ upright)
        if held is not None:
            poses.append(held[0])
            pixels.append(held[1])
    return poses, np.array(pixels).reshape(-1, len(board), 2)


def _held(
    camera: Camera, board: Points3D, place: Vector, size: float, turn: Rotation3
) -> tuple[Rigid3, Points2D] | None:
    """A board of this size at a side, a corner or the middle of the image; None where it cannot be seen there."""
    image = np.array([camera.width, camera.height], float)
    margin, middle = _MARGIN * camera.width, board.mean(axis=0)
    target = image / 2
    distance = float(np.ptp(board[:, :2], axis=0).max()) * camera.mean_focal_length / (size * image.max())
    for last in (*[False] * _ROUNDS, True):
        rays, valid = camera.unproject(target[None])
        if not valid[0]:
            return None
        rotation = _facing(rays[0]) @ turn
        pose = Rigid3(rotation, distance * rays[0] - rotation @ middle)
        pixels, seen = camera.project(pose @ board)
        if not seen.all():
            return None
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        if last:
            inside = np.all(low >= margin / 2) and np.all(high <= image - margin / 2)
            return (pose, pixels) if inside else None
        distance *= float(((high - low) / image).max()) / size
        wanted = np.where(
            place < 0, margin - low, np.where(place > 0, image - margin - high, image / 2 - (low + high) / 2)
        )
        target = np.clip(target + wanted, 0, image)
    return None


def _facing(ray: Vector) -> Rotation3:
    """The shortest turn of the axis onto a ray."""
    axis = np.cross([0.0, 0.0, 1.0], ray)
    sine = float(np.linalg.norm(axis))
    return Rotation3.exp(axis / max(sine, 1e-12) * math.atan2(sine, float(ray[2])))


def _information(
    camera: Camera, columns: Sequence[int] | np.ndarray, poses: Sequence[Rigid3], board: Points3D
) -> Float64[np.ndarray, "C K K"]:
    """What each view tells about the parameters for corners of unit noise, its pose eliminated."""
    points = np.concatenate([pose @ board for pose in poses])
    _, by_point, by_params, _ = camera.project_with_jacobians(points)
    J = by_params[:, :, columns].reshape(len(poses), -1, len(columns))
    P = np.concatenate([-by_point @ skew(points), by_point], axis=2).reshape(len(poses), -1, 6)
    W, H = J.swapaxes(1, 2) @ P, P.swapaxes(1, 2) @ P
    return J.swapaxes(1, 2) @ J - W @ np.linalg.solve(H, W.swapaxes(1, 2))


def _in_words(camera: Camera, pose: Rigid3, board: Points3D, pixels: Points2D) -> str:
    image = np.array([camera.width, camera.height])
    x, y = pixels.mean(axis=0) / image
    low, high = pixels.min(axis=0) / image, pixels.max(axis=0) / image
    across, down = high - low
    # A board that nearly fills the image is at no side of it.
    column = "" if across > 0.8 else "left" if x < 0.4 else "right" if x > 0.6 else ""
    row = "" if down > 0.8 else "top" if y < 0.4 else "bottom" if y > 0.6 else ""
    where = f"at the {' '.join(filter(None, (row, column)))}" if row or column else "in the middle"
    wide = f"{100 * across:.0f} % of the width" if across >= down else f"{100 * down:.0f} % of the height"
    middle = pose @ board.mean(axis=0)[None]
    sight = middle[0] / np.linalg.norm(middle[0])
    tilt = math.degrees(math.acos(min(abs(float(pose.rotation.matrix[:, 2] @ sight)), 1.0)))
    if tilt < 5:
        return f"{where}, over {wide}, facing the camera"
    ranges = np.linalg.norm(pose @ board, axis=1)
    toward = -np.linalg.lstsq(pixels - pixels.mean(axis=0), ranges - ranges.mean(), rcond=None)[0]
    return f"{where}, over {wide}, tilted by {tilt:.0f}° with its {_side(toward)} towards the camera"


def _side(direction: Vector) -> str:
    """Of eight, in the image."""
    names = (
        "right side",
        "bottom right",
        "bottom side",
        "bottom left",
        "left side",
        "top left",
        "top side",
        "top right",
    )
    return names[round(math.atan2(direction[1], direction[0]) / (math.pi / 4)) % 8]
