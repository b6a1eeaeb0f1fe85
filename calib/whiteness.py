"""By how much residuals are alike that should not be.

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

import numpy as np
from jaxtyping import Float64

from calib.coverage import cells_of
from calib.refine import Calibration
from sfm.core.arrays import FloatArray, Value


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
    cells = cells_of(observations.points2D, found.camera.width, found.camera.height)
    still = np.broadcast_to(np.eye(2), (len(residuals), 2, 2))
    return Whiteness(
        neighbours=_neighbour_correlation(found),
        board=_explained(residuals, _by_board_point(found), observations.rows),
        image=_explained(residuals, still, cells),
    )


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
