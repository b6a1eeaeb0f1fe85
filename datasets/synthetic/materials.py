"""Materials: rows of numbers that `_texture_kernels.albedo` turns into reflectance."""

from __future__ import annotations

import dataclasses

import numpy as np

from datasets.synthetic import _texture_kernels as kernels
from sfm.core.arrays import FloatArray

PATTERNS = {
    "speckled": kernels.SPECKLED,
    "bricks": kernels.BRICKS,
    "planks": kernels.PLANKS,
    "print": kernels.PRINT,
    "ground": kernels.GROUND,
    "foliage": kernels.FOLIAGE,
}
Colour = tuple[float, float, float]


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class Material:
    """What a surface is made of.

    Attributes:
        pattern: a key of `PATTERNS`.
        colours: linear reflectances in [0, 1]: two that are mixed, and that of joints, spots, figures or rock.
        wavelength: of the coarsest octave of detail, metres.
        contrast: standard deviation of the logarithm of reflectance is about half of this.
        sizes: bricks: width, height, joint; planks: width, unused, joint; print: size of the largest square;
            ground: cosine of the slope below which rock shows. Metres.
        seed: two materials that differ in it alone look alike and match nowhere.
    """

    pattern: str
    colours: tuple[Colour, Colour, Colour]
    wavelength: float = 0.5
    contrast: float = 0.3
    sizes: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0

    def row(self) -> FloatArray:
        """The material's row (16,) of the table."""
        head = [PATTERNS[self.pattern], self.seed, self.wavelength, self.contrast]
        return np.array([*head, *np.ravel(self.colours), *self.sizes], dtype=np.float64)


def plaster(colour: Colour, seed: int, *, contrast: float = 0.16) -> Material:
    """A painted or plastered wall with stains and grain."""
    r, g, b = colour
    dark = (0.72 * r, 0.7 * g, 0.66 * b)
    return Material(
        pattern="speckled",
        colours=(dark, colour, (0.5 * r, 0.48 * g, 0.44 * b)),
        wavelength=1.2,
        contrast=contrast,
        seed=seed,
    )


def stone(colour: Colour, seed: int, *, wavelength: float = 0.3, contrast: float = 0.3) -> Material:
    """Natural stone, asphalt or soil: mottled, with grains and pebbles."""
    r, g, b = colour
    return Material(
        pattern="speckled",
        colours=((0.6 * r, 0.6 * g, 0.62 * b), (1.25 * r, 1.2 * g, 1.1 * b), (0.4 * r, 0.38 * g, 0.3 * b)),
        wavelength=wavelength,
        contrast=contrast,
        seed=seed,
    )


def bricks(colour: Colour, seed: int, size: tuple[float, float, float] = (0.24, 0.08, 0.012)) -> Material:
    """Courses of bricks; with other sizes ashlar, paving or shingles."""
    r, g, b = colour
    return Material(
        pattern="bricks",
        colours=((0.7 * r, 0.65 * g, 0.65 * b), (1.2 * r, 1.15 * g, 1.1 * b), (0.36, 0.34, 0.31)),
        wavelength=0.5,
        contrast=0.26,
        sizes=size,
        seed=seed,
    )


def wood(colour: Colour, seed: int, *, board: float = 0.14) -> Material:
    """Boards with grain."""
    r, g, b = colour
    return Material(
        pattern="planks",
        colours=((0.5 * r, 0.45 * g, 0.4 * b), (1.3 * r, 1.25 * g, 1.2 * b), (0.04, 0.03, 0.02)),
        wavelength=0.4,
        contrast=0.16,
        sizes=(board, 0.0, 0.006),
        seed=seed,
    )


def print_(seed: int, size: float, colours: tuple[Colour, Colour, Colour] | None = None) -> Material:
    """A printed or woven patchwork: posters, covers, pictures, carpets. Colours from the seed unless given."""
    return Material(
        pattern="print",
        colours=colours or palette(seed),
        wavelength=0.5 * size,
        contrast=0.14,
        sizes=(size, 0.0, 0.0),
        seed=seed,
    )


def wallpaper(colour: Colour, seed: int) -> Material:
    """A pattern tone in tone."""
    r, g, b = colour
    tones = (0.92 * r, 0.9 * g, 0.86 * b), colour, (0.68 * r, 0.7 * g, 0.72 * b)
    return dataclasses.replace(print_(seed, 0.4, tones), contrast=0.17)


def palette(seed: int) -> tuple[Colour, Colour, Colour]:
    """A pale, a middle and a dark colour of random but muted hues."""
    rng = np.random.default_rng([seed, 77])
    pale, middle, dark = (
        level * (1 + 0.55 * rng.uniform(-1, 1, 3)) for level in (rng.uniform(0.4, 0.6), rng.uniform(0.14, 0.3), 0.06)
    )
    return _colour(pale), _colour(middle), _colour(dark)


def _colour(rgb: FloatArray) -> Colour:
    return float(rgb[0]), float(rgb[1]), float(rgb[2])


def foliage(colour: Colour, seed: int, *, wavelength: float = 0.5) -> Material:
    """Leaves of trees and hedges."""
    r, g, b = colour
    return Material(
        pattern="foliage",
        colours=((0.45 * r, 0.5 * g, 0.4 * b), colour, (1.5 * r, 1.3 * g, 0.9 * b)),
        wavelength=wavelength,
        contrast=0.34,
        seed=seed,
    )


def ground(seed: int, *, wavelength: float = 20.0, rock_below: float = 0.8) -> Material:
    """Grass and bare soil by large patches, rock where it is steep."""
    return Material(
        pattern="ground",
        colours=((0.09, 0.13, 0.035), (0.30, 0.23, 0.13), (0.36, 0.33, 0.30)),
        wavelength=wavelength,
        contrast=0.26,
        sizes=(rock_below, 0.0, 0.0),
        seed=seed,
    )
