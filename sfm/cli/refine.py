"""`sfm refine`: bundle adjustment of a model."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sfm.cli.parsing import Flag, Model, parsed
from sfm.core.errors import ConfigError, ExitCode, InputError

if TYPE_CHECKING:
    from sfm.bundle.reconstruction import Intrinsics
    from sfm.pipeline.refinement import RefinedModel

EXAMPLES = (
    "sfm refine scene -o scene/refined --refine focal,pp,distortion",
    "sfm refine sparse/0 -o refined --loss cauchy --loss-scale 2 --sigmas",
    "sfm refine sparse/0 -o moved --refine none --hold points",
)

_KINDS: dict[str, Intrinsics] = {"focal": "focal", "pp": "principal_point", "distortion": "extra"}
_HELD = ("poses", "points")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """The model of least reprojection error near to a given one, by bundle adjustment.

    Any COLMAP model will do, binary or text. Poses and points may change unless they are held; nothing is added to the
    model and nothing removed from it, and the source stays as it is.
    """

    model: Model
    """A workspace, or the folder of a COLMAP model."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER", help_behavior_hint="")]
    """Folder for the adjusted model."""

    refine: Annotated[str, tyro.conf.arg(metavar="LIST")] = "focal,distortion"
    """Camera parameters that may change: focal, pp (the principal point), distortion, with commas; or none."""

    hold: Annotated[str, tyro.conf.arg(metavar="LIST", help_behavior_hint="")] = ""
    """What else may not change: poses, points."""

    loss: Annotated[str, tyro.conf.arg(metavar="NAME")] = "trivial"
    """What a residual costs: trivial (its square), huber, soft_l1, cauchy, tukey, truncated."""

    loss_scale: Annotated[float, tyro.conf.arg(metavar="PX")] = 1.0
    """Residual from which a loss grows more slowly."""

    graduated: Flag = False
    """Narrow the scale of the loss step by step from the worst residual on; for tukey and truncated."""

    max_iterations: Annotated[int, tyro.conf.arg(metavar="N")] = 100
    """Steps that are tried at most."""

    tolerance: Annotated[float, tyro.conf.arg(metavar="PART")] = 1e-8
    """Stop where a full step lowers the cost by less than this part."""

    sigmas: Flag = False
    """Also standard deviations of the camera parameters."""

    threads: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="(default: all cores)")] = 0
    """At most so many at once. The result does not depend on it."""

    text: Flag = False
    """Write COLMAP text."""

    overwrite: Flag = False
    """Replace a model that is there."""

    json: Flag = False
    """Print everything as JSON, with the table of iterations."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(RefineOptions, "refine", words, EXAMPLES)
    kinds, held = _listed(options.refine, _KINDS, "--refine"), _listed(options.hold, _HELD, "--hold")
    if options.threads < 0:
        raise ConfigError(f"--threads must not be negative, got {options.threads}")

    from sfm.bundle import BundleConfig
    from sfm.cli.compare import model_folder
    from sfm.core.execution import available_threads
    from sfm.core.optim.losses import LOSSES
    from sfm.io.colmap_model import model_format, read_model, write_model
    from sfm.pipeline.refinement import RefinementConfig, refine_model

    if options.loss not in LOSSES:
        raise ConfigError(f"unknown loss {options.loss!r}", remedy=f"choose one of {', '.join(LOSSES)}")
    source = model_folder(options.model)
    if source.resolve() == options.output.resolve():
        raise InputError("is both source and target", path=options.output, remedy="name another folder")
    if model_format(options.output) and not options.overwrite:
        raise InputError("is there already", path=options.output, remedy="choose another folder, or --overwrite it")
    try:
        bundle = BundleConfig(
            loss=options.loss,
            loss_scale_px=options.loss_scale,
            graduated=options.graduated,
            max_iterations=options.max_iterations,
            relative_cost_tolerance=options.tolerance,
        )
    except ValueError as error:
        raise ConfigError(str(error)) from error
    config = RefinementConfig(
        intrinsics=tuple(_KINDS[kind] for kind in kinds),
        poses="poses" not in held,
        points="points" not in held,
        bundle=bundle,
    )
    threads = options.threads or available_threads()
    try:
        refined = refine_model(read_model(source), config, with_covariance=options.sigmas, threads=threads)
    except InputError as error:
        raise InputError(error.cause, path=source, remedy=error.remedy) from error
    write_model(refined.reconstruction, options.output, text=options.text)
    print(json.dumps(refined.to_json(), indent=2) if options.json else summary(refined, options.output))
    return ExitCode.OK


def _listed(words: str, known: Sequence[str] | dict[str, Intrinsics], option: str) -> list[str]:
    names = [word.strip() for word in words.split(",") if word.strip() and word.strip() != "none"]
    for name in names:
        if name not in known:
            raise ConfigError(f"{option} knows no {name!r}", remedy=f"choose from {', '.join([*known, 'none'])}")
    return names


_REASONS = {
    "relative_cost": "a full step hardly lowered the cost",
    "gradient": "the gradient vanished",
    "step": "steps became as small as rounding errors",
    "max_iterations": "NOT CONVERGED: the limit of iterations was reached",
    "no_free_parameters": "nothing was free to change",
}


def summary(refined: RefinedModel, folder: Path) -> str:
    """A few lines for a person."""
    result, model = refined.result, refined.reconstruction
    count = max(len(result.problem.obs_images) - result.invalid, 1)
    before, after = ((2 * cost / count) ** 0.5 for cost in (result.initial_cost, result.final_cost))
    lines = [
        f"{len(model.image_ids)} images · {len(model.points3D)} points · {count} observations",
        f"root mean square reprojection error {before:.4f} → {after:.4f} px (by the loss), "
        f"cost {result.initial_cost:.6g} → {result.final_cost:.6g}",
        f"{result.iterations} iterations; {_REASONS[result.reason]}",
    ]
    if result.invalid:
        lines.append(f"{result.invalid} observations have no projection (behind the camera) and took no part")
    if result.lost:
        lines.append(f"{result.lost} observations lost their projection on the way")
    if refined.undetermined:
        lines.append(f"no standard deviations: the observations leave open {refined.undetermined}")
    for camera_id, camera in list(model.cameras.items())[:5]:
        sigmas = refined.sigmas(camera_id)
        told = [
            f"{name} {value:.6g}" + (f" ± {sigmas[k]:.2g}" if sigmas is not None and sigmas[k] > 0 else "")
            for k, (name, value) in enumerate(zip(camera.model_info.param_names, camera.params, strict=True))
        ]
        lines.append(f"camera {camera_id}  {camera.model}  {'  '.join(told)}")
    if len(model.cameras) > 5:
        lines.append(f"and {len(model.cameras) - 5} more cameras (--json has them all)")
    return "\n".join([*lines, f"model    {folder}"])
