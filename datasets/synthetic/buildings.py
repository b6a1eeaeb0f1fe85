"""Façades with relief, and the worlds made of them: one façade, a pair of twins, a street."""

from __future__ import annotations

import numpy as np

from datasets.synthetic import materials as m
from datasets.synthetic.shapes import Shape, box, gable, plane, revolved, rock
from datasets.synthetic.world import DAYLIGHT, Sun, World

_DEPTH = 0.4
_FLOOR = 3.2
_WINDOW = (1.2, 1.9)
_SUN = Sun((-0.55, -0.7, 0.75), (0.85, 0.79, 0.68))


def facade(bays: int, floors: int, seed: int) -> list[Shape]:
    """A house front in the plane y = 0, seen from y < 0, centred on x = 0 and standing on z = 0.

    Windows are recesses of 0.4 m with frames, sills and contents of their own; there are ledges between the floors,
    pilasters at the ends, a cornice and a door in the middle. The bays are 2.4 m wide.
    """
    rng = np.random.default_rng([seed, 1])
    tint = rng.uniform(0.85, 1.15, 3)
    wall = (
        m.bricks((0.42 * tint[0], 0.22 * tint[1], 0.15 * tint[2]), seed)
        if seed % 2
        else m.plaster((0.62 * tint[0], 0.54 * tint[1], 0.40 * tint[2]), seed, contrast=0.24)
    )
    trim = m.stone((0.52, 0.49, 0.43), seed + 1)
    pitch = 2.4
    half, height = 0.5 * bays * pitch, floors * _FLOOR
    shapes = [
        box((-half, _DEPTH, 0), (half, _DEPTH + 6, height), wall),
        box((-half - 0.25, -0.35, height), (half + 0.25, 1.0, height + 0.35), trim),
        gable(half, 3.2, 2.2, m.bricks((0.32, 0.13, 0.08), seed + 2, (0.3, 0.25, 0.02))).moved((0, 3.2, height + 0.3)),
    ]
    shapes += [box((x - 0.3, -0.12, 0), (x + 0.3, _DEPTH, height), trim) for x in (-half + 0.3, half - 0.3)]
    for floor in range(1, floors):
        shapes.append(box((-half, -0.18, floor * _FLOOR - 0.12), (half, _DEPTH, floor * _FLOOR + 0.12), trim))
    for bay in range(bays + 1):
        center, wide = -half + bay * pitch, 0.5 * (pitch - _WINDOW[0])
        shapes.append(box((max(-half, center - wide), 0, 0), (min(half, center + wide), _DEPTH, height), wall))
    for bay in range(bays):
        for floor in range(floors):
            place = (-half + (bay + 0.5) * pitch, 0.0, floor * _FLOOR)
            number = seed + 100 + 17 * bay + 5 * floor
            parts = _door(number) if floor == 0 and bay == bays // 2 else _window(number, wall, trim)
            shapes += [part.moved(place) for part in parts]
        if bay != bays // 2:
            low, high = -half + bay * pitch, -half + (bay + 1) * pitch
            shapes.append(box((low, -0.05, 0), (high, 0.1, 0.5), trim))
    return shapes


def _window(seed: int, wall: m.Material, trim: m.Material) -> list[Shape]:
    """One opening, its sill at z = 0.8, with the wall below and above; centred on x = 0."""
    half, low, high = 0.5 * _WINDOW[0], 0.8, 0.8 + _WINDOW[1]
    rng = np.random.default_rng([seed, 2])
    frame = m.wood(m.palette(seed + 1)[rng.integers(2)], seed, board=0.5)
    glass = m.print_(seed, 0.6, ((0.05, 0.06, 0.08), (0.20, 0.20, 0.20), m.palette(seed)[rng.integers(2)]))
    shapes = [
        box((-half, 0, 0), (half, _DEPTH, low), wall),
        box((-half, 0, high), (half, _DEPTH, _FLOOR), wall),
        box((-half - 0.12, -0.16, low - 0.1), (half + 0.12, 0.2, low), trim),
        box((-half - 0.1, -0.06, high), (half + 0.1, 0.05, high + 0.22), trim),
        box((-half, _DEPTH - 0.06, low), (half, _DEPTH - 0.02, high), glass),
        box((-0.03, _DEPTH - 0.12, low), (0.03, _DEPTH - 0.06, high), frame),
    ]
    for z in (low, low + 0.6 * _WINDOW[1], high - 0.06):
        shapes += [box((-half, _DEPTH - 0.12, z), (half, _DEPTH - 0.06, z + 0.06), frame)]
    if rng.random() < 0.4:
        plant = rock(
            (0.5, 0.12, 0.16),
            m.foliage((0.16, 0.26, 0.06), seed, wavelength=0.1),
            roughness=0.2,
            wavelength=0.15,
            seed=seed,
            rows=20,
        )
        shapes.append(plant.moved((0, -0.05, low)))
    return shapes


def _door(seed: int) -> list[Shape]:
    half, high = 0.5 * _WINDOW[0], 2.5
    leaf = m.wood((0.26, 0.14, 0.08), seed, board=0.2)
    return [
        box((-half, _DEPTH - 0.12, 0), (half, _DEPTH - 0.05, high), leaf),
        box((-half, 0, high), (half, _DEPTH, _FLOOR), m.stone((0.5, 0.47, 0.4), seed)),
        box((-half - 0.3, -0.7, high + 0.1), (half + 0.3, 0.1, high + 0.22), m.stone((0.4, 0.38, 0.36), seed + 1)),
        box((-half - 0.2, -0.5, 0), (half + 0.2, 0.05, 0.16), m.stone((0.45, 0.44, 0.42), seed + 2)),
    ]


def tree(seed: int, height: float) -> list[Shape]:
    """A trunk and a crown."""
    bark = m.wood((0.2, 0.14, 0.1), seed, board=0.06)
    leaves = m.foliage((0.13, 0.22, 0.06), seed, wavelength=0.3)
    crown = rock(
        (0.28 * height, 0.28 * height, 0.34 * height),
        leaves,
        roughness=0.18,
        wavelength=0.3 * height,
        seed=seed,
        rows=50,
    )
    trunk = revolved([(0.05 * height, 0), (0.03 * height, 0.2 * height), (0.03 * height, 0.5 * height)], bark, sides=16)
    return [trunk, crown.moved((0, 0, 0.3 * height))]


def _at(shapes: list[Shape], place: tuple[float, float, float], yaw_deg: float = 0.0) -> list[Shape]:
    return [shape.moved(place, yaw_deg) for shape in shapes]


def single_facade(seed: int) -> World:
    """A house front of 14 × 10 m with pavement, trees and boxes before it."""
    shapes = [
        *facade(6, 3, 2 * seed + 1),
        plane(40, 40, m.bricks((0.36, 0.34, 0.32), seed + 3, (0.8, 0.5, 0.02))).moved((0, 0, -0.15)),
        box((-9, -2.2, -0.15), (9, 0, 0), m.stone((0.42, 0.41, 0.4), seed + 4)),
        *_at(facade(4, 2, 2 * seed + 60), (-13.5, 3, -0.15)),
        *_at(facade(4, 2, 2 * seed + 70), (13.5, 3, -0.15)),
        *_at(tree(seed + 5, 4.5), (-6.5, -2.6, -0.15)),
        *_at(tree(seed + 6, 3.2), (7.4, -3.0, -0.15)),
        box((2.2, -1.5, 0), (3.4, -1.0, 0.7), m.print_(seed + 7, 0.4)),
        box((-3.6, -1.3, 0), (-3.0, -0.7, 0.9), m.print_(seed + 8, 0.3)),
    ]
    return World(tuple(shapes), (_SUN,), DAYLIGHT, extent=14.4)


def twin_facades(seed: int) -> World:
    """Two house fronts alike in every detail but a poster, 26 m apart, with different surroundings."""
    front = facade(5, 3, 2 * seed + 1)
    shapes = [
        *_at(front, (-13, 0, 0)),
        *_at(front, (13, 0, 0)),
        plane(60, 40, m.bricks((0.36, 0.34, 0.32), seed + 3, (0.8, 0.5, 0.02))),
        box((-17.0, -0.1, 0.9), (-16.2, 0.0, 2.2), m.print_(seed + 4, 0.5)),
        box((9.0, -0.1, 0.9), (9.8, 0.0, 2.2), m.print_(seed + 5, 0.5)),
        # Between them a garden wall with panels, trees and a hut: the bridge.
        box((-7, 0.3, 0), (7, 0.6, 2.4), m.bricks((0.5, 0.42, 0.3), seed + 6)),
        *[box((-5.6 + 2.8 * k, 0.2, 0.6), (-4 + 2.8 * k, 0.3, 1.9), m.print_(seed + 10 + k, 0.6)) for k in range(5)],
        *_at(facade(3, 2, 2 * seed + 60), (-1.5, 7, 0)),
        *_at(tree(seed + 20, 6.0), (4.6, 3.0, 0)),
        *_at(tree(seed + 21, 4.0), (-5.0, 2.4, 0)),
        # The neighbours at the far ends.
        *_at(facade(4, 2, 2 * seed + 80), (-25, 1.5, 0)),
        *_at(tree(seed + 22, 5.0), (-20.4, -1.2, 0)),
        box((20, 0, 0), (34, 1, 3.0), m.bricks((0.55, 0.5, 0.42), seed + 30, (0.5, 0.25, 0.02))),
        *_at(tree(seed + 23, 6.5), (22.5, 3.5, 0)),
        box((20.5, -1.5, 0), (21.5, -0.5, 1.1), m.print_(seed + 31, 0.5)),
    ]
    return World(tuple(shapes), (_SUN,), DAYLIGHT, extent=40.0)


def street(seed: int) -> World:
    """A street of 60 m along x with houses, trees, parked vans and lamp posts."""
    asphalt = m.stone((0.16, 0.16, 0.165), seed + 1, wavelength=0.8, contrast=0.26)
    walk = m.bricks((0.42, 0.40, 0.37), seed + 2, (0.5, 0.5, 0.015))
    paint = m.stone((0.7, 0.7, 0.68), seed + 3, wavelength=0.1)
    shapes = [plane(90, 3.5, asphalt)]
    for side in (-1, 1):
        low, high = sorted((side * 3.5, side * 7.0))
        shapes.append(box((-90, low, -0.2), (90, high, 0.14), walk))
        for k in range(6):
            house = facade(4 + (k + (side > 0)) % 2, 2 + (k * 7 + side + seed) % 3, 2 * seed + 31 * k + 400 + 17 * side)
            shapes += _at(house, (-4 + 12.5 * k, side * 6.6, 0), 0 if side > 0 else 180)
            shapes += _at(_lamp_post(seed + k), (3 + 12.5 * k, side * 4.0, 0.14))
        for k in range(4):
            shapes += _at(tree(seed + 60 + k + 9 * side, 4.5), (9 + 14.0 * k, side * 4.6, 0.1))
            shapes += _at(_van(seed + 80 + k + 9 * side), (6 + 11.0 * k + 4 * side, side * 2.6, 0))
    shapes += [box((-8 + 3.0 * k, -0.07, 0), (-6.4 + 3.0 * k, 0.07, 0.006), paint) for k in range(30)]
    shapes += _at(facade(7, 4, 2 * seed + 901), (76, 0, 0), -90)
    return World(tuple(shapes), (Sun((-0.75, -0.3, 0.7), (0.85, 0.79, 0.68)),), DAYLIGHT, extent=60.0)


def _lamp_post(seed: int) -> list[Shape]:
    iron = m.stone((0.12, 0.13, 0.12), seed, wavelength=0.1)
    return [
        revolved([(0.12, 0), (0.1, 0.5), (0.05, 0.6), (0.045, 3.6), (0.16, 3.7), (0.2, 4.1), (0, 4.3)], iron, sides=20),
        box((-0.3, -0.02, 1.9), (0.3, 0.02, 2.5), m.print_(seed, 0.3)),
    ]


def _van(seed: int) -> list[Shape]:
    paint = m.print_(seed, 1.4)
    rubber = m.stone((0.05, 0.05, 0.05), seed, wavelength=0.1)
    wheels = [box((x, y, 0), (x + 0.6, y + 0.2, 0.6), rubber) for x in (-1.5, 0.9) for y in (-0.82, 0.62)]
    return [box((-2.1, -0.8, 0.35), (2.1, 0.8, 1.2), paint), box((-2.0, -0.75, 1.2), (1.0, 0.75, 2.0), paint), *wheels]
