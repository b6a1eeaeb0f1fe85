"""What `calib stereo` and `calib rig` have in common: from photos of several cameras to a rig file and its report."""

from __future__ import annotations

import dataclasses
import glob
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from calib.cli.parsing import Flag, board_of
from sfm.core.errors import ConfigError, ExitCode, InputError, ReconstructionError, Rejected

if TYPE_CHECKING:
    from calib.boards import Board
    from calib.cli.calibrating import Sightings
    from calib.rig_frames import FrameTable
    from calib.rig_shapes import RankedRig
    from calib.rig_views import RigCamera
    from sfm.core.cameras import Camera

AUTO = "auto"
_REMEDIES = {
    "cameras_not_connected": "take frames that show the board to cameras of both groups",
    "cameras_disagree": "see docs/calibrate_rigs.md; --pair says how photos are paired",
    "no_common_frame": "name photos alike (left/07.png, right/07.png), or pair them by --pair order",
    "same_photos": "name the folders of different cameras",
    "two_photos_of_a_frame": "rename one of them, or pair by --pair stem",
    "undetermined_focal": "tilt the board by 15° to 45° about two axes, or give the camera by --camera NAME=FILE",
}

Many = tyro.conf.UseAppendAction[tuple[str, ...]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Options of all commands for rigs."""

    board: Annotated[str, tyro.conf.arg(metavar="BOARD", help_behavior_hint="(required)")]
    """The .toml that `calib board` wrote, or the board in one word such as chessboard:9x6:25mm (inner corners, side of
    a square); see `calib detect --help`."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """Rig file to write, .toml."""

    model: Annotated[str, tyro.conf.arg(metavar="NAME")] = AUTO
    """Lens model of all cameras: auto (of each what predicts held-out photos best), pinhole, opencv, opencv5, opencv8,
    fisheye, eucm …; or of some of them, as in left=opencv5,top=fisheye."""

    camera: Annotated[Many, tyro.conf.arg(metavar="NAME=FILE", help_behavior_hint="(repeatable)")] = ()
    """A camera that is calibrated already, such as left=left.toml. It is held."""

    refine_known: Flag = False
    """Refines cameras given by --camera as well."""

    hold: Flag = False
    """Holds all cameras as each of them comes out alone; only the poses are found together."""

    shape: Annotated[str, tyro.conf.arg(metavar="NAME")] = AUTO
    """What the board may be: flat, scale, paraboloid, height, free, or auto: what predicts held-out frames best."""

    pair: Annotated[str, tyro.conf.arg(metavar="HOW")] = AUTO
    """How photos of one moment are told: stem (same name but for the suffix), number (same number in the name), order
    (first with first, if all have as many), or auto: stem or number, what pairs more."""

    json: Flag = False
    """Everything as JSON."""

    no_cache: Flag = False
    """Looks for the board anew, and keeps nothing."""

    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Of the choice of photos that are held out."""

    threads: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 0)")] = 0
    """At most so many photos at once; 0 for all cores. The result does not depend on it."""


def run(options: CommonOptions, sources: Mapping[str, str], command: str) -> int:
    """Photos of the cameras in `sources`, by name a folder or pattern each, to a rig file and a report on stdout."""
    board, files = _checked(options, sources)

    from calib.cli.progress import kernels_announced, told
    from calib.cli.rig_report import rig_json, rig_lines, rig_record
    from calib.rig_poses import board_turns
    from sfm.io.rig_files import write_rig_file

    observer = told()
    with kernels_announced(observer):
        seen, table = see_rig(files, board, options)
        cameras = rig_cameras(seen, files, table, options)
        ranked = _calibrated(board, cameras, board_turns(board), options)
    if isinstance(ranked, Rejected):
        raise _refusal(ranked, seen)
    write_rig_file(options.output, rig_record(ranked[0], seen, board, command))
    if options.json:
        import json

        print(json.dumps(rig_json(ranked, seen, table), indent=2, ensure_ascii=False))
    else:
        print("\n".join([*rig_lines(ranked, seen, table), "", str(options.output)]))
    return ExitCode.OK


def named_sources(words: Sequence[str]) -> dict[str, str]:
    """Folders or patterns by the names of cameras: what NAME=SOURCE says, else what tells their paths apart.

    Raises:
        ConfigError: two have one name.
    """
    given = [word.partition("=") if "=" in word and not Path(word).exists() else ("", "", word) for word in words]
    parts = [_parts_of(source) for _, _, source in given]
    shortest = min(map(len, parts), default=0)
    at = next((k for k in range(1, shortest + 1) if len({part[-k] for part in parts}) == len(parts)), 1)
    sources: dict[str, str] = {}
    for (name, _, source), part in zip(given, parts, strict=True):
        name = name or (part[-at] if part else source)
        if name in sources:
            raise ConfigError(f"two cameras are called {name!r}", remedy=f"say NAME={source}")
        sources[name] = source
    return sources


def _parts_of(source: str) -> tuple[str, ...]:
    """Of a folder; of a pattern such as photos/left*.jpg with what comes before the first star."""
    path = Path(source)
    if not any(sign in path.name for sign in "*?["):
        return tuple(part for part in path.parts if part not in ("/", ".", ".."))
    stem = path.name[: min(path.name.find(sign) for sign in "*?[" if sign in path.name)].strip("_-. ")
    return (*(part for part in path.parent.parts if part not in ("/", ".", "..")), stem or path.name)


def _checked(options: CommonOptions, sources: Mapping[str, str]) -> tuple[Board, dict[str, tuple[Path, ...]]]:
    """What the options say wrongly is told before photos are looked at."""
    from calib.refine_board import SHAPES
    from calib.rig_frames import PAIRINGS

    if options.threads < 0:
        raise ConfigError(f"--threads must not be negative, got {options.threads}")
    if options.output.suffix.lower() != ".toml":
        raise ConfigError(f"-o must end in .toml, got {options.output}")
    for option, value, known in (("shape", options.shape, (AUTO, *SHAPES)), ("pair", options.pair, PAIRINGS)):
        if value not in known:
            raise ConfigError(f"unknown --{option} {value!r}", remedy=f"known are {', '.join(known)}")
    lenses_of(options, tuple(sources))
    files = {name: _expanded(source) for name, source in sources.items()}
    known_cameras(options, tuple(sources))
    return board_of(options.board), files


def _expanded(source: str) -> tuple[Path, ...]:
    path = Path(source)
    if path.exists() or not any(sign in source for sign in "*?["):
        return (path,)
    found = sorted(glob.glob(source))
    if not found:
        raise InputError("no file is called so", path=source, remedy="name a folder, or a pattern in quotes")
    return tuple(Path(name) for name in found)


def lenses_of(options: CommonOptions, names: tuple[str, ...]) -> dict[str, str]:
    """The lens model of each camera by --model.

    Raises:
        ConfigError: a camera or a model is unknown.
    """
    from calib.refine_lenses import lens_called

    chosen = dict.fromkeys(names, AUTO)
    for word in options.model.split(","):
        name, equals, called = word.rpartition("=")
        if equals and name not in names:
            raise ConfigError(f"--model: there is no camera {name!r}", remedy=f"cameras are {', '.join(names)}")
        try:
            lens = AUTO if called.lower() == AUTO else lens_called(called).name
        except ValueError as error:
            raise ConfigError(str(error)) from error
        chosen |= {name: lens} if equals else dict.fromkeys(names, lens)
    return chosen


def known_cameras(options: CommonOptions, names: tuple[str, ...]) -> dict[str, Camera]:
    """Cameras by --camera.

    Raises:
        ConfigError: an unknown name, or a file with several cameras; InputError: a file does not do.
    """
    from sfm.io.camera_files import read_intrinsics

    known = {}
    for word in options.camera:
        name, equals, file = word.partition("=")
        if not equals or name not in names:
            raise ConfigError(f"--camera {word}: expected NAME=FILE with a NAME of {', '.join(names)}")
        cameras = read_intrinsics(Path(file))
        if len(cameras) != 1:
            raise ConfigError(f"holds {len(cameras)} cameras, one is needed", path=file)
        known[name] = next(iter(cameras.values()))
    return known


def see_rig(
    files: Mapping[str, tuple[Path, ...]], board: Board, options: CommonOptions
) -> tuple[dict[str, Sightings], FrameTable]:
    """What each camera sees of the board, and which photos belong together.

    Raises:
        ReconstructionError: photos cannot be paired.
    """
    from calib.cli.calibrating import see_board
    from calib.cli.progress import told
    from calib.cli.refusals import no_board
    from calib.rig_frames import pair_photos

    cached = not options.no_cache
    seen = {
        name: see_board(paths, board, threads=options.threads, use_cache=cached, observer=told())
        for name, paths in files.items()
    }
    for name, one in seen.items():
        if not one.views:
            raise no_board(one, files[name])
    digests: dict[str, str] = {}
    for name, one in seen.items():
        if one.digest in digests:
            refusal = Rejected("same_photos", f"{digests[one.digest]} and {name} are the very same photos")
            raise _refusal(refusal, seen)
        digests[one.digest] = name
    table = pair_photos({name: _names(one) for name, one in seen.items()}, options.pair)  # pyright: ignore
    if isinstance(table, Rejected):
        raise _refusal(table, seen)
    return seen, table


def _names(seen: Sightings) -> list[str]:
    return [*(view.name for view in seen.views), *(view.name for view in seen.left_out)]


def rig_cameras(
    seen: Mapping[str, Sightings], files: Mapping[str, tuple[Path, ...]], table: FrameTable, options: CommonOptions
) -> list[RigCamera]:
    """As the solver wants them; lens models that are to be chosen are.

    Raises:
        SfmError: no lens model can be had for a camera.
    """
    from calib.rig_views import RigCamera

    names = tuple(seen)
    lenses, known = lenses_of(options, names), known_cameras(options, names)
    lenses |= {name: _lens_of(camera) for name, camera in known.items() if lenses[name] == AUTO}
    lenses |= _chosen({name: one for name, one in seen.items() if lenses[name] == AUTO}, files, options.seed)
    return [
        RigCamera(
            name,
            one.views,
            tuple(table.frames[name][view.name] for view in one.views),
            "opencv5" if lenses[name] == AUTO else lenses[name],
            known.get(name),
        )
        for name, one in seen.items()
    ]


def _chosen(seen: Mapping[str, Sightings], files: Mapping[str, tuple[Path, ...]], seed: int) -> dict[str, str]:
    """The lens model of each camera that predicts held-out views best.

    Cameras with images of one size are likely of one make: those with perspective lenses get the richest model that one
    of them needs.
    """
    from calib.cli.refusals import no_camera
    from calib.refine_fit import CalibrationConfig
    from calib.refine_lenses import Lens, lens_by_name
    from calib.uncertainty_holdout import choose_lens

    found: dict[str, Lens] = {}
    for name, one in seen.items():
        # Of all shapes this costs least where it is not needed, and takes most of a bend.
        ranked = choose_lens(one.points3D, one.views, CalibrationConfig(shape="paraboloid"), seed=seed)
        if isinstance(ranked, Rejected):
            raise no_camera(one, ranked, files[name])
        found[name] = lens_by_name(ranked[0].lens)
    sizes = {name: (one.views[0].width, one.views[0].height) for name, one in seen.items()}

    def alike(name: str) -> str:
        if found[name].start != "perspective":
            return found[name].name
        makes = [lens for other, lens in found.items() if sizes[other] == sizes[name] and lens.start == "perspective"]
        return max(makes, key=lambda lens: len(lens.free_names)).name

    return {name: alike(name) for name in found}


def _lens_of(camera: Camera) -> str:
    from calib.refine_lenses import LENSES

    return next((lens.name for lens in LENSES if lens.model == camera.model), "opencv5")


def _calibrated(
    board: Board, cameras: Sequence[RigCamera], turns: Sequence[object], options: CommonOptions
) -> tuple[RankedRig, ...] | Rejected:
    from calib.rig_result import RigConfig
    from calib.rig_shapes import CANDIDATES, choose_rig_shape

    config = RigConfig(refine_intrinsics=not options.hold, refine_known=options.refine_known)
    shapes = CANDIDATES if options.shape == AUTO else (options.shape,)
    return choose_rig_shape(board.points3D, cameras, config, turns=turns, shapes=shapes, seed=options.seed)  # pyright: ignore


def _refusal(why: Rejected, seen: Mapping[str, Sightings]) -> ReconstructionError:
    remedy = _REMEDIES.get(why.reason, "look at `calib detect` for each camera, and see docs/calibrate_rigs.md")
    counts = ", ".join(f"{name} {len(one.views)} of {one.count}" for name, one in seen.items())
    return ReconstructionError(f"{why.reason}: {why.detail} (photos with the board: {counts})", remedy=remedy)
