"""Circles of a board among blobs, by the lattice that they stand on; some may be missing, and others be in between.

    blobs  →  a seed (two steps that lead to blobs forwards and backwards)  →  growth, each place sought where its
    neighbours want it  →  all ways to lay the board's grid on the lattice; the one that holds most circles

Unlike finders that want the whole grid, this one does with most of it: a circle that the border of the photo cuts, or
that glare hides, costs no photo. Where a board has no first circle, the row nearest to the x axis of the image is one.
A lattice on which the board could lie in several places, as on a perforated wall, is none.
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from calib.boards import Board
from calib.detect_plane import fit_plane_closely
from sfm.core.arrays import Points2D

_NEAREST = 8
_SYMMETRIC = 0.25
"""Distance of a blob from where it is sought, by the step there."""
_SEEDS = 40
_LARGEST = 3.0
"""Times the board's circles: a lattice with more is a wall."""
_SHARE, _SHARE_OF_EDGE = 0.7, 0.5
"""Least part of the circles, and of each outer line, that must be there."""
_OTHERS = 0.25
"""Most places of the lattice outside of the board, by its circles."""
_REGULAR = 0.05
"""Rms distance from the image of a flat board, by the spacing, that a lattice may have; pebbles are at 0.1 and more."""
_AROUND = ((1, 0), (0, 1), (-1, 0), (0, -1))
_STEPS = [
    np.array(m).reshape(2, 2)
    for m in itertools.product((-1, 0, 1), repeat=4)
    if m[0] * m[3] - m[1] * m[2] == 1
]  # fmt: skip
"""Steps of the board by those of the seed, whichever the seed has found."""

_Place = tuple[int, int]


def circles_among(blobs: Points2D, board: Board, size: tuple[int, int]) -> Float64[np.ndarray, "P 2"] | None:
    """Pixels of all circles of the board, in the order of their ids; those that are no blobs where they must be.

    Args:
        size: width and height of the image, px.
    Returns:
        None where the blobs hold no such board.
    """
    count = len(board.points3D)
    if len(blobs) < _SHARE * count:
        return None
    tree, used = KDTree(blobs), np.zeros(len(blobs), bool)
    for seed, first, second in _seeds(blobs, tree):
        if used[seed]:
            continue
        places = _grown(blobs, tree, seed, first, second, round(_LARGEST * count))
        used[list(places.values())] = True
        if not _SHARE * count <= len(places) < _LARGEST * count:
            continue
        ids, points2D = _laid(places, blobs, board)
        if len(ids):
            flat = board.points3D[:, :2]
            out = fit_plane_closely(flat[ids], points2D, size).image(flat)
            off = np.linalg.norm(out[ids] - points2D, axis=1)
            if not np.isfinite(out).all() or np.sqrt(np.mean(off**2)) > _REGULAR * _spacing(out):
                continue
            out[ids] = points2D
            return out
    return None


def _spacing(points2D: Points2D) -> float:
    """Median distance of the nearest neighbour, px."""
    return float(np.median(KDTree(points2D).query(points2D, k=2)[0][:, 1]))


def _seeds(blobs: Points2D, tree: KDTree) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Blobs with two steps such that a blob is at each end of both; the most symmetric ones first."""
    found = []
    nearest = np.asarray(tree.query(blobs, k=min(_NEAREST + 1, len(blobs)))[1])
    for k, near in enumerate(nearest):
        steps = blobs[near[1:]] - blobs[k]
        lengths = np.linalg.norm(steps, axis=1)
        opposite = np.linalg.norm(steps[:, None] + steps, axis=2).min(axis=1) / np.maximum(lengths, 1e-9)
        good = np.flatnonzero(opposite < _SYMMETRIC)
        for a in good[:1]:
            area = steps[a, 0] * steps[good, 1] - steps[a, 1] * steps[good, 0]
            across = good[area > 0.3 * lengths[a] * lengths[good]]
            if len(across):
                found.append((opposite[a] + opposite[across[0]], k, steps[a], steps[across[0]]))
    found.sort(key=lambda row: row[:2])
    return [row[1:] for row in found[:_SEEDS]]


def _grown(
    blobs: Points2D, tree: KDTree, seed: int, first: np.ndarray, second: np.ndarray, most: int
) -> dict[_Place, int]:
    """Blobs by their places on the lattice around a seed."""
    places, taken = {(0, 0): seed}, {seed}
    steps = {(0, 0): np.array([first, second])}
    for place in _queue(steps):
        here = blobs[places[place]]
        for di, dj in _AROUND:
            there = place[0] + di, place[1] + dj
            if there in places:
                continue
            step = np.array([di, dj]) @ steps[place]
            behind = places.get((place[0] - di, place[1] - dj))
            if behind is not None:
                step = here - blobs[behind]
            distance, found = tree.query(here + step)
            if distance > _SYMMETRIC * np.linalg.norm(step) or int(found) in taken:
                continue
            places[there] = int(found)
            taken.add(int(found))
            steps[there] = steps[place].copy()
            steps[there][0 if di else 1] = (di + dj) * (blobs[found] - here)
            if len(places) >= most:
                return places
    return places


def _queue(growing: dict[_Place, np.ndarray]):
    """Keys of a dictionary in the order in which they come, those that come meanwhile as well."""
    done = 0
    while done < len(growing):
        yield list(growing)[done]
        done += 1


def _laid(places: dict[_Place, int], blobs: Points2D, board: Board) -> tuple[np.ndarray, np.ndarray]:
    """Ids of circles and their blobs; empty where the board does not fit, or in several places alike."""
    on_lattice, grid = np.array(list(places)), _lattice_of(board)
    points2D = blobs[list(places.values())]
    edges = _outer_lines(board)
    best, most = (np.empty(0, np.int64), np.empty((0, 2))), (0, -np.inf)
    for steps in _STEPS:
        moved = on_lattice @ steps.T
        shifts, counts = np.unique(
            (grid[:, None] - moved[None]).reshape(-1, 2), axis=0, return_counts=True
        )  # fmt: skip
        order = np.argsort(counts, kind="stable")
        if counts[order[-1]] < max(most[0], _SHARE * len(grid)) or (
            len(order) > 1 and counts[order[-2]] == counts[order[-1]]
        ):
            continue
        numbers = {tuple(place): number for number, place in enumerate(grid.tolist())}
        ids = np.array([numbers.get(tuple(place), -1) for place in (moved + shifts[order[-1]]).tolist()])
        inside = ids >= 0
        there = np.isin(np.arange(len(grid)), ids[inside])
        if (~inside).sum() > _OTHERS * len(grid) or any(there[line].mean() < _SHARE_OF_EDGE for line in edges):
            continue
        rightwards = _rightwards(board, ids[inside], points2D[inside])
        if (int(counts[order[-1]]), rightwards) > most:
            best, most = (ids[inside], points2D[inside]), (int(counts[order[-1]]), rightwards)
    return best


def _lattice_of(board: Board) -> np.ndarray:
    """Whole-numbered places (N, 2) of a board's circles on the lattice of nearest neighbours."""
    x, y = np.rint(board.points3D[:, :2] / board.pitch_m).astype(int).T
    return np.column_stack([(x + y) // 2, (y - x) // 2] if board.kind == "acircles" else [x, y])


def _outer_lines(board: Board) -> list[np.ndarray]:
    """Of each side of the board, the circles of the line that ends it."""
    x, y = np.rint(board.points3D[:, :2] / board.pitch_m).astype(int).T
    return [np.flatnonzero(values == end) for values in (x, y) for end in (values.min(), values.max())]


def _rightwards(board: Board, ids: np.ndarray, points2D: Points2D) -> float:
    """Cosine of the angle from the image's x axis to the board's."""
    flat = board.points3D[ids, :2] - board.points3D[ids, :2].mean(axis=0)
    along = np.linalg.lstsq(flat, points2D - points2D.mean(axis=0), rcond=None)[0][0]
    return float(along[0] / np.linalg.norm(along))
