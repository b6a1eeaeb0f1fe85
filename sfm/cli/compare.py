"""`sfm compare`: pose errors of a model against a reference."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from sfm.cli.parsing import Flag, Model, parsed
from sfm.core.errors import ExitCode, InputError, Rejected

if TYPE_CHECKING:
    from sfm.evaluation import PoseComparison

EXAMPLES = (
    "sfm compare scene truth/sparse",
    "sfm compare scene/sparse/0 truth --json > errors.json",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """Pose errors of a model, with another taken for the truth.

    Absolute errors are those after the best similarity alignment, lengths in units of the reference. Relative errors
    (the larger of the angles between rotations and between directions of translation, for each pair of images) need
    no alignment; images that the model lacks count as failures.
    """

    model: Model
    """A workspace, or the folder of a COLMAP model."""

    reference: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="REFERENCE", help_behavior_hint="")]
    """The same, for the truth."""

    json: Flag = False
    """Everything as JSON, with the errors of each image."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(CompareOptions, "compare", words, EXAMPLES)
    from sfm.evaluation import compare_models
    from sfm.io.colmap_model import read_model

    comparison = compare_models(read_model(model_folder(options.model)), read_model(model_folder(options.reference)))
    print(json.dumps(comparison.to_json(), indent=2, ensure_ascii=False) if options.json else summary(comparison))
    return ExitCode.OK


def model_folder(path: Path) -> Path:
    """The folder itself if it holds a model, else the largest model of the workspace.

    Raises:
        InputError: there is neither.
    """
    from sfm.io.colmap_model import model_format

    for folder in (path, path / "sparse" / "0", path / "0", path / "sparse"):
        if model_format(folder):
            return folder
    cause = "holds neither a COLMAP model nor a workspace with one" if path.is_dir() else "there is no such folder"
    raise InputError(cause, path=path, remedy="name the folder of cameras, images and points3D, or of `sfm run -o`")


def summary(comparison: PoseComparison) -> str:
    """A few lines for a person."""
    common, missing, extra = comparison.names, comparison.missing, comparison.extra
    lines = [f"{len(common)} of {len(common) + len(missing)} images of the reference"]
    if extra:
        lines[0] += f", and {len(extra)} that it lacks"
    if isinstance(comparison.alignment, Rejected):
        lines.append(f"no alignment: {comparison.alignment.reason.replace('_', ' ')} {comparison.alignment.detail}")
    else:
        lines += [
            f"position   median {_median(comparison.position_error):.4g} · "
            f"root mean square {comparison.absolute_trajectory_error:.4g} units of the reference",
            f"rotation   median {_median(comparison.rotation_error_deg):.3f}°",
        ]
    auc = " · ".join(f"{100 * value:.1f} at {limit:g}°" for limit, value in comparison.auc().items())
    lines.append(f"pairs      AUC {auc}")
    if missing:
        auc = " · ".join(
            f"{100 * value:.1f} at {limit:g}°" for limit, value in comparison.auc(registered_only=True).items()
        )
        lines.append(f"           AUC {auc} among the images that it has")
    return "\n".join(lines)


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("nan")
