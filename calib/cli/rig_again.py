"""A rig made again from the file that it gave and the photos that it was made from; see `again`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np

from calib.board_turns import board_turns
from calib.boards import Board
from calib.circle_shifts import exact_centres
from calib.cli.again import SAME_PX, difference_px
from calib.cli.parsing import board_of
from calib.cli.rig_options import expanded, named_sources
from calib.cli.rig_report import GIVEN
from calib.cli.rigging import lens_of, rig_refused, see_rig
from calib.cli.sightings import Sightings
from calib.refine_board import SHAPES, ShapeKind
from calib.refine_lenses import lens_called
from calib.rig_frames import PAIRINGS, FrameTable, Pairing
from calib.rig_result import RigCalibration, RigConfig
from calib.rig_shapes import RankedRig, choose_rig_shape
from calib.rig_views import RigCamera
from sfm.core.arrays import Value
from sfm.core.errors import ConfigError, Rejected
from sfm.core.events import Note, Observer
from sfm.io.rig_files import RigFile, read_rig_file


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RigAgain(Value):
    """A rig with all that it was made from.

    Attributes:
        file: what it was read from.
        ranked: with the file's shape of the board, and errors on held-out frames.
        files: photos of each camera, or their folders.
    """

    file: RigFile
    ranked: RankedRig
    found: RigCalibration
    board: Board
    seen: Mapping[str, Sightings]
    table: FrameTable
    files: Mapping[str, tuple[Path, ...]]


def rig_again(path: Path, words: Sequence[str], board: str, *, threads: int, observer: Observer) -> RigAgain:
    """The calibration behind a rig file.

    Where the photos give another rig than the file holds, that is said by a note, with the difference.

    Args:
        words: [NAME=]folders or patterns of photos; one folder will do if its subfolders are called as the cameras.
        board: in one word, or empty for that of the file.
    Raises:
        SfmError: the file cannot be read or names no board, folders do not fit its cameras, or photos give no rig.
    """
    file = read_rig_file(path)
    spec = board or str(file.provenance.get("board", ""))
    if not spec:
        raise ConfigError("names no board", path=path, remedy="name it with --board")
    shown = board_of(spec)
    files = {name: expanded(source) for name, source in sources_of(words, file.rig.names, path).items()}
    pair = file.provenance.get("paired_by")
    pairing = cast("Pairing", pair) if pair in PAIRINGS else "auto"
    seen, table = see_rig(files, shown, pair=pairing, threads=threads)
    kind = file.provenance.get("shape")
    shape = cast("ShapeKind", kind) if kind in SHAPES else "flat"
    cameras = [_camera(file, c, seen, table, path) for c in range(len(file.rig))]
    ranked = choose_rig_shape(shown.points3D, cameras, _config(file), turns=board_turns(shown), shapes=(shape,))
    if isinstance(ranked, Rejected):
        raise rig_refused(ranked, seen)
    found = ranked[0].found
    assert found is not None
    _note_difference(path, file, found, observer)
    return RigAgain(file, ranked[0], found, shown, seen, table, files)


def sources_of(words: Sequence[str], names: Sequence[str], path: Path) -> dict[str, str]:
    """Folders or patterns by the cameras of a rig: by their names, else, where none of them fits, in order.

    Raises:
        ConfigError: names or numbers do not fit.
    """
    if len(words) == 1 and all((Path(words[0]) / name).is_dir() for name in names):
        return {name: str(Path(words[0]) / name) for name in names}
    given = named_sources(words)
    if set(given) == set(names):
        return {name: given[name] for name in names}
    called = any("=" in word and not Path(word).exists() for word in words)
    if len(given) == len(names) and not called and not set(given) & set(names):
        return dict(zip(names, given.values(), strict=True))
    told = f"has the cameras {', '.join(names)}; photos are named of {', '.join(given)}"
    raise ConfigError(told, path=path, remedy=f"name a folder for each: {' '.join(f'{name}=DIR' for name in names)}")


def _camera(file: RigFile, c: int, seen: Mapping[str, Sightings], table: FrameTable, path: Path) -> RigCamera:
    name, camera = file.rig.names[c], file.rig.cameras[c]
    lens = str(file.provenance.get(f"lens_{name}", ""))
    given = lens == GIVEN
    try:
        lens = lens_called(lens).name if lens and not given else lens_of(camera)
    except ValueError as error:
        raise ConfigError(str(error), path=path) from error
    views = exact_centres(seen[name].board, seen[name].views, camera)
    frames = tuple(table.frames[name][view.name] for view in views)
    return RigCamera(name, views, frames, lens, camera if given else None)


def _config(file: RigFile) -> RigConfig:
    facts = file.provenance
    return RigConfig(
        refine_intrinsics=not facts.get("held", False), refine_known=bool(facts.get("given_refined", False))
    )


def _note_difference(path: Path, file: RigFile, found: RigCalibration, observer: Observer) -> None:
    apart = [difference_px(*both) for both in zip(file.rig.cameras, found.cameras, strict=True)]
    centers, again = file.rig.cams_from_rig.center, found.cams_from_rig.center
    moved = float(np.linalg.norm(centers - again, axis=1).max())
    if all(px <= SAME_PX for px in apart) and moved <= SAME_PX * max(float(np.ptp(centers, axis=0).max()), 1e-6):
        return
    c = max(range(len(apart)), key=lambda k: math.inf if math.isnan(apart[k]) else apart[k])
    words = f"by {apart[c]:.3g} px" if not math.isnan(apart[c]) else "of another size"
    told = f"{found.names[c]} differs {words}, places of cameras by up to {moved:.3g} {file.rig.unit}"
    observer(Note(message=f"note: these photos give another rig than {path} ({told}); this one is shown"))
