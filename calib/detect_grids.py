"""Where a board is, roughly: OpenCV's finders, tried one after the other.

No finder of chessboards is best everywhere: on 141 photos of nine sets the older one misses 11 boards, the newer one
6 to 11 depending on its options, and all together two, both of which are cut by the border. Positions are good to a
pixel or two; `detect_crossings` and `detect_circles` make them precise.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import UInt8

from calib.boards import Board
from calib.boards_artwork import marker_dictionary
from calib.detect_lattice import circles_among
from sfm.core.arrays import Indices, Points2D
from sfm.core.imaging.resample import resize

Grey = UInt8[np.ndarray, "H W"]
Found = tuple[str, Indices, Points2D]
"""Which finder it was; ids of corners and their pixels."""

_SEARCH_SIZE_PX = 1600
"""Larger photos are shrunk first: finders slow down, and noise and texture mislead them."""
_SMALL_PX = 800
_OPENCV_HALF = 0.5
_MOST_BLOBS = 4
"""Times the circles of a board."""


def candidates(grey: Grey, board: Board) -> Iterator[Found]:
    """What the finders see, from the quickest finder to the most patient; drawn one by one, as needed."""
    match board.kind:
        case "chessboard":
            yield from _chessboards(grey, board)
        case "charuco":
            yield from _charucos(grey, board)
        case "aprilgrid":
            yield from _aprilgrids(grey, board)
        case _:
            yield from _circles(grey, board)


# Chessboards


def _chessboards(grey: Grey, board: Board) -> Iterator[Found]:
    plain = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    patient = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    for image in _sizes(grey):
        shrunk = f" at {image.shape[1]} px" if image.shape != grey.shape else ""
        found, corners = cv2.findChessboardCorners(image, board.grid, flags=plain)
        if found:
            yield _complete(f"quads{shrunk}", corners, image, grey)
        for name, flags in (("patient", patient), ("normalised", patient | cv2.CALIB_CB_NORMALIZE_IMAGE), ("", 0)):
            found, corners = cv2.findChessboardCornersSB(image, board.grid, flags=flags)
            if found:
                yield _complete(f"sectors {name}{shrunk}".replace("  ", " ").strip(), corners, image, grey)


def _sizes(grey: Grey) -> Iterator[Grey]:
    """The photo, smaller where it is large, at last larger where it is small."""
    height, width = grey.shape
    longest = max(height, width)
    sizes = [_SEARCH_SIZE_PX, _SMALL_PX] if longest > _SEARCH_SIZE_PX else [longest, _SMALL_PX]
    for size in dict.fromkeys(size for size in sizes if size <= longest):
        yield resize(grey, round(width * size / longest), round(height * size / longest))
    if longest > _SEARCH_SIZE_PX:
        yield grey
    elif longest <= _SMALL_PX:
        yield resize(grey, 2 * width, 2 * height)


def _complete(name: str, corners: np.ndarray, image: np.ndarray, grey: np.ndarray) -> Found:
    points = _in_pixels(corners, image, grey)
    return name, np.arange(len(points)), points


def _in_pixels(corners: np.ndarray, image: np.ndarray, grey: np.ndarray) -> Points2D:
    """From OpenCV's coordinates in a resized image to pixels of the photo."""
    ratio = np.array([grey.shape[1] / image.shape[1], grey.shape[0] / image.shape[0]])
    return (np.asarray(corners, np.float64).reshape(-1, 2) + _OPENCV_HALF) * ratio


# Markers


def _charucos(grey: Grey, board: Board) -> Iterator[Found]:
    """The board in both layouts; white on black, as heat cameras may show it, where no black marker is seen."""
    parameters = cv2.aruco.CharucoParameters()
    parameters.minMarkers = 1
    size, dictionary = (board.columns, board.rows), marker_dictionary(board.dictionary)
    for image in _sizes_for_markers(grey):
        for inverted in (False, True):
            best: Found | None = None
            markers = _marker_parameters(1)
            markers.detectInvertedMarker = inverted
            for legacy in (False, True) if board.rows % 2 == 0 else (False,):
                # The ratio of the lengths matters, their unit does not.
                layout = cv2.aruco.CharucoBoard(size, 1.0, board.detail_m / board.pitch_m, dictionary)
                layout.setLegacyPattern(legacy)
                corners, ids, _, _ = cv2.aruco.CharucoDetector(layout, parameters, markers).detectBoard(image)
                if ids is None or not len(ids) or (best and len(ids) <= len(best[1])):
                    continue
                name = "markers" + ", white on black" * inverted + ", older layout" * legacy
                best = name, np.asarray(ids).reshape(-1).astype(np.int64), _in_pixels(corners, image, grey)
            if best:
                yield best
                break


def _aprilgrids(grey: Grey, board: Board) -> Iterator[Found]:
    """Tags by OpenCV's finder of squares, and by that of the AprilTag library, which bears edges that bend."""
    dictionary = marker_dictionary(board.dictionary)
    tags: dict[int, Points2D] = {}
    for image in _sizes_for_markers(grey):
        for by_gradients in (False, True):
            parameters = _marker_parameters(2)
            searched = image
            if by_gradients:
                parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
                searched = _no_larger(image, _SEARCH_SIZE_PX)
            corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(searched)
            for number, quad in zip(np.asarray([] if ids is None else ids).reshape(-1), corners, strict=True):
                if number < board.columns * board.rows:
                    # Kalibr's tags stand on their heads: OpenCV starts at the bottom right and goes to the bottom left.
                    tags.setdefault(int(number), _in_pixels(quad, searched, grey)[[1, 0, 3, 2]])
            if tags:
                numbers = sorted(tags)
                ids_of_corners = (4 * np.array(numbers)[:, None] + np.arange(4)).reshape(-1)
                yield "tags", ids_of_corners, np.concatenate([tags[number] for number in numbers])


def _no_larger(image: Grey, longest: int) -> Grey:
    ratio = min(1.0, longest / max(image.shape))
    return resize(image, round(image.shape[1] * ratio), round(image.shape[0] * ratio)) if ratio < 1 else image


def _sizes_for_markers(grey: Grey) -> Iterator[Grey]:
    """The photo, and larger where it is small: cells of less than two pixels cannot be read."""
    yield grey
    for times, longest in ((2, _SEARCH_SIZE_PX), (3, _SMALL_PX)):
        if max(grey.shape) <= longest:
            yield resize(grey, times * grey.shape[1], times * grey.shape[0])


def _marker_parameters(border_cells: int) -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_cells
    parameters.minMarkerPerimeterRate = 0.01
    return parameters


# Circles


def _circles(grey: Grey, board: Board) -> Iterator[Found]:
    """By our own finder, which does with most of the circles, then OpenCV's; dark ones first, then light ones."""
    layout = cv2.CALIB_CB_ASYMMETRIC_GRID if board.kind == "acircles" else cv2.CALIB_CB_SYMMETRIC_GRID
    for image, light in itertools.product(_sizes(grey), (False, True)):
        shown = 255 - image if light else image
        told = ", light" if light else ""
        for detector in (_blob_detector(image), cv2.SimpleBlobDetector.create()):
            blobs = np.array([blob.pt for blob in detector.detect(shown)], np.float32).reshape(-1, 2)
            centres = circles_among(blobs.astype(np.float64), board, (image.shape[1], image.shape[0]))
            if centres is not None:
                yield _complete(f"lattice{told}", centres, image, grey)
            # Its search among many blobs does not end.
            if not len(board.points3D) <= len(blobs) <= _MOST_BLOBS * len(board.points3D):
                continue
            for clustering in (0, cv2.CALIB_CB_CLUSTERING):
                found, corners = cv2.findCirclesGrid(
                    shown, board.grid, flags=layout | clustering, blobDetector=detector
                )
                if found:
                    yield _complete(f"{'clusters' if clustering else 'blobs'}{told}", corners, image, grey)


def _blob_detector(image: Grey) -> cv2.SimpleBlobDetector:
    """Dark blobs of any size and slant; OpenCV's defaults refuse those over 5000 px²."""
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea, parameters.maxArea = 12.0, image.size / 8
    parameters.minDistBetweenBlobs = 3.0
    parameters.filterByInertia = False
    parameters.minConvexity = 0.8
    return cv2.SimpleBlobDetector.create(parameters)
