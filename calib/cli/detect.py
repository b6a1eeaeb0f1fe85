"""`calib detect`: the corners of a board in photos."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from calib.cli.parsing import Flag, board_of, parsed
from sfm.core.errors import ConfigError, ExitCode, Rejected

if TYPE_CHECKING:
    from calib.boards import Board
    from calib.detect import Detection
    from sfm.core.events import Event, Observer

EXAMPLES = (
    "calib detect photos --board board.toml",
    "calib detect photos --board chessboard:9x6:25mm --overlays seen",
    "calib detect photos/*.jpg --board aprilgrid:6x6:88mm:26.4mm -o corners.json",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectOptions:
    """Finds a board in photos and says how well: corners, their uncertainty, blur, and what was rejected and why.

    Found corners are kept in the user's cache by the content of the photos, so that calibrating them afterwards, or
    with some more photos, takes no second look.
    """

    images: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="IMAGES", help_behavior_hint="")]
    """Folders of photos, or photos."""

    board: Annotated[str, tyro.conf.arg(metavar="BOARD", help_behavior_hint="(required)")]
    """The .toml that `calib board` wrote, or the board in one word: chessboard:9x6:25mm (inner corners, side of a
    square), charuco:8x6:30mm:22mm (squares, side of a square, of a marker), aprilgrid:6x6:88mm:26.4mm (tags, side of a
    tag, gap), circles:8x10:25mm:15mm (circles, distance, diameter), acircles:4x11:20mm (rows half as far)."""

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = None
    """Writes all corners with their covariances, .json; pixels as in COLMAP, the centre of the first is (0.5, 0.5)."""

    overlays: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER", help_behavior_hint="")] = None
    """Writes the photos with what was found drawn into them, as PNG, to a folder that does not hold photos."""

    json: Flag = False
    """The summary of each photo as JSON."""

    no_cache: Flag = False
    """Looks anew, and keeps nothing."""

    threads: Annotated[int, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 0)")] = 0
    """At most so many photos at once; 0 for all cores."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(DetectOptions, "detect", words, EXAMPLES)
    if options.threads < 0:
        raise ConfigError(f"--threads must not be negative, got {options.threads}")
    if not options.images:
        raise ConfigError("no photos are named", remedy="name a folder of photos")
    if options.output and options.output.suffix.lower() != ".json":
        raise ConfigError(f"-o must end in .json, got {options.output}")
    board = board_of(options.board)
    from calib.cli.photos import check_apart, detect_photos, detection_cache, find_photos
    from sfm.io.atomic import check_writable

    if options.overlays:
        check_apart(options.overlays, options.images)
    check_writable(options.output, options.overlays and options.overlays / "overlay.png")
    photos = find_photos(options.images)
    cache = None if options.no_cache else detection_cache()
    seen = detect_photos(photos, board, threads=options.threads, cache=cache, observer=_told())
    if options.output:
        _write_corners(options.output, board, seen)
    if options.overlays:
        _write_overlays(options.overlays, board, photos, seen)
    found = [name for name, detection in seen.items() if detection]
    if options.json:
        print(json.dumps(_summary(board, seen), indent=2, ensure_ascii=False))
    else:
        print("\n".join(_lines(board, seen)))
    return ExitCode.OK if found else ExitCode.BAD_INPUT


def _told() -> Observer:
    """Progress on a terminal; nothing where nobody watches."""
    from sfm.core.events import SILENT, ImageRead, StageStarted

    if not sys.stderr.isatty():
        return SILENT
    state = {"done": 0, "total": 0}

    def tell(event: Event, /) -> None:
        match event:
            case StageStarted(total=total):
                state["total"] = total
            case ImageRead():
                state["done"] += 1
                end = "\n" if state["done"] == state["total"] else ""
                print(f"\rphotos {state['done']} of {state['total']}", end=end, file=sys.stderr, flush=True)

    return tell


def _write_corners(path: Path, board: Board, seen: Mapping[str, Detection | Rejected]) -> None:
    from calib.cli.photos import detection_json
    from sfm.io.atomic import write_text

    images = {name: detection_json(detection) for name, detection in seen.items()}
    document = {"board": board.spec, "points3D": board.points3D.tolist(), "pixel_center": 0.5, "images": images}
    write_text(path, json.dumps(document, ensure_ascii=False))


def _write_overlays(
    folder: Path, board: Board, photos: Mapping[str, Path], seen: Mapping[str, Detection | Rejected]
) -> None:
    import cv2

    from calib.detect_overlay import overlay
    from sfm.io.atomic import write_bytes
    from sfm.io.images import read_image

    drawn_as = _overlay_names(seen)
    for name, detection in seen.items():
        if isinstance(detection, Rejected) and detection.reason == "unreadable":
            continue
        drawn = overlay(read_image(photos[name]), board, detection)
        _, data = cv2.imencode(".png", cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR))
        write_bytes(folder / drawn_as[name], data.tobytes())


def _overlay_names(names: Iterable[str]) -> dict[str, str]:
    """The photo's name with .png as suffix; where photos differ by their suffix alone it is added to the whole name."""
    shared = Counter(str(Path(name).with_suffix("")).lower() for name in names)
    alone = {name: shared[str(Path(name).with_suffix("")).lower()] == 1 for name in names}
    return {name: str(Path(name).with_suffix(".png")) if alone[name] else f"{name}.png" for name in names}


def _summary(board: Board, seen: Mapping[str, Detection | Rejected]) -> dict[str, object]:
    rows = {}
    for name, detection in seen.items():
        if isinstance(detection, Rejected):
            rows[name] = {"corners": 0, "reason": detection.reason, "detail": detection.detail}
        else:
            rows[name] = {
                "corners": len(detection.points2D),
                "sigma_px": _sigma(detection),
                "blur_px": None if detection.blur_px != detection.blur_px else detection.blur_px,
                "finder": detection.finder,
                "rejected": {str(number): reason for number, reason in detection.rejected.items()},
            }
    return {"board": board.spec, "corners_of_board": len(board.points3D), "images": rows}


def _sigma(detection: Detection) -> float:
    """Median standard deviation of the corners along an axis, px."""
    import numpy as np

    return float(np.median(np.sqrt(np.trace(detection.covariances, axis1=1, axis2=2) / 2)))


def _lines(board: Board, seen: Mapping[str, Detection | Rejected]) -> Iterator[str]:
    width = max(map(len, seen))
    total = len(board.points3D)
    yield f"{'photo':<{width}}  corners  sigma px  blur px  remarks"
    for name, detection in seen.items():
        if isinstance(detection, Rejected):
            yield f"{name:<{width}}  {'–':>7}  {'–':>8}  {'–':>7}  {detection.reason}: {detection.detail}"
            continue
        counted = Counter(detection.rejected.values())
        remarks = ", ".join(f"{count} {reason}" for reason, count in sorted(counted.items()))
        blur = f"{detection.blur_px:7.2f}" if detection.blur_px == detection.blur_px else f"{'–':>7}"
        yield f"{name:<{width}}  {len(detection.points2D):>7}  {_sigma(detection):8.4f}  {blur}  {remarks}".rstrip()
    found = [detection for detection in seen.values() if not isinstance(detection, Rejected)]
    corners = sum(len(detection.points2D) for detection in found)
    yield f"{len(found)} of {len(seen)} photos show the board, {corners} of {len(found) * total} corners"
