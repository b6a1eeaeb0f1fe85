"""The world of the room: furniture, shelves, pictures and two lamps."""

from __future__ import annotations

import numpy as np

from datasets.synthetic import materials as m
from datasets.synthetic.shapes import Shape, box, revolved, rock
from datasets.synthetic.world import Ambient, Lamp, World

_HALF_X, _HALF_Y, _HIGH = 3.0, 2.4, 2.7


def living_room(seed: int) -> World:
    """A room of 6 × 4.8 × 2.7 m around the origin, floor at z = 0."""
    shapes = [*_walls(seed), *_furniture(seed), *_shelf(seed), *_pictures(seed)]
    lamps = (Lamp((-1.2, 0.5, 1.95), (1.75, 1.6, 1.35)), Lamp((1.4, -0.4, 1.95), (1.6, 1.5, 1.3)))
    ambient = Ambient(above=(0.30, 0.29, 0.27), below=(0.20, 0.18, 0.16))
    return World(tuple(shapes), lamps, ambient, extent=6.0)


def _walls(seed: int) -> list[Shape]:
    thick = 0.2
    x, y, z = _HALF_X, _HALF_Y, _HIGH
    colours = ((0.60, 0.55, 0.42), (0.50, 0.56, 0.56), (0.60, 0.50, 0.46), (0.52, 0.56, 0.44))
    wall = [m.wallpaper(colour, seed + k) for k, colour in enumerate(colours)]
    skirting = m.wood((0.5, 0.46, 0.4), seed + 5)
    return [
        box((-x, -y, -thick), (x, y, 0), m.wood((0.40, 0.25, 0.14), seed + 6, board=0.16)),
        box((-x, -y, z), (x, y, z + thick), m.plaster((0.66, 0.64, 0.6), seed + 7)),
        box((-x - thick, -y, 0), (-x, y, z), wall[0]),
        box((x, -y, 0), (x + thick, y, z), wall[1]),
        box((-x, -y - thick, 0), (x, -y, z), wall[2]),
        box((-x, y, 0), (x, y + thick, z), wall[3]),
        *[box((-x, s * y - 0.02, 0), (x, s * y + 0.02, 0.12), skirting) for s in (-1, 1)],
        *[box((s * x - 0.02, -y, 0), (s * x + 0.02, y, 0.12), skirting) for s in (-1, 1)],
        box(
            (-1.2, -0.9, 0),
            (1.3, 0.9, 0.012),
            m.print_(seed + 8, 0.6, ((0.35, 0.08, 0.07), (0.1, 0.12, 0.25), (0.5, 0.4, 0.2))),
        ),
    ]


def _furniture(seed: int) -> list[Shape]:
    oak, cloth = (
        m.wood((0.36, 0.22, 0.12), seed + 20),
        m.print_(seed + 21, 0.25, ((0.15, 0.2, 0.32), (0.25, 0.3, 0.4), (0.4, 0.38, 0.3))),
    )
    return [
        # A low table with a bowl and books, in the middle.
        box((-0.5, -0.3, 0.38), (0.5, 0.3, 0.42), oak),
        *[
            box((sx * 0.42, sy * 0.24, 0), (sx * 0.42 + 0.06, sy * 0.24 + 0.06, 0.38), oak)
            for sx in (-1, 0.9)
            for sy in (-1, 0.8)
        ],
        revolved(
            [(0, 0.42), (0.06, 0.42), (0.13, 0.48), (0.14, 0.52), (0.13, 0.52), (0, 0.45)],
            m.print_(seed + 22, 0.08),
            sides=48,
        ).moved((0.2, 0.05, 0)),
        box((-0.3, -0.2, 0.42), (-0.05, -0.02, 0.46), m.print_(seed + 23, 0.1)),
        # A sofa at y < 0.
        box((-1.1, -2.3, 0.1), (1.1, -1.5, 0.45), cloth),
        box((-1.1, -2.35, 0.45), (1.1, -2.1, 0.95), cloth),
        *[box((x, -2.3, 0.1), (x + 0.22, -1.5, 0.65), cloth) for x in (-1.3, 1.1)],
        box((-0.9, -2.1, 0.45), (-0.45, -1.95, 0.8), m.print_(seed + 24, 0.2)),
        box((0.4, -2.1, 0.45), (0.85, -1.93, 0.82), m.print_(seed + 25, 0.2)),
        # A chest at x > 0 with a plant on it, and a stool.
        box((2.4, -0.8, 0), (2.95, 0.7, 0.8), oak),
        *[
            box(
                (2.37, -0.75 + 0.5 * k, 0.1),
                (2.4, -0.3 + 0.5 * k, 0.72),
                m.wood((0.5, 0.34, 0.2), seed + 26 + k, board=0.45),
            )
            for k in range(3)
        ],
        revolved(
            [(0.1, 0.8), (0.14, 1.0), (0.0, 1.0)], m.stone((0.45, 0.2, 0.12), seed + 30, wavelength=0.05), sides=32
        ).moved((2.65, 0.3, 0)),
        rock(
            (0.25, 0.25, 0.3),
            m.foliage((0.12, 0.24, 0.06), seed + 31, wavelength=0.1),
            roughness=0.25,
            wavelength=0.2,
            seed=seed,
            rows=50,
        ).moved((2.62, 0.3, 0.98)),
        box((2.45, -0.6, 0.8), (2.8, -0.25, 1.05), m.print_(seed + 32, 0.15)),
        box((-2.3, -2.2, 0), (-1.7, -1.6, 0.5), m.print_(seed + 33, 0.3)),
    ]


def _shelf(seed: int) -> list[Shape]:
    """A shelf of books along the wall y > 0."""
    rng = np.random.default_rng([seed, 5])
    oak = m.wood((0.3, 0.18, 0.1), seed + 40)
    x0, x1, y0, y1 = -1.9, 1.1, 2.02, 2.38
    shapes = [box((x, y0, 0), (x + 0.04, y1, 2.1), oak) for x in (x0, -0.42, x1)]
    shapes.append(box((x0, y1 - 0.02, 0), (x1, y1, 2.1), oak))
    for level in range(6):
        z = 0.06 + 0.4 * level
        shapes.append(box((x0, y0, z), (x1 + 0.04, y1, z + 0.035), oak))
        x = x0 + 0.06
        while level < 5 and x < x1 - 0.1:
            thick, tall, deep = rng.uniform(0.025, 0.07), rng.uniform(0.2, 0.33), rng.uniform(0.02, 0.12)
            if rng.random() < 0.9 and not -0.46 - thick < x < -0.38:
                cover = m.print_(seed + 200 + len(shapes), 0.16)
                shapes.append(box((x, y0 + deep, z + 0.035), (x + thick, y1 - 0.03, z + 0.035 + tall), cover))
            x += thick + 0.004
    return shapes


def _pictures(seed: int) -> list[Shape]:
    """Framed pictures on three walls."""
    frame = m.wood((0.25, 0.16, 0.08), seed + 60, board=0.3)
    shapes: list[Shape] = []
    for k, (x, z, w, h) in enumerate([(-1.9, 1.5, 0.45, 0.4), (-0.4, 1.65, 0.6, 0.35), (1.4, 1.6, 0.4, 0.5)]):
        shapes += [
            box((x - w, -_HALF_Y, z - h), (x + w, -_HALF_Y + 0.03, z + h), frame),
            box(
                (x - w + 0.06, -_HALF_Y, z - h + 0.06),
                (x + w - 0.06, -_HALF_Y + 0.035, z + h - 0.06),
                m.print_(seed + 70 + k, 0.35),
            ),
        ]
    for side in (-1, 1):
        for k, (y, z, w, h) in enumerate([(-1.3, 1.6, 0.4, 0.5), (0.2, 1.75, 0.5, 0.35), (1.5, 1.6, 0.3, 0.4)]):
            flat = sorted((side * _HALF_X, side * (_HALF_X - 0.03)))
            deep = sorted((side * _HALF_X, side * (_HALF_X - 0.035)))
            shapes += [
                box((flat[0], y - w, z - h), (flat[1], y + w, z + h), frame),
                box(
                    (deep[0], y - w + 0.06, z - h + 0.06),
                    (deep[1], y + w - 0.06, z + h - 0.06),
                    m.print_(seed + 80 + k + 9 * side, 0.35),
                ),
            ]
    shapes.append(box((2.98, -2.3, 0), (3.0, -1.5, 2.05), m.wood((0.45, 0.33, 0.22), seed + 95, board=0.4)))
    return shapes
