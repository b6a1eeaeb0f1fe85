"""What a rig means for stereo: how far partners lie from each other's epipolar line, and from the same row.

A point that camera 1 sees along the ray r₁ lies in a plane that contains both cameras. Its normal in camera 2 is
n = t × R r₁, and r₂ should be perpendicular to it. Of a lens with distortion the plane's image is a curve; the distance
of the pixel p₂ from it is, to first order,

    (n · r₂) / |∂(n · r₂)/∂p₂|,        ∂r/∂p = J⁺,  the pseudoinverse of J = ∂p/∂r

as J takes no notice of the length of r. Both pixels are judged so, each by the curve of the other.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from calib.rig_result import RigCalibration
from sfm.core.arrays import FloatArray, Points2D, Rays, Value, Vector
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3

_LEAST_COSINE = 0.17
"""Rays farther than 80° from the rectified axis have no place in a perspective image that anybody would compute."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class EpipolarErrors(Value):
    """Of the corners that two cameras saw in the same frames.

    Attributes:
        frames, corners: how many.
        rms_px, worst_px: distances of pixels from the epipolar lines of their partners.
        vertical_px: rms difference of the rows of partners in perspective images rectified to the mean focal length;
            NaN where the cameras see too far apart for such images.
    """

    camera1: int
    camera2: int
    frames: int
    corners: int
    rms_px: float
    worst_px: float
    vertical_px: float


def epipolar_errors(found: RigCalibration, camera1: int, camera2: int) -> EpipolarErrors | None:
    """Of two cameras by their positions in the rig; None where they saw no corner together."""
    pixels1, pixels2, frames = _partners(found, camera1, camera2)
    if not len(pixels1):
        return None
    motion = found.cams_from_rig[camera2] @ found.cams_from_rig[camera1].inverse()
    one, two = found.cameras[camera1], found.cameras[camera2]
    rays1, valid1 = one.unproject(pixels1)
    rays2, valid2 = two.unproject(pixels2)
    both = valid1 & valid2
    rays1, rays2 = rays1[both], rays2[both]
    apart = np.concatenate(
        [distances_from_curves(two, rays1, rays2, motion), distances_from_curves(one, rays2, rays1, motion.inverse())]
    )
    apart = np.where(np.isfinite(apart), apart, 0.0)
    return EpipolarErrors(
        camera1, camera2, frames, int(both.sum()), math.sqrt(float(np.mean(apart**2))), float(np.abs(apart).max()),
        _row_difference(one, two, rays1, rays2, motion),
    )  # fmt: skip


def distances_of_partners(found: RigCalibration, camera1: int, camera2: int) -> tuple[Points2D, Vector]:
    """(n, 2) pixels in camera 2, and their signed distances (n,) from the curves of their partners in camera 1, px."""
    pixels1, pixels2, _ = _partners(found, camera1, camera2)
    rays1, valid1 = found.cameras[camera1].unproject(pixels1)
    rays2, valid2 = found.cameras[camera2].unproject(pixels2)
    both = valid1 & valid2
    motion = found.cams_from_rig[camera2] @ found.cams_from_rig[camera1].inverse()
    apart = distances_from_curves(found.cameras[camera2], rays1[both], rays2[both], motion)
    known = np.isfinite(apart)
    return pixels2[both][known], apart[known]


def distances_from_curves(camera2: Camera, rays1: Rays, rays2: Rays, cam2_from_cam1: Rigid3) -> Vector:
    """(N,) px, signed, of the pixels of `rays2` from the epipolar curves of `rays1`."""
    normals = np.cross(cam2_from_cam1.translation, cam2_from_cam1.rotation @ rays1)
    _, by_ray, _, _ = camera2.project_with_jacobians(rays2)
    slopes = np.einsum("ni,nij->nj", normals, np.linalg.pinv(by_ray))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sum(normals * rays2, axis=1) / np.linalg.norm(slopes, axis=1)


def _partners(found: RigCalibration, camera1: int, camera2: int) -> tuple[Points2D, Points2D, int]:
    """Pixels of the same corner in the same frame, and the number of frames."""
    keys, pixels = [], []
    count = len(found.shape.given)
    for c in (camera1, camera2):
        seen = found.observations.cameras[c]
        keys.append(found.observations.frame_of[c][seen.view_of] * count + seen.rows)
        pixels.append(seen.points2D)
    common, at1, at2 = np.intersect1d(keys[0], keys[1], return_indices=True)
    return pixels[0][at1], pixels[1][at2], len(np.unique(common // count))


def _row_difference(one: Camera, two: Camera, rays1: Rays, rays2: Rays, motion: Rigid3) -> float:
    """Rms, px, in the perspective images whose x is along the baseline and whose z is between both axes."""
    rotation1 = _rectifying(motion)
    rows = []
    for rays, turn in ((rays1, rotation1), (rays2, rotation1 @ motion.rotation.matrix.T)):
        turned = rays @ turn.T
        if turned[:, 2].min() < _LEAST_COSINE:
            return math.nan
        rows.append(turned[:, 1] / turned[:, 2])
    focal = (one.mean_focal_length + two.mean_focal_length) / 2
    return focal * math.sqrt(float(np.mean((rows[0] - rows[1]) ** 2)))


def _rectifying(cam2_from_cam1: Rigid3) -> FloatArray:
    """Rows are the axes of the rectified frame in that of camera 1."""
    x = np.array(cam2_from_cam1.inverse().translation)
    axes = np.array([0.0, 0.0, 1.0]) + cam2_from_cam1.rotation.matrix[2]
    x = x / np.linalg.norm(x)
    z = axes - (axes @ x) * x
    z = z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])
