"""What the commands for rigs are asked: their options, and the folders and cameras that these name."""

from __future__ import annotations

import dataclasses
import glob
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from calib.cli.parsing import Flag, board_of
from sfm.core.errors import ConfigError, InputError

if TYPE_CHECKING:
    from calib.boards import Board
    from sfm.core.cameras import Camera

AUTO = "auto"
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
    """A camera that is calibrated already, such as left=left.toml, or left=rig.toml of a rig with a left one. It is
    held."""

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


def checked(options: CommonOptions, sources: Mapping[str, str]) -> tuple[Board, dict[str, tuple[Path, ...]]]:
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
    from sfm.io.atomic import check_writable

    check_writable(options.output)
    lenses_of(options, tuple(sources))
    files = {name: expanded(source) for name, source in sources.items()}
    known_cameras(options, tuple(sources))
    return board_of(options.board), files


def expanded(source: str) -> tuple[Path, ...]:
    """The folder that is named, or the files that a pattern finds.

    Raises:
        InputError: a pattern finds none.
    """
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
    from sfm.io.camera_files import camera_names, read_intrinsics

    known = {}
    for word in options.camera:
        name, equals, file = word.partition("=")
        if not equals or name not in names:
            raise ConfigError(f"--camera {word}: expected NAME=FILE with a NAME of {', '.join(names)}")
        cameras, called = read_intrinsics(Path(file)), camera_names(Path(file))
        if len(cameras) > 1:
            cameras = {k: camera for k, camera in cameras.items() if called.get(k) == name}
        if not cameras:
            told = f"has no camera {name!r} among {', '.join(called.values())}" if called else "holds several cameras"
            raise ConfigError(told, path=file, remedy="name a file with one camera, or a rig with one of this name")
        known[name] = next(iter(cameras.values()))
    return known
