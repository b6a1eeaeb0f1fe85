"""Which motions of the whole scene priors leave open, and which entries of poses to hold against these.

A small similarity moves the world by x → x + w × x + v + s x, seven numbers (w, v, s), and with it every camera: in
the tangent of `sfm.bundle.prior_terms` by ω = −w and υ = −(w × C + v + s C). A prior sees

    a position       w × p + v + s p, in the coordinates that were measured; a bias gives way, but at a cost
    a direction d    w × d
    a distance       s

and the common null space of what they see is open. An entry of a tangent holds what it would have to move by.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64

from sfm.bundle.priors import DistancePrior, GravityPrior, PointPrior, PositionPrior, Prior
from sfm.core.arrays import FloatArray
from sfm.core.geometry.rotation import skew

_RANK = 1e-6
"""Part of the largest singular value below which a motion counts as unseen: positions on a line leave the roll open."""
_SEES = 1e-9


def open_motions(
    priors: Sequence[Prior | PointPrior], centers: Float64[np.ndarray, "I 3"], points3D: Float64[np.ndarray, "P 3"]
) -> Float64[np.ndarray, "7 m"]:
    """An orthonormal basis of the motions (w, v / size, s) about the mean of the centres that no prior sees.

    The size is the largest distance of a centre from the mean; it balances the three kinds of motion. All seven are
    open where there is no prior.

    Args:
        centers, points3D: in the frame of the priors, at least roughly.
    """
    origin, size = _extent(centers)
    seen = np.concatenate([np.zeros((1, 7)), *(_seen(prior, centers, points3D, origin, size) for prior in priors)])
    # Seven columns: the triangle of a QR decomposition has the same null space.
    _, values, rows = np.linalg.svd(np.linalg.qr(seen, mode="r"))
    rank = int(np.sum(values > _RANK * max(values[0], 1.0)))
    return rows[rank:].T


def entries_to_hold(
    priors: Sequence[Prior | PointPrior], centers: Float64[np.ndarray, "I 3"], points3D: Float64[np.ndarray, "P 3"],
    anchor: Float64[np.ndarray, " 3"], second: Float64[np.ndarray, " 3"] | None,
) -> tuple[Bool[np.ndarray, " 6"], Bool[np.ndarray, " 6"]]:  # fmt: skip
    """Entries of the tangents of two poses to hold so that what the priors leave open stands still.

    First as many entries of the anchor as that takes, then of the translation of the second. Without priors these are
    all six, and the largest along the baseline.

    Args:
        centers, points3D: of all images and points, in the frame of the priors, at least roughly.
        anchor, second: centres of the two poses, of images or of rigs; None if the scene has no second pose, and a
            motion that the anchor does not show stays open then.
    """
    origin, size = _extent(centers)
    basis = open_motions(priors, centers, points3D)
    held = np.zeros((2, 6), bool)
    for k, center in enumerate((anchor, second)):
        if center is None:
            continue
        shown = _moved(center - origin, size) @ basis
        shown[: 3 * k] = 0
        basis = _held_still(basis, shown, held[k])
    return held[0], held[1]


def _extent(centers: FloatArray) -> tuple[FloatArray, float]:
    """Mean of the centres and the largest distance from it, or 1."""
    origin = centers.mean(axis=0)
    return origin, float(np.linalg.norm(centers - origin, axis=1).max()) or 1.0


def _held_still(basis: FloatArray, shown: FloatArray, held: Bool[np.ndarray, " 6"]) -> FloatArray:
    """What is left of the basis when the entries that show the most, one after the other, are held; sets them."""
    while basis.shape[1]:
        sizes = np.linalg.norm(shown, axis=1)
        entry = int(np.argmax(sizes))
        if not sizes[entry] > _SEES:
            break
        held[entry] = True
        # Of the motions, an orthonormal basis of those that leave this entry alone.
        others = np.linalg.svd(shown[entry][None])[2][1:].T
        basis, shown = basis @ others, shown @ others
    return basis


def _moved(center: FloatArray, size: float) -> FloatArray:
    """(6, 7): how (w, v / size, s) move the tangent (ω, υ / size) of a camera at `center` from the origin."""
    moved = np.zeros((6, 7))
    moved[:3, :3] = -np.eye(3)
    moved[3:] = -_displacement(center[None] / size)[0]
    return moved


def _displacement(places: FloatArray) -> FloatArray:
    """(k, 3, 7): how (w, v, s) move points (k, 3)."""
    out = np.zeros((len(places), 3, 7))
    out[:, :, :3], out[:, :, 3:6], out[:, :, 6] = -skew(places), np.eye(3), places
    return out


def _seen(
    prior: Prior | PointPrior, centers: FloatArray, points3D: FloatArray, origin: FloatArray, size: float
) -> FloatArray:
    """Rows (n, 7) of what a group sees. A coordinate that was not measured is where it is now."""
    match prior:
        case PositionPrior() | PointPrior():
            now = centers[prior.images] if isinstance(prior, PositionPrior) else points3D[prior.points]
            measured = np.isfinite(np.einsum("kaa->ka", prior.covariances))
            places = (np.where(measured, prior.positions, now) - origin) / size
            return _displacement(places)[measured]
        case GravityPrior():
            return np.c_[skew(prior.down), np.zeros((3, 4))] * (len(prior.images) > 0)
        case DistancePrior():
            return np.eye(7)[6:] * bool(np.any(prior.distances > 0))
