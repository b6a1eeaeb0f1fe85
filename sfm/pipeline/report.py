"""What a run came to: figures, and the verdict that a person reads."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sfm.core.errors import ReconstructionError
from sfm.core.scene import Reconstruction

_NAMED_AT_MOST = 5


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ModelFigures:
    """One model in numbers; the mean reprojection error is over all observations, in px."""

    path: str
    images: int
    points: int
    observations: int
    mean_track_length: float
    mean_error_px: float


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RunReport:
    """The outcome of a run.

    Attributes:
        images: photos that could be used; `skipped` holds the others with the reason.
        missing: photos that the largest model lacks.
        models: largest first.
        stage_times_s: wall time of each stage in this run; near 0 where an earlier run had done it.
    """

    workspace: Path
    images: int
    skipped: Mapping[str, str]
    missing: Sequence[str]
    models: Sequence[ModelFigures]
    stage_times_s: Mapping[str, float]
    peak_memory_bytes: int | None

    def verdict(self) -> str:
        """A few lines for a person."""
        best, *others = self.models
        total = sum(self.stage_times_s.values())
        times = " · ".join(f"{stage} {seconds:.1f}" for stage, seconds in self.stage_times_s.items())
        lines = [
            f"{best.images} of {self.images} images registered{_named(self.missing)}",
            f"{best.points} points · {best.mean_track_length:.2f} images see a point · "
            f"reprojection error {best.mean_error_px:.3f} px",
            f"{total:.1f} s ({times})",
        ]
        if self.peak_memory_bytes:
            lines[-1] += f" · {self.peak_memory_bytes / 1e9:.1f} GB of memory at most"
        if others:
            told = ", ".join(f"{model.path} with {model.images}" for model in others)
            lines.append(f"{_counted(len(others), 'more model')}: {told} images")
        if self.skipped:
            counts = Counter(self.skipped.values())
            told = ", ".join(f"{count} × {reason}" for reason, count in sorted(counts.items()))
            lines.append(f"{_counted(len(self.skipped), 'file')} skipped: {told}")
        lines += [f"model    {self.workspace / best.path}", f"look     sfm view {self.workspace}"]
        return "\n".join(lines)


def figures_of(model: Reconstruction, path: str) -> ModelFigures:
    """The numbers of one model."""
    lengths = model.tracks.lengths
    known = model.errors >= 0
    weights = lengths[known]
    return ModelFigures(
        path=path,
        images=len(model.image_ids),
        points=len(model.tracks),
        observations=int(lengths.sum()),
        mean_track_length=float(lengths.mean()) if len(lengths) else 0.0,
        mean_error_px=float(np.average(model.errors[known], weights=weights)) if weights.sum() else 0.0,
    )


def no_model_error(
    images: Mapping[int, str],
    match_counts: Mapping[tuple[int, int], int],
    inlier_counts: Mapping[tuple[int, int], int],
    reasons: Mapping[tuple[int, int], str],
) -> ReconstructionError:
    """One line that says how far the photos came.

    Args:
        images: names of the usable photos by id.
        match_counts: putative matches of each pair.
        inlier_counts: matches that agree with a geometry, of each verified pair.
        reasons: why the other pairs were rejected.
    """
    remedy = "take photos that overlap by two thirds, a step apart, of something that stands still"
    if len(images) < 2:
        return ReconstructionError("one photo is not enough for a reconstruction", remedy=remedy)
    if not match_counts:
        return ReconstructionError(f"hardly any of {len(images)} photos has texture to compare", remedy=remedy)
    if not inlier_counts:
        best = max(sorted(match_counts), key=match_counts.__getitem__)
        names = " and ".join(images[k] for k in best)
        why = reasons.get(best, "").replace("_", " ")
        return ReconstructionError(
            f"no two of {len(images)} photos show the same scene: the best pair, {names}, "
            f"has {match_counts[best]} matches" + (f" ({why})" if why else ""),
            remedy=remedy,
        )
    best = max(sorted(inlier_counts), key=inlier_counts.__getitem__)
    names = " and ".join(images[k] for k in best)
    return ReconstructionError(
        f"{len(inlier_counts)} of {len(match_counts)} pairs of photos overlap, but none can start a model; "
        f"the best, {names}, has {inlier_counts[best]} matches",
        remedy="take photos from places that lie further apart, and avoid turning on the spot",
    )


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _named(names: Sequence[str]) -> str:
    if not names:
        return ""
    more = f", +{len(names) - _NAMED_AT_MOST} more" if len(names) > _NAMED_AT_MOST else ""
    return f" (missing: {', '.join(names[:_NAMED_AT_MOST])}{more})"
