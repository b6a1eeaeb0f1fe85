"""Rows of COLMAP's tables to values and back; blobs are packed little-endian arrays in row order."""

from __future__ import annotations

from typing import Any

import numpy as np

from sfm.core.cameras import Camera
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import DescriptorKind, PairKind, TwoViewGeometry
from sfm.io.colmap_tables import colmap_model

UNDEFINED_KIND = 0
UNDEFINED_FEATURE = -1
"""What imported features are that COLMAP knows nothing of; mostly SIFT of other programs."""
# COLMAP's kinds beyond ours: 8, several geometries at once, and 9, calibrated through a rig.
_FOREIGN_KINDS = {8: PairKind.UNCALIBRATED, 9: PairKind.CALIBRATED}


def camera_row(camera: Camera) -> tuple[Any, ...]:
    prior = int(camera.has_prior_focal_length)
    return colmap_model(camera).model_id, camera.width, camera.height, camera.params.astype("<f8").tobytes(), prior


def array(blob: bytes | None, dtype: Any, shape: tuple[int, ...] = (-1,)) -> np.ndarray:
    return np.frombuffer(blob or b"", np.dtype(dtype).newbyteorder("<")).reshape(shape)


def indices(rows: int, columns: int, blob: bytes | None) -> np.ndarray:
    return array(blob, np.uint32, (rows, columns)).view("<i4")


def index_blob(indices: np.ndarray) -> bytes | None:
    return indices.astype("<u4").tobytes() if len(indices) else None


def scales_and_orientations(keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    columns = keypoints.shape[1]
    if columns == 4:
        return keypoints[:, 2], keypoints[:, 3]
    if columns == 2:
        return np.zeros(len(keypoints), np.float32), np.zeros(len(keypoints), np.float32)
    a11, a12, a21, a22 = keypoints[:, 2:].T
    return (np.hypot(a11, a21) + np.hypot(a12, a22)) / 2, np.arctan2(a21, a11)


def descriptor_kind(number: int) -> DescriptorKind:
    if number == UNDEFINED_FEATURE:
        return DescriptorKind.SIFT
    try:
        return DescriptorKind(number)
    except ValueError as error:
        raise ValueError(f"they are of type {number}, which Parallax does not know") from error


def _matrix_blob(matrix: np.ndarray | None) -> bytes | None:
    return None if matrix is None else matrix.astype("<f8").tobytes()


def _matrix(blob: bytes | None) -> np.ndarray | None:
    return array(blob, np.float64, (3, 3)) if blob else None


def geometry_row(geometry: TwoViewGeometry) -> tuple[Any, ...]:
    pose = geometry.cam2_from_cam1
    return (
        len(geometry),
        index_blob(geometry.matches),
        int(geometry.kind),
        _matrix_blob(geometry.F),
        _matrix_blob(geometry.E),
        _matrix_blob(geometry.H),
        _matrix_blob(None if pose is None else pose.rotation.wxyz),
        _matrix_blob(None if pose is None else pose.translation),
    )


def geometry(
    config: int, rows: int, columns: int, blob: bytes | None,
    F: bytes | None, E: bytes | None, H: bytes | None, qvec: bytes | None, tvec: bytes | None,
    tri_angle: float | None, reason: str | None, detail: str | None,
) -> TwoViewGeometry | Rejected:  # fmt: skip
    if config == UNDEFINED_KIND or not rows:
        return Rejected(reason or "no_geometry", detail or "")
    kind = _FOREIGN_KINDS.get(config) or PairKind(config)
    pose = None
    if qvec and tvec:
        pose = Rigid3(Rotation3(array(qvec, np.float64, (4,))), array(tvec, np.float64, (3,)))
    return TwoViewGeometry(
        kind, indices(rows, columns, blob), pose, _matrix(E), _matrix(F), _matrix(H), tri_angle or 0.0
    )
