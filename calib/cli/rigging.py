"""What `calib stereo` and `calib rig` have in common: from photos of several cameras to a rig file and its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from calib.cli.rig_options import AUTO, CommonOptions, checked, known_cameras, lenses_of
from sfm.core.errors import ExitCode, ReconstructionError, Rejected

if TYPE_CHECKING:
    from calib.boards import Board
    from calib.cli.sightings import Sightings
    from calib.rig_frames import FrameTable
    from calib.rig_shapes import RankedRig
    from calib.rig_views import RigCamera
    from sfm.core.cameras import Camera

_REMEDIES = {
    "cameras_not_connected": "take frames that show the board to cameras of both groups",
    "cameras_disagree": "see docs/calibrate_rigs.md; --pair says how photos are paired",
    "no_common_frame": "name photos alike (left/07.png, right/07.png), or pair them by --pair order",
    "same_photos": "name the folders of different cameras",
    "two_photos_of_a_frame": "rename one of them, or pair by --pair stem",
    "undetermined_focal": "tilt the board by 15° to 45° about two axes, or give the camera by --camera NAME=FILE",
}


def run(options: CommonOptions, sources: Mapping[str, str], command: str) -> int:
    """Photos of the cameras in `sources`, by name a folder or pattern each, to a rig file and a report on stdout."""
    board, files = checked(options, sources)

    from calib.board_turns import board_turns
    from calib.cli.progress import kernels_announced, told
    from calib.cli.refusals import shown_size_of_all
    from calib.cli.rig_report import rig_json, rig_lines, rig_record
    from sfm.io.rig_files import write_rig_file

    observer = told()
    with kernels_announced(observer):
        seen, table = see_rig(files, board, pair=options.pair, threads=options.threads, cached=not options.no_cache)
        finding = shown_size_of_all(seen, files)
        cameras = rig_cameras(seen, files, table, options)
        ranked = _calibrated(board, cameras, board_turns(board), options)
    if isinstance(ranked, Rejected):
        raise rig_refused(ranked, seen)
    write_rig_file(options.output, rig_record(ranked, seen, table, board, command))
    if options.json:
        import json

        print(json.dumps(rig_json(ranked, seen, table, finding), indent=2, ensure_ascii=False))
    else:
        print("\n".join([*rig_lines(ranked, seen, table, finding), "", str(options.output)]))
    return ExitCode.OK


def see_rig(
    files: Mapping[str, tuple[Path, ...]], board: Board, *, pair: str, threads: int, cached: bool = True
) -> tuple[dict[str, Sightings], FrameTable]:
    """What each camera sees of the board, and which photos belong together.

    Args:
        pair: one of `rig_frames.PAIRINGS`.
        cached: takes detections that are kept, and keeps new ones.
    Raises:
        ReconstructionError: photos cannot be paired.
    """
    from calib.cli.progress import told
    from calib.cli.refusals import no_board
    from calib.cli.sightings import see_board
    from calib.rig_frames import pair_photos

    seen = {
        name: see_board(paths, board, threads=threads, use_cache=cached, observer=told())
        for name, paths in files.items()
    }
    for name, one in seen.items():
        if not one.views:
            raise no_board(one, files[name])
    digests: dict[str, str] = {}
    for name, one in seen.items():
        if one.digest in digests:
            refusal = Rejected("same_photos", f"{digests[one.digest]} and {name} are the very same photos")
            raise rig_refused(refusal, seen)
        digests[one.digest] = name
    table = pair_photos({name: _names(one) for name, one in seen.items()}, pair)  # pyright: ignore
    if isinstance(table, Rejected):
        raise rig_refused(table, seen)
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
    lenses |= {name: lens_of(camera) for name, camera in known.items() if lenses[name] == AUTO}
    seen = {name: _with_exact_centres(one, known.get(name), lenses[name]) for name, one in seen.items()}
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


def _with_exact_centres(seen: Sightings, known: Camera | None, lens: str) -> Sightings:
    """Sightings of circles with the shifts of their centroids as the camera that is known says, or its own photos."""
    import dataclasses

    from calib.circle_shifts import TRIED, exact_centres, with_exact_centres
    from calib.refine_fit import CalibrationConfig

    if known is not None:
        return dataclasses.replace(seen, views=exact_centres(seen.board, seen.views, known))
    lenses = TRIED if lens == AUTO else (lens,)
    return dataclasses.replace(
        seen, views=with_exact_centres(seen.board, seen.views, CalibrationConfig(), lenses=lenses)
    )


def _chosen(seen: Mapping[str, Sightings], files: Mapping[str, tuple[Path, ...]], seed: int) -> dict[str, str]:
    """The lens model of each camera that predicts held-out views best.

    Cameras with images of one size are likely of one make: those with perspective lenses get the richest model that one
    of them needs.
    """
    from calib.cli.refusals import no_camera
    from calib.refine_fit import CalibrationConfig
    from calib.refine_lenses import Lens, lens_by_name
    from calib.uncertainty_lenses import choose_lens

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


def lens_of(camera: Camera) -> str:
    """The lens with the fewest coefficients that this camera may have come from."""
    import numpy as np

    from calib.refine_lenses import LENSES, Lens

    def may_be(lens: Lens) -> bool:
        """Whether what it does not estimate stands as it starts."""
        start, free = lens.camera(camera.width, camera.height, 1.0, 1.0, 0.0, 0.0).params, lens.columns()
        return np.array_equal(np.delete(start, free), np.delete(camera.params, free))

    able = [lens for lens in LENSES if lens.model == camera.model and may_be(lens)]
    return min(able, key=lambda lens: len(lens.free_names)).name if able else "opencv5"


def _calibrated(
    board: Board, cameras: Sequence[RigCamera], turns: Sequence[object], options: CommonOptions
) -> tuple[RankedRig, ...] | Rejected:
    from calib.rig_result import RigConfig
    from calib.rig_shapes import CANDIDATES, choose_rig_shape

    config = RigConfig(refine_intrinsics=not options.hold, refine_known=options.refine_known)
    shapes = CANDIDATES if options.shape == AUTO else (options.shape,)
    return choose_rig_shape(board.points3D, cameras, config, turns=turns, shapes=shapes, seed=options.seed)  # pyright: ignore


def rig_refused(why: Rejected, seen: Mapping[str, Sightings]) -> ReconstructionError:
    """The error for photos that give no rig."""
    remedy = _REMEDIES.get(why.reason, "look at `calib detect` for each camera, and see docs/calibrate_rigs.md")
    counts = ", ".join(f"{name} {len(one.views)} of {one.count}" for name, one in seen.items())
    return ReconstructionError(f"{why.reason}: {why.detail} (photos with the board: {counts})", remedy=remedy)
