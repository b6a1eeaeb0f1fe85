from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from datasets.synthetic import _texture_kernels as kernels
from datasets.synthetic import materials as m
from datasets.synthetic.shapes import noise

ALL = {
    "plaster": m.plaster((0.6, 0.5, 0.4), 3),
    "stone": m.stone((0.5, 0.5, 0.5), 4),
    "bricks": m.bricks((0.4, 0.2, 0.1), 5),
    "wood": m.wood((0.4, 0.3, 0.2), 6),
    "print": m.print_(7, 0.3),
    "wallpaper": m.wallpaper((0.6, 0.5, 0.4), 8),
    "foliage": m.foliage((0.1, 0.2, 0.05), 9),
    "ground": m.ground(10, wavelength=1.0),
}


def reflectance(material: m.Material, points: np.ndarray, footprint: float) -> np.ndarray:
    out, row, up = np.empty((len(points), 3)), material.row(), np.array([0.0, 0.0, 1.0])
    for value, point in zip(out, points, strict=True):
        kernels.albedo(value, row, point, up, footprint)
    return out


def slow_value_noise(x: float, y: float, z: float, seed: int) -> float:
    """The definition, in Python's integers."""

    def scramble(h: int) -> int:
        for _ in range(2):
            h = ((h ^ (h >> 16)) * 0x45D9F3B) % 2**32
        return h ^ (h >> 16)

    def corner(i: int, j: int, k: int) -> float:
        mixed = (i * 0x0DA66343) ^ (j * 0x58163841) ^ (k * 0x4B1AB31F) ^ (seed * 0x165667B1)
        return 2 * scramble(mixed % 2**32) / (2**32 - 1) - 1

    base = [int(np.floor(c)) for c in (x, y, z)]
    t = [c - b for c, b in zip((x, y, z), base, strict=True)]
    weights = [6 * c**5 - 15 * c**4 + 10 * c**3 for c in t]
    total = 0.0
    for bits in np.ndindex(2, 2, 2):
        share = np.prod([w if bit else 1 - w for w, bit in zip(weights, bits, strict=True)])
        total += share * corner(*(b + bit for b, bit in zip(base, bits, strict=True)))
    return float(total)


def test_value_noise_is_the_quintic_blend_of_hashed_corners(rng):
    for x, y, z in rng.uniform(-1e4, 1e4, (100, 3)):
        assert kernels.value_noise(x, y, z, 5) == pytest.approx(slow_value_noise(x, y, z, 5), abs=1e-9)


def test_noise_is_continuous_across_lattice_planes():
    for axis in range(3):
        below, above = np.full(3, 0.3), np.full(3, 0.3)
        below[axis], above[axis] = 2 - 1e-9, 2 + 1e-9
        assert kernels.value_noise(*below, 1) == pytest.approx(kernels.value_noise(*above, 1), abs=1e-7)


def test_noise_has_the_moments_of_blended_uniform_numbers(rng):
    values = np.array([kernels.value_noise(*p, 2) for p in rng.uniform(-100, 100, (8000, 3))])
    t = np.linspace(0, 1, 1001)
    w = 6 * t**5 - 15 * t**4 + 10 * t**3
    spread = np.sqrt((w**2 + (1 - w) ** 2).mean() ** 3 / 3)
    assert abs(values.mean()) < 4 * spread / np.sqrt(8000)
    assert np.abs(values).max() <= 1
    assert values.std() == pytest.approx(spread, rel=0.03)


def test_detail_finer_than_the_footprint_is_gone(rng):
    points = rng.uniform(-5, 5, (200, 3))
    values = np.array([kernels.fbm(*p, 1.0, 2.5, 24, 0.9, 3) for p in points])
    assert np.all(values == 0)
    finest = [np.std([kernels.fbm(*p, 1.0, w, 24, 0.9, 3) for p in points]) for w in (0.01, 0.1, 0.5, 1.0)]
    assert np.all(np.diff(finest) < 0)


def test_the_filtered_texture_is_the_mean_over_the_pixels_filter(rng):
    """The claim of the module: noise at footprint w is fine noise averaged by a Gaussian of variance w² / 6."""
    footprint = 0.08
    filtered, averaged = [], []
    for point in rng.uniform(-5, 5, (150, 3)):
        cloud = point + rng.normal(scale=footprint / np.sqrt(6), size=(600, 3))
        averaged.append(noise(cloud, 1.0, 3, octaves=9, gain=0.9).mean())
        filtered.append(kernels.fbm(*point, 1.0, footprint, 9, 0.9, 3))
    error = np.std(np.subtract(filtered, averaged)) / np.std(averaged)
    assert np.corrcoef(filtered, averaged)[0, 1] > 0.97
    assert error < 0.25


def test_texture_is_rich_at_every_scale(rng):
    """Neighbours at any distance from a millimetre to ten centimetres differ by a fair part of the contrast."""
    for name, material in ALL.items():
        points = np.concatenate([rng.uniform(-2, 2, (300, 2)), np.zeros((300, 1))], axis=1)
        for step in (0.001, 0.01, 0.1):
            near = reflectance(material, points, 0.3 * step)
            far = reflectance(material, points + (step, 0, 0), 0.3 * step)
            change = np.abs(np.log(near) - np.log(far)).mean()
            assert 0.02 < change < 1.0, (name, step)


@pytest.mark.parametrize("name", ALL)
def test_reflectance_is_physical_and_depends_on_position_and_seed_only(name, rng):
    points = rng.uniform(-20, 20, (300, 3))
    first = reflectance(ALL[name], points, 0.002)
    assert np.all((first > 0) & (first <= 0.95))
    np.testing.assert_array_equal(first, reflectance(ALL[name], points, 0.002))
    other = reflectance(dataclasses.replace(ALL[name], seed=99), points, 0.002)
    # Bricks of all seeds share their joints.
    assert abs(np.corrcoef(first[:, 1], other[:, 1])[0, 1]) < (0.7 if name == "bricks" else 0.35)


@pytest.mark.parametrize("name", ALL)
def test_from_afar_a_texture_is_plain(name, rng):
    points = rng.uniform(-20, 20, (200, 3))
    assert reflectance(ALL[name], points, 50.0).std(axis=0).max() < 0.02
