"""The world of the orbit: objects on a table in a walled courtyard."""

from __future__ import annotations

import numpy as np

from datasets.synthetic import materials as m
from datasets.synthetic.shapes import Shape, box, plane, revolved, rock
from datasets.synthetic.world import DAYLIGHT, Sun, World

_TABLE_HEIGHT = 0.75


def still_life(seed: int) -> World:
    """A table of 1.6 m with a rock, a vase, a bowl and books; walls seven metres away."""
    shapes = [*_courtyard(seed), *_table(seed)]
    shapes += [shape.moved((0, 0, _TABLE_HEIGHT)) for shape in _objects(seed)]
    return World(tuple(shapes), (Sun((0.5, -0.45, 0.8), (0.95, 0.88, 0.76)),), DAYLIGHT, extent=1.6)


def _courtyard(seed: int) -> list[Shape]:
    paving = m.bricks((0.40, 0.36, 0.31), seed + 1, (0.6, 0.4, 0.015))
    walls = [m.bricks((0.42, 0.2 + 0.04 * k, 0.13 + 0.05 * k), seed + 2 + k) for k in range(4)]
    shapes = [plane(12, 12, paving)]
    for k, wall in enumerate(walls):
        panel = m.print_(seed + 30 + k, 0.9)
        parts = [
            box((-7.2, 7.0, 0), (7.2, 7.3, 2.6), wall),
            box((-7.2, 6.9, 2.6), (7.2, 7.4, 2.75), m.stone((0.5, 0.48, 0.44), seed + 9)),
        ]
        parts += [box((-4.5 + 3.1 * j, 6.94, 0.7), (-2.9 + 3.1 * j, 7.0, 1.9), panel) for j in range(3)]
        shapes += [part.moved((0, 0, 0), 90 * k) for part in parts]
    for k in range(8):
        turn = 0.4 + k * np.pi / 4
        bush = rock(
            (0.6, 0.5, 0.6),
            m.foliage((0.12, 0.2, 0.05), seed + 40 + k, wavelength=0.2),
            roughness=0.14,
            wavelength=0.4,
            seed=seed + k,
            rows=40,
        )
        shapes.append(bush.moved((5.6 * np.cos(turn), 5.6 * np.sin(turn), 0)))
    return shapes


def _table(seed: int) -> list[Shape]:
    top = m.wood((0.42, 0.27, 0.15), seed + 50)
    shapes = [box((-0.8, -0.8, _TABLE_HEIGHT - 0.04), (0.8, 0.8, _TABLE_HEIGHT), top)]
    for x in (-0.72, 0.64):
        shapes += [box((x, y, 0), (x + 0.08, y + 0.08, _TABLE_HEIGHT - 0.04), top) for y in (-0.72, 0.64)]
    return shapes


def _objects(seed: int) -> list[Shape]:
    """Standing on z = 0."""
    shapes = [
        box(
            (-0.62, -0.55, 0),
            (0.62, 0.5, 0.004),
            m.print_(seed + 60, 0.3, ((0.5, 0.43, 0.32), (0.30, 0.10, 0.08), (0.1, 0.15, 0.3))),
        ),
        rock(
            (0.2, 0.17, 0.27),
            m.stone((0.52, 0.45, 0.36), seed + 61, wavelength=0.12),
            roughness=0.2,
            wavelength=0.25,
            seed=seed + 61,
        ).moved((0.0, 0.05, 0)),
        revolved(
            [
                (0, 0.001),
                (0.06, 0),
                (0.09, 0.05),
                (0.105, 0.12),
                (0.085, 0.2),
                (0.045, 0.26),
                (0.05, 0.31),
                (0.065, 0.33),
                (0.05, 0.325),
                (0.035, 0.27),
            ],
            m.print_(seed + 62, 0.1, ((0.75, 0.72, 0.62), (0.55, 0.6, 0.62), (0.05, 0.12, 0.35))),
            sides=72,
        ).moved((-0.38, -0.12, 0)),
        revolved(
            [(0, 0.001), (0.06, 0), (0.07, 0.015), (0.13, 0.07), (0.15, 0.11), (0.14, 0.11), (0.11, 0.06), (0.0, 0.03)],
            m.print_(seed + 63, 0.08),
            sides=72,
        ).moved((0.38, -0.28, 0)),
    ]
    for k, (radius, place) in enumerate(
        [(0.05, (0.36, -0.31, 0.04)), (0.045, (0.43, -0.25, 0.045)), (0.06, (-0.2, -0.4, 0))]
    ):
        fruit = m.stone(((0.5, 0.12, 0.06), (0.5, 0.4, 0.06), (0.25, 0.4, 0.08))[k], seed + 70 + k, wavelength=0.05)
        shapes.append(rock((radius,) * 3, fruit, roughness=0.03, wavelength=0.05, seed=seed + k, rows=36).moved(place))
    height = 0.0
    rng = np.random.default_rng([seed, 4])
    for k in range(4):
        thick = float(rng.uniform(0.025, 0.05))
        book = box((-0.15, -0.11, 0), (0.15, 0.11, thick), m.print_(seed + 80 + k, 0.12))
        shapes.append(book.moved((0.42, 0.28, height), float(rng.uniform(-40, 40))))
        height += thick
    shapes.append(box((-0.09, -0.09, 0), (0.09, 0.09, 0.18), m.print_(seed + 90, 0.09)).moved((-0.33, 0.32, 0), 25))
    return shapes
