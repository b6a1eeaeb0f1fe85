"""`sfm refine`: bundle adjustment of a model."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import tyro

from sfm.cli.parsing import Flag, Model, parsed
from sfm.core.errors import ConfigError, ExitCode, InputError

if TYPE_CHECKING:
    from sfm.bundle.reconstruction import Intrinsics
    from sfm.core.events import Event
    from sfm.pipeline.priors import Measurements, PriorConfig

EXAMPLES = (
    "sfm refine scene --refine focal,pp,distortion",
    "sfm refine sparse/0 -o refined --loss cauchy --loss-scale 2 --sigmas",
    "sfm refine sparse/0 -o bounded --refine focal,distortion --bounds focal=0.9:1.1,distortion=-0.3:0.3",
    "sfm refine sparse/0 -o moved --refine none --hold points",
    "sfm refine scene -o georeferenced --gps photos",
    "sfm refine scene -o measured --positions places.csv --position-sigma 0.02 --gravity down.csv",
)

_FILE = tyro.conf.arg(metavar="FILE", help_behavior_hint="")
_PX = tyro.conf.arg(metavar="PX", help_behavior_hint="")
_UNITS = tyro.conf.arg(metavar="UNITS", help_behavior_hint="")
_Solver: TypeAlias = Literal["auto", "dense", "sparse", "cholmod", "iterative"]
_Gauge: TypeAlias = Literal["cameras", "points", "free"]
_GAUGES: dict[_Gauge, Literal["two_cameras", "three_points", "free"]] = {
    "cameras": "two_cameras",
    "points": "three_points",
    "free": "free",
}
_GPS_SIGMA_M = 5.0
_KINDS: dict[str, Intrinsics] = {"focal": "focal", "pp": "principal_point", "distortion": "extra"}
_SENSORS = "sensors"
_HELD = ("poses", "points")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """The model of least reprojection error near to a given one, by bundle adjustment.

    Any COLMAP model will do, binary or text. Poses and points may change unless they are held; nothing is added to the
    model and nothing removed from it, and the source stays as it is.

    What was measured in the scene (positions, gravity, distances, control points) makes up the frame and the scale of
    the model, and is weighed against its residuals by standard deviations. Tables have commas and a header.
    """

    model: Model
    """A workspace, or the folder of a COLMAP model."""

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER", help_behavior_hint="")] = None
    """Folder for the adjusted model; of a workspace, the folder `refined` in it without this."""

    refine: Annotated[str, tyro.conf.arg(metavar="LIST")] = "focal,distortion"
    """What of the cameras may change: focal, pp (the principal point), distortion, sensors (their poses on a rig), with
    commas; or none."""

    focal_sigma: Annotated[float | None, _PX] = None
    """Standard deviation with which the present focal lengths are known; without it they are not."""

    pp_sigma: Annotated[float | None, _PX] = None
    """The same of the principal points."""

    distortion_sigma: Annotated[float | None, tyro.conf.arg(metavar="S", help_behavior_hint="")] = None
    """The same of each parameter of the distortion."""

    bounds: Annotated[str, tyro.conf.arg(metavar="LIST", help_behavior_hint="")] = ""
    """How far the cameras may change, as in focal=0.8:1.2,pp=-20:20,distortion=-0.3:0.3: focal lengths by a factor,
    principal points by px, the parameters of distortion to a value; a side may be left open."""

    hold: Annotated[str, tyro.conf.arg(metavar="LIST", help_behavior_hint="")] = ""
    """What else may not change: poses, points."""

    loss: Annotated[str, tyro.conf.arg(metavar="NAME")] = "trivial"
    """What a residual costs: trivial (its square), huber, soft_l1, cauchy, tukey, truncated."""

    loss_scale: Annotated[float, tyro.conf.arg(metavar="PX")] = 1.0
    """Residual from which a loss grows more slowly; counts --pixel-sigma where that is given."""

    graduated: Flag = False
    """Narrow the scale of the loss step by step from the worst residual on; for tukey and truncated."""

    max_iterations: Annotated[int, tyro.conf.arg(metavar="N")] = 100
    """Steps that are tried at most."""

    tolerance: Annotated[float, tyro.conf.arg(metavar="PART")] = 1e-8
    """Stop where a full step lowers the cost by less than this part."""

    solver: Annotated[_Solver, tyro.conf.arg(metavar="NAME")] = "auto"
    """How the reduced system is solved: dense, sparse (factors), cholmod (a sparse factor of SuiteSparse, if
    scikit-sparse is installed), iterative (conjugate gradients); auto: the fastest without cholmod."""

    positions: Annotated[Path | None, _FILE] = None
    """Where photos were taken: name,x,y,z or name,latitude,longitude,altitude; also sx,sy,sz."""

    gps: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Where photos were taken by their EXIF: the folder of the photos."""

    position_sigma: Annotated[float | None, _UNITS] = None
    """Standard deviation of each coordinate of these; 5 m with --gps."""

    position_bias: Annotated[float | None, _UNITS] = None
    """Standard deviation of a shift that all of them have in common; without it there is none."""

    gravity: Annotated[Path | None, _FILE] = None
    """Which way is down in the camera (x right, y down, z forward): name,x,y,z; also sigma_deg."""

    gravity_sigma_deg: Annotated[float, tyro.conf.arg(metavar="DEG")] = 1.0
    """Standard deviation of these."""

    distances: Annotated[Path | None, _FILE] = None
    """How far apart photos were taken: name1,name2,distance; also sigma."""

    distance_sigma: Annotated[float | None, _UNITS] = None
    """Standard deviation of these."""

    control_points: Annotated[Path | None, _FILE] = None
    """Where points lie: point,x,y,z with the ids of points of the model, or those of --marks; also sx,sy,sz."""

    marks: Annotated[Path | None, _FILE] = None
    """Where control points are marked in photos: point,name,x,y in px, the centre of the first pixel at 0.5."""

    control_sigma: Annotated[float | None, _UNITS] = None
    """Standard deviation of each coordinate of these."""

    measurement_loss: Annotated[str, tyro.conf.arg(metavar="NAME")] = "huber"
    """What a measurement costs that deviates by more than three standard deviations."""

    pixel_sigma: Annotated[float, tyro.conf.arg(metavar="PX")] = 1.0
    """Standard deviation of keypoints, by which residuals are weighed against measurements."""

    sigmas: Flag = False
    """Also standard deviations: of the camera parameters, and in two tables beside the model those of poses and points
    (pose_sigmas.csv, point_sigmas.csv)."""

    gauge: Annotated[_Gauge, tyro.conf.arg(metavar="NAME")] = "cameras"
    """What stays in place, where no measurement says, and what standard deviations are relative to: cameras (one pose
    and a coordinate of another, whose own are then zero), points (three points far apart), free (nothing, and standard
    deviations are spread over all: the least there are)."""

    threads: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="(default: all cores)")] = 0
    """At most so many at once. The result does not depend on it."""

    plot: Annotated[Path | None, tyro.conf.arg(metavar="FILE.svg", help_behavior_hint="")] = None
    """Draw cost, gradient and damping of each iteration."""

    text: Flag = False
    """Write COLMAP text."""

    overwrite: Flag = False
    """Replace a model that is there."""

    json: Flag = False
    """Print everything as JSON, with the table of iterations."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(RefineOptions, "refine", words, EXAMPLES)
    kinds, held = _listed(options.refine, (*_KINDS, _SENSORS), "--refine"), _listed(options.hold, _HELD, "--hold")
    bounds = _bounds(options.bounds, kinds)
    if options.threads < 0:
        raise ConfigError(f"--threads must not be negative, got {options.threads}")

    from sfm.bundle import BundleConfig
    from sfm.cli.compare import model_folder
    from sfm.cli.refine_report import summary
    from sfm.cli.refine_tables import write_tables
    from sfm.core.execution import available_threads
    from sfm.core.optim.losses import LOSSES
    from sfm.io.atomic import check_writable, write_text
    from sfm.io.colmap_model import read_model, write_model
    from sfm.pipeline.refinement import RefinementConfig, refine_model
    from sfm.viz.convergence import convergence_svg

    if options.loss not in LOSSES:
        raise ConfigError(f"unknown loss {options.loss!r}", remedy=f"choose one of {', '.join(LOSSES)}")
    source = model_folder(options.model)
    target = _target(options, source)
    check_writable(target / "cameras.bin", options.plot)
    try:
        bundle = BundleConfig(
            loss=options.loss,
            loss_scale_px=options.loss_scale,
            graduated=options.graduated,
            max_iterations=options.max_iterations,
            relative_cost_tolerance=options.tolerance,
            solver=options.solver,
            gauge=_GAUGES[options.gauge],
        )
        config = RefinementConfig(
            intrinsics=tuple(_KINDS[kind] for kind in kinds if kind != _SENSORS),
            focal_sigma=options.focal_sigma,
            principal_point_sigma=options.pp_sigma,
            distortion_sigma=options.distortion_sigma,
            focal_bounds=bounds.get("focal"),
            principal_point_bounds=bounds.get("pp"),
            distortion_bounds=bounds.get("distortion"),
            sensors=_SENSORS in kinds,
            poses="poses" not in held,
            points="points" not in held,
            bundle=bundle,
            priors=_prior_config(options),
            pixel_sigma=options.pixel_sigma,
        )
    except ValueError as error:
        raise ConfigError(str(error)) from error
    threads, model = options.threads or available_threads(), read_model(source)
    measured = _measurements(options, model.image_names)
    try:
        refined = refine_model(
            model, config, measured=measured, with_covariance=options.sigmas, threads=threads, observer=_announce
        )
    except InputError as error:
        raise InputError(error.cause, path=source, remedy=error.remedy) from error
    write_model(refined.reconstruction, target, text=options.text)
    write_tables(refined, target, overwrite=options.overwrite)
    if options.plot is not None:
        write_text(options.plot, convergence_svg(refined.result.table, f"sfm refine {options.model}"))
    if options.json:
        print(json.dumps(refined.to_json(), indent=2))
    else:
        print(summary(refined, target, options.graduated))
    return ExitCode.OK


def _target(options: RefineOptions, source: Path) -> Path:
    """The folder to write, looked at before anything is adjusted.

    Raises:
        ConfigError: none is named, and the model is not that of a workspace.
        InputError: it is the source, or a model is there already, or it cannot be a folder.
    """
    from sfm.io.colmap_model import model_format

    target = options.output
    if target is None and source == options.model / "sparse" / "0":
        target = options.model / "refined"
    if target is None:
        raise ConfigError("-o is missing, the folder for the adjusted model", remedy="only a workspace has its own")
    if source.resolve() == target.resolve():
        raise InputError("is both source and target", path=target, remedy="name another folder")
    there = next(folder for folder in (target, *target.absolute().parents) if folder.exists() or folder.is_symlink())
    if not there.is_dir():
        raise InputError("is a file, not a folder", path=there, remedy="choose another folder, or move what lies there")
    if model_format(target) and not options.overwrite:
        raise InputError("is there already", path=target, remedy="choose another folder, or --overwrite it")
    return target


def _bounds(text: str, free: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Least and largest value by the names of the option; only what is free may be bounded."""
    found: dict[str, tuple[float, float]] = {}
    for part in (part.strip() for part in text.split(",") if part.strip()):
        kind, equals, interval = part.partition("=")
        least, colon, most = interval.partition(":")
        try:
            bounds = (float(least or "-inf"), float(most or "inf"))
        except ValueError:
            bounds = (0.0, 0.0)
        if kind not in _KINDS or not equals or not colon or not bounds[0] < bounds[1]:
            raise ConfigError(
                f"--bounds does not know {part!r}",
                remedy="write it like focal=0.8:1.2,pp=-20:20,distortion=-0.3:0.3, the least first",
            )
        if kind not in free:
            raise ConfigError(f"--bounds are of {kind}, which may not change", remedy=f"name {kind} in --refine, too")
        found[kind] = bounds
    return found


def _announce(event: Event) -> None:
    """Tells what an adjustment will take before it takes it."""
    from sfm.core.events import BundlePlanned

    if isinstance(event, BundlePlanned):
        sys.stderr.write(
            f"adjusting {event.images} images, {event.points} points, {event.observations} observations: "
            f"{event.solver} solver, about {max(event.memory_bytes >> 20, 1)} MB\n"
        )


def _prior_config(options: RefineOptions) -> PriorConfig:
    from sfm.core.optim.losses import LOSSES
    from sfm.pipeline.priors import PriorConfig

    loss = options.measurement_loss
    if loss not in LOSSES:
        raise ConfigError(f"unknown loss {loss!r}", remedy=f"choose one of {', '.join(LOSSES)}")
    sigma = _GPS_SIGMA_M if options.gps and options.position_sigma is None else options.position_sigma
    return PriorConfig(
        position_sigma=sigma,
        position_bias=options.position_bias,
        gravity_sigma_deg=options.gravity_sigma_deg,
        distance_sigma=options.distance_sigma,
        control_sigma=options.control_sigma,
        loss=loss,
    )


def _measurements(options: RefineOptions, names: Sequence[str]) -> Measurements | None:
    """What the options name; None where they name nothing."""
    from sfm.io import measurements as tables
    from sfm.pipeline.priors import Measurements, positions_of_photos

    if options.positions and options.gps:
        raise ConfigError("--positions and --gps exclude each other", remedy="choose one of them")
    if options.marks and not options.control_points:
        raise ConfigError("--marks are of control points", remedy="say with --control-points where these lie")
    if not (options.positions or options.gps or options.gravity or options.distances or options.control_points):
        return None
    positions = tables.read_positions(options.positions) if options.positions else None
    return Measurements(
        positions=positions_of_photos(options.gps, names) if options.gps else positions,
        directions=tables.read_directions(options.gravity) if options.gravity else None,
        distances=tables.read_distances(options.distances) if options.distances else None,
        control_points=tables.read_control_points(options.control_points) if options.control_points else None,
        marks=tables.read_marks(options.marks) if options.marks else None,
    )


def _listed(words: str, known: Sequence[str], option: str) -> list[str]:
    names = [word.strip() for word in words.split(",") if word.strip() and word.strip() != "none"]
    for name in names:
        if name not in known:
            raise ConfigError(f"{option} knows no {name!r}", remedy=f"choose from {', '.join([*known, 'none'])}")
    return names
