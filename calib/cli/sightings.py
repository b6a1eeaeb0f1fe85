"""What photos of one camera show of a board: the views that calibration is given, and the photos that give none.

    photos, or corners that someone else found  →  `see_board`  →  Sightings

Commands share this: what is left out carries its reason from the photo on, whoever left it out.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from calib.board_turns import board_turns
from calib.boards import Board
from calib.cli.corner_files import corner_files, read_corners
from calib.cli.photos import detect_photos, detection_cache, find_photos
from calib.detect import Detection
from calib.refine_copies import without_near_copies
from calib.refine_views import BoardView, RejectedView
from sfm.core.arrays import Points3D, Value
from sfm.core.errors import ConfigError, Rejected
from sfm.core.events import SILENT, Observer
from sfm.io.images import list_images

_IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".heic", ".jp2")
UNNAMED = re.compile(r"a board of \d+ points")
"""What files call a board whose corners have places, and which has no other name."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Sightings(Value):
    """What photos of one camera show of a board.

    Attributes:
        board: what was looked for; None where corners came from elsewhere without saying of what.
        points3D: (P, 3) its points, metres.
        views: of the photos that show it, in the order of the photos.
        left_out: photos that do not, and why.
        digest: of the contents of all files, in their order.
        kind: what the files are: photos, corners.
    """

    board: Board | None
    points3D: Points3D
    views: tuple[BoardView, ...]
    left_out: tuple[RejectedView, ...]
    digest: str
    kind: str = "photos"

    @property
    def count(self) -> int:
        """Of photos, whether they show the board or not."""
        return len(self.views) + len(self.left_out)


def see_board(
    sources: Sequence[Path], board: Board | None, *, size: tuple[int, int] | None = None, threads: int = 0,
    use_cache: bool = True, weighted: bool = False, observer: Observer = SILENT,
) -> Sightings:  # fmt: skip
    """Looks for a board in photos, or reads corners that were found before.

    Args:
        sources: folders of photos, photos, or files of corners; see `corner_files`.
        board: may be None for files that name it.
        size: width and height in px, for files of corners that do not tell it.
        threads: 0 for all cores.
        use_cache: takes what was found before, and keeps what is found.
        weighted: views carry the covariances of their corners. They tell how well a corner's pixels fix it, but not
            what its surroundings shift it by, which is most: with them, held-out views of nine sets of photos come out
            0 to 10 % worse.
    Raises:
        InputError: there are no photos, or a file of corners does not do.
        ConfigError: there is no board, or no size where it is needed.
    """
    files = corner_files(sources)
    if files:
        found, points3D, views, left_out = read_corners(files, board, size)
        return Sightings(found, points3D, views, left_out, _digest_of(files), "corners")
    if board is None:
        raise ConfigError("no board is named", remedy="for example --board chessboard:9x6:25mm (inner corners)")
    photos = find_photos(sources)
    cache = detection_cache() if use_cache else None
    seen = detect_photos(photos, board, threads=threads, cache=cache, observer=observer)
    views, left_out = _sorted_out(seen, board, weighted=weighted)
    return Sightings(board, board.points3D, views, (*_not_images(sources), *left_out), _digest_of(photos))


def _not_images(sources: Sequence[Path]) -> list[RejectedView]:
    """Files in folders that are images by their suffix only."""
    skipped = [pair for source in sources if source.is_dir() for pair in list_images(source).skipped]
    return [
        RejectedView(name, "unreadable", why) for name, why in skipped if Path(name).suffix.lower() in _IMAGE_SUFFIXES
    ]


def _sorted_out(
    seen: Mapping[str, Detection | Rejected], board: Board, *, weighted: bool = True
) -> tuple[tuple[BoardView, ...], tuple[RejectedView, ...]]:
    """Views of the photos that show the board, each once, and the others with the reason."""
    views, left_out = [], []
    for name, detection in seen.items():
        if isinstance(detection, Rejected):
            left_out.append(RejectedView(name, detection.reason, detection.detail))
        else:
            views.append(_view_of(detection, weighted=weighted))
    views, copies = without_near_copies(views, board_turns(board))
    return tuple(views), (*left_out, *copies)


def _view_of(detection: Detection, *, weighted: bool = True) -> BoardView:
    """A detection as calibration wants it."""
    return BoardView(
        detection.name,
        detection.width,
        detection.height,
        detection.corner_ids,
        detection.points2D,
        detection.covariances if weighted else None,
    )


def _digest_of(files: Mapping[str, Path]) -> str:
    """Of the contents in this order, whatever the names; a file that cannot be read counts as empty."""
    digest = hashlib.blake2b(digest_size=16)
    for path in files.values():
        try:
            digest.update(hashlib.blake2b(path.read_bytes(), digest_size=16).digest())
        except OSError:
            digest.update(bytes(16))
    return digest.hexdigest()
