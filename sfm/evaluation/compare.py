"""Comparing a model with a reference, image by image and pair by pair.

Images are matched by name; names that only one side puts into folders match by their last part, where that is
unique on both sides. Every image of the reference counts: those that the model lacks are failures in the
pairwise scores, which is why each is given twice, over all pairs and over those of registered images.
"""

from __future__ import annotations

import dataclasses
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from sfm.core.arrays import FloatArray, Indices, Value, Vector, readonly
from sfm.core.errors import Rejected
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Reconstruction
from sfm.evaluation.accuracy import THRESHOLDS_DEG, area_under_recall, mean_average_accuracy
from sfm.evaluation.alignment import Alignment, align_poses
from sfm.evaluation.pose_errors import (
    RelativePoseErrors,
    absolute_pose_errors,
    relative_pose_errors,
    trajectory_errors,
)

SHORT_BASELINE = 1e-4
"""Share of the reference's extent below which a baseline has no direction; at 10 m it is the 1 mm of ETH3D's truth."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class PoseComparison(Value):
    """How far a model's poses are from a reference's.

    Lengths are in units of the reference; the per-image columns (K,) follow `names`, which are the reference's.

    Attributes:
        names: images that both have.
        missing: images of the reference that the model lacks; extra: images of the model that the reference lacks.
        alignment: of the model to the reference; or why there is none (then the absolute errors are NaN).
        rotation_error_deg, position_error: (K,) after the alignment.
        step_rotation_error_deg, step_translation_error: RPE of neighbours in the order of the names.
        relative: of all ordered pairs of images of the reference.
    """

    names: tuple[str, ...]
    missing: tuple[str, ...]
    extra: tuple[str, ...]
    alignment: Alignment | Rejected
    rotation_error_deg: Vector
    position_error: Vector
    step_rotation_error_deg: FloatArray
    step_translation_error: FloatArray
    relative: RelativePoseErrors

    def __post_init__(self) -> None:
        for name in ("rotation_error_deg", "position_error"):
            object.__setattr__(self, name, readonly(getattr(self, name), (len(self.names),)))
        for name in ("step_rotation_error_deg", "step_translation_error"):
            object.__setattr__(self, name, readonly(getattr(self, name), (None,)))

    @property
    def absolute_trajectory_error(self) -> float:
        """ATE: the root mean square of the position errors, in units of the reference."""
        return _root_mean_square(self.position_error)

    @property
    def registered_error_deg(self) -> Vector:
        """The pair errors without those of missing images."""
        return self.relative.error_deg[np.isfinite(self.relative.error_deg)]

    def auc(self, *, registered_only: bool = False) -> dict[float, float]:
        """AUC in [0, 1] of the pair errors by threshold in degrees (see `sfm.evaluation.accuracy`)."""
        errors = self.registered_error_deg if registered_only else self.relative.error_deg
        return dict(zip(THRESHOLDS_DEG, area_under_recall(errors).tolist(), strict=True))

    def to_json(self) -> dict[str, Any]:
        """Everything as plain JSON values, in degrees and units of the reference; what is undefined is None."""
        return {
            "images": {
                "reference": len(self.names) + len(self.missing),
                "registered": len(self.names),
                "missing": list(self.missing),
                "extra": list(self.extra),
            },
            "alignment": _alignment_json(self.alignment),
            "rotation_error_deg": _summary(self.rotation_error_deg),
            "position_error": _summary(self.position_error),
            "ate_rmse": _number(self.absolute_trajectory_error),
            "rpe": {
                "rotation_deg_rmse": _number(_root_mean_square(self.step_rotation_error_deg)),
                "translation_rmse": _number(_root_mean_square(self.step_translation_error)),
            },
            "relative_pose": {
                "pairs": len(self.relative.error_deg),
                "median_error_deg": _number(_median(self.registered_error_deg)),
                "auc_deg": {f"{limit:g}": _number(value) for limit, value in self.auc().items()},
                "auc_deg_registered": {
                    f"{limit:g}": _number(value) for limit, value in self.auc(registered_only=True).items()
                },
                "maa_10deg": _number(mean_average_accuracy(self.relative.error_deg)),
            },
            "per_image": [
                {"name": name, "rotation_error_deg": _number(rotation), "position_error": _number(position)}
                for name, rotation, position in zip(
                    self.names, self.rotation_error_deg.tolist(), self.position_error.tolist(), strict=True
                )
            ],
        }


def compare_models(
    model: Reconstruction,
    reference: Reconstruction,
    *,
    max_error: float | None = None,
    min_baseline: float | None = None,
    rng: np.random.Generator | None = None,
) -> PoseComparison:
    """Pose errors of `model`, taking `reference` for the truth.

    Args:
        max_error: in units of the reference; if given, the alignment ignores images that are farther off.
        min_baseline: in units of the reference; pairs with a shorter true baseline count by their rotation alone.
            By default `SHORT_BASELINE` of the diagonal of the box around the reference's cameras.
        rng: needed with `max_error`.
    """
    rows, true_rows = match_names(model.image_names, reference.image_names)
    poses, true_poses = model.cams_from_world[rows], reference.cams_from_world[true_rows]
    alignment = align_poses(poses, true_poses, max_error=max_error, rng=rng)
    if isinstance(alignment, Rejected):
        undefined = np.full(len(rows), np.nan)
        absolute = undefined, undefined
        steps = (np.full(max(0, len(rows) - 1), np.nan),) * 2
    else:
        aligned = alignment.b_from_a.transform_pose(poses)
        absolute = absolute_pose_errors(aligned, true_poses)
        steps = trajectory_errors(aligned, true_poses)
    known = set(true_rows.tolist())
    matched = set(rows.tolist())
    return PoseComparison(
        names=tuple(reference.image_names[row] for row in true_rows),
        missing=tuple(name for row, name in enumerate(reference.image_names) if row not in known),
        extra=tuple(name for row, name in enumerate(model.image_names) if row not in matched),
        alignment=alignment,
        rotation_error_deg=absolute[0],
        position_error=absolute[1],
        step_rotation_error_deg=steps[0],
        step_translation_error=steps[1],
        relative=_relative_errors(model, reference, rows, true_rows, min_baseline),
    )


def match_names(names: tuple[str, ...], reference_names: tuple[str, ...]) -> tuple[Indices, Indices]:
    """Rows of images that have the same name, in sorted order of the reference's names.

    Names that are not in both are matched by their last part where it occurs once among the rest of each side.
    """
    by_name = {name: row for row, name in enumerate(names)}
    pairs = {row: by_name[name] for row, name in enumerate(reference_names) if name in by_name}
    taken = set(pairs.values())
    mine = _unique_by_last_part({row: name for row, name in enumerate(names) if row not in taken})
    theirs = _unique_by_last_part({row: name for row, name in enumerate(reference_names) if row not in pairs})
    pairs.update({row: mine[last] for last, row in theirs.items() if last in mine})
    true_rows = sorted(pairs, key=lambda row: reference_names[row])
    return np.array([pairs[row] for row in true_rows], dtype=np.int64), np.array(true_rows, dtype=np.int64)


def _unique_by_last_part(names: dict[int, str]) -> dict[str, int]:
    rows_by_last_part: dict[str, list[int]] = {}
    for row, name in names.items():
        rows_by_last_part.setdefault(PurePosixPath(name).name, []).append(row)
    return {last: rows[0] for last, rows in rows_by_last_part.items() if len(rows) == 1}


def _relative_errors(
    model: Reconstruction, reference: Reconstruction, rows: Indices, true_rows: Indices, min_baseline: float | None
) -> RelativePoseErrors:
    count = len(reference.image_names)
    wxyz, translation, present = np.tile([1.0, 0, 0, 0], (count, 1)), np.zeros((count, 3)), np.zeros(count, dtype=bool)
    wxyz[true_rows] = model.cams_from_world.rotation.wxyz[rows]
    translation[true_rows] = model.cams_from_world.translation[rows]
    present[true_rows] = True
    if min_baseline is None:
        min_baseline = SHORT_BASELINE * _extent(reference.cams_from_world.center)
    return relative_pose_errors(
        Rigid3(Rotation3(wxyz), translation), reference.cams_from_world, present=present, min_baseline=min_baseline
    )


def _extent(centers: np.ndarray) -> float:
    """The diagonal of the points' bounding box."""
    return float(np.linalg.norm(np.ptp(centers, axis=0))) if len(centers) else 0.0


def _alignment_json(alignment: Alignment | Rejected) -> dict[str, Any]:
    if isinstance(alignment, Rejected):
        return {"rejected": alignment.reason, "detail": alignment.detail}
    similarity = alignment.b_from_a
    return {
        "method": alignment.method,
        "scale": float(similarity.scale),
        "rotation_wxyz": similarity.rotation.wxyz.tolist(),
        "translation": similarity.translation.tolist(),
        "inliers": int(alignment.inliers.sum()),
    }


def _summary(errors: FloatArray) -> dict[str, float | None]:
    if len(errors) == 0 or np.any(np.isnan(errors)):
        return dict.fromkeys(("median", "mean", "rmse", "max"))
    return {
        "median": float(np.median(errors)),
        "mean": float(errors.mean()),
        "rmse": _root_mean_square(errors),
        "max": float(errors.max()),
    }


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _root_mean_square(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
