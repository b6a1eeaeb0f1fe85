"""What is wrong with a calibration, as causes rather than as one number, and what would mend it.

Residuals of a right model are white. Three ways in which they are not tell three causes apart:

    neighbours on the board   corners near one another in a view err alike: the lens model, or corners that are shifted
                              by their surroundings
    one corner of the board   errs as if it lay elsewhere, in space: the board is not as it was designed
    one place in the image    errs alike in all views: the lens model bends another way

The last two are shares of the sum of squares of residuals that a displacement of each corner, or a mean in each cell,
explains. k numbers that are fitted explain k of 2 n white ones by chance; what exceeds that is judged by its standard
deviation, √(2 k) of 2 n.

Reference:
    Kogan, mrcal, A tour of mrcal (documentation): what residuals look like where a lens model does not fit.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64

from calib.refine import Calibration
from calib.uncertainty import CalibrationCovariance, covariance, uncertainty_map
from sfm.core.arrays import FloatArray, Points2D, Value, Vector
from sfm.core.errors import Rejected

_CELLS = 12
"""Of the image's width, for what errs alike at one place of it."""
_CLEAR = 5.0
"""Standard deviations from chance that are told; there are many residuals, and small faults are common."""
_SHARE = 0.1
"""Excess share of the variance that is told: it is a twentieth of the error."""
_FEW_VIEWS = 8
_TILT = math.radians(20.0)
_UNCOVERED = 0.15
"""Share of the image's border, in cells, beyond what any corner covers that is told."""
_VIEW_FACTOR, _VIEW_PX = 2.0, 0.1
"""Times the median error of views, and px, that one is named at."""
_UNCERTAIN_PX = 1.0


@dataclasses.dataclass(frozen=True, slots=True)
class Finding:
    """A cause: a word to count by, what was measured, and what would mend it. The gravest come first."""

    cause: str
    detail: str
    remedy: str


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Whiteness(Value):
    """By how much residuals are alike that should not be; each in excess of chance, with its standard deviation.

    Attributes:
        neighbours: correlation of residuals of corners that are nearest to one another in a view.
        board: share of the variance explained by a displacement of each corner of the board.
        image: share of the variance explained by means over cells of the image.
    """

    neighbours: tuple[float, float]
    board: tuple[float, float]
    image: tuple[float, float]


def whiteness(found: Calibration) -> Whiteness:
    """See the text of the module; shares of fits that absorb white noise come out slightly below zero."""
    residuals, observations = found.residuals, found.observations
    cells = _cells(observations.points2D, found.camera.width, found.camera.height)
    still = np.broadcast_to(np.eye(2), (len(residuals), 2, 2))
    return Whiteness(
        neighbours=_neighbour_correlation(found),
        board=_explained(residuals, _by_board_point(found), observations.rows),
        image=_explained(residuals, still, cells),
    )


def coverage(found: Calibration, across: int = _CELLS) -> Bool[np.ndarray, "Y X"]:
    """Cells of the image in which there is a corner."""
    width, height = found.camera.width, found.camera.height
    down = max(1, round(across * height / width))
    cells = np.zeros(across * down, bool)
    cells[_cells(found.observations.points2D, width, height, across)] = True
    return cells.reshape(down, across)


def board_tilts(found: Calibration) -> tuple[Vector, Vector]:
    """(V,) angles between boards and image, and the directions in the image about which they are tilted, radians."""
    normals = found.cams_from_board.rotation.matrix[:, :, 2]
    normals = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)
    return np.arccos(np.clip(normals[:, 2], -1, 1)), np.arctan2(normals[:, 1], normals[:, 0])


def diagnose(
    found: Calibration, doubts: CalibrationCovariance | Rejected | None = None
) -> tuple[Finding, ...]:  # fmt: skip
    """What is wrong, the gravest first; nothing where nothing was found.

    Args:
        doubts: how uncertain it is; by default by views, or its lower bound where these are too few.
    """
    told = (finding for part in (_solution, _views, _poses, _shape_of_residuals) for finding in part(found))
    return (*told, *_reach(found, _doubts(found) if doubts is None else doubts))


def diagnose_photos(found: Calibration) -> tuple[Finding, ...]:
    """What is wrong with the photos and the board, whatever the camera."""
    return tuple(finding for part in (_views, _poses, _shape_of_residuals) for finding in part(found))


def _solution(found: Calibration) -> Iterator[Finding]:
    if not found.converged:
        yield Finding(
            "not_converged",
            f"after {found.iterations} iterations a step still promises a lower cost",
            f"take a lens model with fewer coefficients than {found.lens}",
        )
    for words in found.fallbacks:
        yield Finding("fallback", words, "add views that are tilted by 15° to 45°, about both axes")
    limit, worst = found.camera.max_angle, _largest_angle_seen(found)
    corner = _angle_of_image_corner(found)
    if corner is None:
        yield Finding(
            "image_corners_have_no_ray",
            f"the distortion turns back at {math.degrees(limit):.0f}°; corners of the board reach "
            f"{math.degrees(worst):.0f}°",
            "show the board in the corners of the image, or take a lens model with fewer coefficients",
        )


def _views(found: Calibration) -> Iterator[Finding]:
    count = len(found.observations)
    if count < _FEW_VIEWS:
        yield Finding("few_views", f"{count} views", "take 15 to 30")
    rms = found.view_rms_px
    for v in np.flatnonzero(rms > max(_VIEW_FACTOR * float(np.median(rms)), _VIEW_PX)):
        yield Finding(
            "outlier_view",
            f"{found.observations.names[v]}: {rms[v]:.2f} px where the median view has {np.median(rms):.2f} px",
            "look at its corners: blur, reflections, a moved board",
        )
    lost = len(found.rejected_corners) / max(len(found.rejected_corners) + len(found.residuals), 1)
    if lost > 0.02:
        yield Finding("many_rejected_corners", f"{100 * lost:.1f} % of them", "look at the views that they are in")


def _poses(found: Calibration) -> Iterator[Finding]:
    tilts, directions = board_tilts(found)
    steep, needed = tilts > _TILT, max(3, math.ceil(0.2 * len(tilts)))
    if np.sum(steep) < needed:
        count = int(np.sum(steep))
        yield Finding(
            "few_tilts",
            f"only {count} of {len(tilts)} boards {'is' if count == 1 else 'are'} tilted by more than "
            f"{math.degrees(_TILT):.0f}°, and {needed} should be",
            "tilt the board by 30° to 45°" if count < len(tilts) else "add photos of the board tilted by 30° to 45°",
        )
    else:
        # Tilts to the left and to the right are about one axis: twice the angle tells them apart from up and down.
        spread = abs(np.mean(np.exp(2j * directions[steep])))
        if spread > 0.9:
            yield Finding(
                "tilts_about_one_axis", "boards lean one way only", "tilt the board about the other axis, too"
            )
    covered = coverage(found)
    border = np.concatenate([covered[0], covered[-1], covered[1:-1, 0], covered[1:-1, -1]])
    bare = 1 - float(np.mean(border))
    if bare > _UNCOVERED:
        yield Finding(
            "uncovered_border",
            f"{100 * bare:.0f} % of the border of the image has never shown a corner, {_bare_sides(covered)}",
            "show the board there, close enough to be cut by the border if it has marks",
        )


def _bare_sides(covered: FloatArray | np.ndarray) -> str:
    sides = {
        "left": covered[:, 0], "right": covered[:, -1], "top": covered[0], "bottom": covered[-1],
    }  # fmt: skip
    return "most of it on the " + max(sides, key=lambda name: float(np.mean(~sides[name])))


def _shape_of_residuals(found: Calibration) -> Iterator[Finding]:
    white = whiteness(found)
    board, image = (share > _SHARE and share > _CLEAR * sigma for share, sigma in (white.board, white.image))
    if board:
        richer = {"flat": "paraboloid or free", "scale": "paraboloid or free", "free": ""}.get(found.shape.kind, "free")
        yield Finding(
            "bent_board",
            f"{100 * white.board[0]:.0f} % of the variance of residuals is corners that lie elsewhere than designed",
            f"let the board's shape be estimated ({richer}), or glue it to glass" if richer else "glue it to glass",
        )
    if image:
        yield Finding(
            "lens_model",
            f"{100 * white.image[0]:.0f} % of the variance of residuals is the same wherever in the image it is seen",
            f"take a lens model with more coefficients than {found.lens}",
        )
    correlation, sigma = white.neighbours
    if not (board or image) and correlation > 2 * _SHARE and correlation > _CLEAR * sigma:
        yield Finding(
            "correlated_corners",
            f"residuals of neighbouring corners are correlated by {correlation:.2f}",
            "standard deviations are too small, take those by views; look for a refinement window that is too large",
        )


def _doubts(found: Calibration) -> CalibrationCovariance | Rejected:
    by_view = covariance(found, by_view=True)
    return covariance(found) if isinstance(by_view, Rejected) else by_view


def _reach(found: Calibration, covariances: CalibrationCovariance | Rejected) -> Iterator[Finding]:
    if isinstance(covariances, Rejected):
        yield Finding(covariances.reason, covariances.detail, f"take a lens model with less than {found.lens} has")
        return
    deviations, pixels = uncertainty_map(found, covariances, across=24)
    worst = float(np.nanmax(deviations)) if np.any(np.isfinite(deviations)) else math.inf
    if worst > _UNCERTAIN_PX:
        u, v = pixels[int(np.nanargmax(deviations))]
        yield Finding(
            "uncertain_corners",
            f"pixels near ({u:.0f}, {v:.0f}) are uncertain by {worst:.1f} px (one standard deviation)",
            "show the board there",
        )


def _largest_angle_seen(found: Calibration) -> float:
    rays, valid = found.camera.unproject(found.observations.points2D)
    return float(np.arccos(np.clip(rays[valid, 2], -1, 1)).max(initial=0.0))


def _angle_of_image_corner(found: Calibration) -> float | None:
    """The largest angle of the image's corners from the axis; None where one of them has no ray.

    A fisheye's circle often ends before the corners: for wide lenses the middles of the sides count.
    """
    w, h = float(found.camera.width), float(found.camera.height)
    corners = np.array([[0, 0], [w, 0], [0, h], [w, h]])
    if found.camera.model_info.is_fisheye:
        return 0.0
    rays, valid = found.camera.unproject(corners)
    return float(np.arccos(rays[:, 2]).max()) if np.all(valid) else None


def _cells(points2D: Points2D, width: int, height: int, across: int = _CELLS) -> np.ndarray:
    """(n,) numbers of cells, row by row."""
    down = max(1, round(across * height / width))
    x = np.clip((points2D[:, 0] / width * across).astype(int), 0, across - 1)
    y = np.clip((points2D[:, 1] / height * down).astype(int), 0, down - 1)
    return y * across + x


def _by_board_point(found: Calibration) -> Float64[np.ndarray, "n 2 3"]:
    """Derivatives of residuals by the place of their corner on the board."""
    observations, poses = found.observations, found.cams_from_board
    view = observations.view_of
    points = np.einsum("nij,nj->ni", poses.rotation.matrix[view], found.shape.points3D[observations.rows])
    _, by_point, _, _ = found.camera.project_with_jacobians(points + poses.translation[view])
    return by_point @ poses.rotation.matrix[view]


def _explained(residuals: FloatArray, J: FloatArray, group: np.ndarray) -> tuple[float, float]:
    """Share of Σ |r|² that the fit of r = J x, an x for each group, takes off, less chance's; its deviation."""
    _, group = np.unique(group, return_inverse=True)
    count, width = group.max(initial=-1) + 1, J.shape[2]
    A, b = np.zeros((count, width, width)), np.zeros((count, width))
    np.add.at(A, group, J.swapaxes(1, 2) @ J)
    np.add.at(b, group, np.einsum("nik,ni->nk", J, residuals))
    total = float(np.sum(residuals**2))
    if total == 0:
        return 0.0, 0.0
    enough = np.bincount(group) * 2 > width
    solved = np.einsum("gjk,gk->gj", np.linalg.pinv(A[enough], rcond=1e-9, hermitian=True), b[enough])
    fitted = width * int(np.sum(enough))
    share = float(np.sum(b[enough] * solved)) / total
    return share - fitted / residuals.size, math.sqrt(2 * fitted) / residuals.size


def _neighbour_correlation(found: Calibration) -> tuple[float, float]:
    """Mean product of the residuals of each corner and the nearest one of its view, over the variance."""
    observations, residuals = found.observations, found.residuals
    products, pairs = 0.0, 0
    for v in range(len(observations)):
        rows = slice(observations.offsets[v], observations.offsets[v + 1])
        points, r = observations.points2D[rows], residuals[rows]
        if len(points) < 2:
            continue
        apart = np.sum((points[:, None] - points[None]) ** 2, axis=2)
        np.fill_diagonal(apart, np.inf)
        products += float(np.sum(r * r[np.argmin(apart, axis=1)]))
        pairs += 2 * len(points)
    variance = float(np.mean(residuals**2))
    if pairs == 0 or variance == 0:
        return 0.0, 0.0
    # Corners that are each other's nearest count twice: at most two of them share a product.
    return products / pairs / variance, math.sqrt(2 / pairs)
