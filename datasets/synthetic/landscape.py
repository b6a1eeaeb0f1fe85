"""The world of the survey flight: hills with rock, a village, trees and a road."""

from __future__ import annotations

import numpy as np

from datasets.synthetic import materials as m
from datasets.synthetic.shapes import Shape, box, gable, noise, rock, surface, terrain
from datasets.synthetic.world import DAYLIGHT, Sun, World

HALF = 220.0
"""Half the side of the land, metres."""


def hills(seed: int) -> World:
    """Land of 440 × 440 m with 40 m of relief."""

    def height(flat: np.ndarray) -> np.ndarray:
        return 20 * noise(flat, 260.0, seed, octaves=2) + 5 * noise(flat, 45.0, seed + 1, octaves=6, gain=0.55)

    shapes = [terrain(HALF, 2.0, height, m.ground(seed + 2, wavelength=25.0, rock_below=0.86))]
    shapes += [_road(seed, height), *_village(seed, height), *_woods(seed, height)]
    return World(tuple(shapes), (Sun((-0.6, -0.45, 0.62), (1.05, 0.96, 0.82)),), DAYLIGHT, extent=150.0)


def _heights(height, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    flat = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    return height(flat).reshape(x.shape)


def _road(seed: int, height) -> Shape:
    """A strip of 6 m that winds along x and lies just above the land."""

    def point(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        x, y = u, 14 * np.sin(u / 45.0) + v
        # Level across, at the highest of its width, so that the land does not pierce it.
        across = np.linspace(-4, 4, 9)
        top = np.max([_heights(height, x, 14 * np.sin(u / 45.0) + a) for a in across], axis=0)
        return x, y, top + 0.25

    asphalt = m.stone((0.24, 0.235, 0.23), seed + 3, wavelength=3.0, contrast=0.24)
    return surface(point, np.arange(-HALF, HALF, 2.0), np.array([-3.0, -1.0, 1.0, 3.0]), asphalt)


def _village(seed: int, height) -> list[Shape]:
    rng = np.random.default_rng([seed, 6])
    shapes, centers = [], [(0.0, 500.0)]
    for k in range(90):
        x, side, away = rng.uniform(-150, 150), rng.choice([-1, 1]), rng.uniform(14, 75)
        y = 14 * np.sin(x / 45.0) + side * away
        if np.min(np.hypot(*(np.array(centers) - (x, y)).T)) < 17:
            continue
        centers.append((x, y))
        long, wide, high = rng.uniform(4.5, 9), rng.uniform(3.5, 5.5), rng.uniform(3, 7)
        ground_z = float(height(np.array([[x, y, 0.0]]))[0])
        warm = rng.uniform(0.6, 1.2, 3)
        roof = m.bricks((0.38 * warm[0], 0.17 * warm[1], 0.10 * warm[2]), seed + 300 + k, (0.9, 0.5, 0.06))
        wall = m.plaster((0.6, 0.54, 0.44), seed + 400 + k)
        place, yaw = (float(x), float(y), ground_z), float(rng.uniform(0, 180))
        shapes += [
            box((-long, -wide, -4), (long, wide, high), wall).moved(place, yaw),
            gable(long, wide, 0.6 * wide, roof, overhang=0.5).moved((place[0], place[1], ground_z + high), yaw),
            box(
                (0.3 * long, 0.2, high),
                (0.3 * long + 0.9, 1.0, high + 0.6 * wide + 0.8),
                m.bricks((0.4, 0.2, 0.15), seed + k),
            ).moved(place, yaw),
        ]
    return shapes


def _woods(seed: int, height) -> list[Shape]:
    rng = np.random.default_rng([seed, 7])
    crowns = []
    for k in range(240):
        x, y = rng.uniform(-HALF + 10, HALF - 10, 2)
        if abs(y - 14 * np.sin(x / 45.0)) < 10 or noise(np.array([[x, y, 0.0]]), 90.0, seed + 9, octaves=2)[0] < -0.15:
            continue
        radius = rng.uniform(2.0, 4.5)
        r, g, b = rng.uniform(0.7, 1.3, 3)
        leaves = m.foliage((0.11 * r, 0.19 * g, 0.055 * b), seed + 500 + k, wavelength=2.0)
        crown = rock((radius, radius, 1.2 * radius), leaves, roughness=0.2, wavelength=2.5, seed=seed + k, rows=20)
        crowns.append(crown.moved((float(x), float(y), float(height(np.array([[x, y, 0.0]]))[0]) - 0.3)))
    return crowns
