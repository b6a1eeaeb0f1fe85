"""Preparation of images in which features are hard to find, chosen from what is measured in them.

Detectors look for a smallest contrast, so an image of little contrast has few features, though they are there; and for
a smallest scale, where noise is strongest. The remedies: a line or a curve for the grey values, CLAHE, a filter.

Of eleven pairs of photos of six scenes, at 800 px, one of each pair spoilt and prepared, the other as it is, so many
matches were verified altogether (`scripts/bench_prepare.py`; "lowered" is `features.min_features` = 2000 instead):

    |                      |   off |  auto | clahe | gamma | stretch | bilateral | median | lowered |
    |----------------------|-------|-------|-------|-------|---------|-----------|--------|---------|
    | as they are          | 12668 | 12815 | 11681 | 12449 |   12906 |     12463 |   8370 |   12675 |
    | gamma 3              |  4124 |  9960 |  9044 | 10234 |    6957 |      3955 |   2795 |    6228 |
    | a tenth of the range |    58 | 10453 |  1861 |    58 |   10453 |        22 |     20 |    8839 |
    | −3 EV                |  4967 | 12715 | 11803 |  7822 |   12715 |      4773 |   3207 |   10638 |
    | −3 EV, shot noise    |  3860 |  6614 |  6124 |  4537 |    6614 |      3519 |   2798 |    5988 |
    | noise of 6 %         |  2973 |  3851 |  2517 |  2865 |    3001 |      3843 |   3270 |    2973 |
    | specks, 2 %          |  4464 |  8735 |  6902 |  4355 |    4464 |      3429 |   8218 |    4464 |

`auto` loses nothing on any of the pairs as they are, and at most 3 % on a spoilt one. A remedy for one fault harms
where there is another or none, hence its thresholds. A thing before a black background is the hard case: dark, but
not too dark.
"""

from __future__ import annotations

import dataclasses
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import UInt8

from sfm.core.errors import ConfigError
from sfm.core.imaging.noise import noise_sigma, specks_share, without_noise, without_specks
from sfm.core.imaging.tone import Tone, equalized_locally, stretched, tone, with_gamma

PrepareMode: TypeAlias = Literal["off", "auto", "clahe", "gamma", "stretch", "bilateral", "median"]

_STEEPEST_GAMMA = 0.3
"""Below it the few grey values of the dark lie so far apart that their steps are found as features."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PrepareConfig:
    """What is done to images before features are sought in them."""

    mode: PrepareMode = "off"
    """Nothing; what measurements call for (auto); or the same for all: CLAHE, gamma to a median of `target_median`, the
    full range of grey values (stretch), a bilateral filter against noise, a median of 3×3 pixels against specks."""

    clahe_clip: float = 2.0
    """Largest growth of contrast by CLAHE; more finds more in flat images and harms others."""

    target_median: float = 0.45
    """Grey value in [0, 1] to which gamma brings the median of the pixels that are not black."""

    noise_above: float = 0.03
    """Standard deviation of the noise, for grey values in [0, 1], above which `auto` filters. Photos of good light have
    0.001 to 0.005; a tenth of them at three stops below has 0.01, where a filter still harms."""

    specks_above: float = 0.005
    """Share of single black or white pixels above which `auto` filters them."""

    range_below: float = 0.75
    """Range of grey values, from dark to light, below which `auto` stretches it."""

    median_below: float = 0.25
    """Median of the pixels that are not black, after that, below which `auto` lifts the dark by gamma."""

    def __post_init__(self) -> None:
        if self.clahe_clip <= 0:
            raise ConfigError(f"clahe_clip must be above 0, got {self.clahe_clip}")
        if not 0 < self.target_median < 1:
            raise ConfigError(f"target_median must be in (0, 1), got {self.target_median}")
        for name in ("noise_above", "specks_above", "range_below", "median_below"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must not be negative, got {getattr(self, name)}")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """The image after its preparation.

    Attributes:
        steps: what was done, in this order; empty where nothing was.
        tone, noise, specks: what was measured before; noise as a standard deviation for grey values in [0, 1], specks
            as a share of the pixels.
    """

    image: UInt8[np.ndarray, "H W"]
    steps: tuple[str, ...]
    tone: Tone
    noise: float
    specks: float

    def summary(self) -> str:
        """The measurements for a person."""
        return (
            f"grey values {self.tone.low:.2f} to {self.tone.high:.2f}, median {self.tone.median:.2f}, "
            f"noise {self.noise:.3f}, specks {self.specks:.1%}"
        )


def prepare(grey: UInt8[np.ndarray, "H W"], config: PrepareConfig = PrepareConfig()) -> Prepared:
    """The image with what `config.mode` does to it; of the same size."""
    measured, noise, specks = tone(grey), noise_sigma(grey), specks_share(grey)
    match config.mode:
        case "off":
            image, steps = grey, ()
        case "auto":
            image, steps = _as_called_for(grey, noise, specks, config)
        case mode:
            image, steps = _done(grey, mode, noise, config), (mode,)
    return Prepared(image, steps, measured, noise, specks)


def _as_called_for(
    grey: np.ndarray, noise: float, specks: float, config: PrepareConfig
) -> tuple[np.ndarray, tuple[str, ...]]:
    image, steps = grey, []
    if specks > config.specks_above:
        image, steps = _done(image, "median", noise, config), ["median"]
    elif noise > config.noise_above:
        image, steps = _done(image, "bilateral", noise, config), ["bilateral"]
    before = tone(image)
    if 0 < before.range < config.range_below:
        image = _done(image, "stretch", noise, config)
        steps.append("stretch")
    # Gamma lifts the noise of the dark most of all.
    if 0 < tone(image).median < config.median_below and 2 * noise < config.noise_above * before.range:
        image = _done(image, "gamma", noise, config)
        steps.append("gamma")
    return image, tuple(steps)


def _done(grey: np.ndarray, mode: str, noise: float, config: PrepareConfig) -> np.ndarray:
    match mode:
        case "clahe":
            return equalized_locally(grey, config.clahe_clip)
        case "gamma":
            return with_gamma(grey, _gamma(tone(grey).median, config.target_median))
        case "stretch":
            measured = tone(grey)
            return stretched(grey, measured.low, measured.high) if measured.range > 0 else grey
        case "bilateral":
            return without_noise(grey, noise)
        case "median":
            return without_specks(grey)
    raise AssertionError(mode)


def _gamma(median: float, target: float) -> float:
    """The exponent that takes the median to the target, if that makes the image lighter; 1 otherwise."""
    if not 0 < median < target:
        return 1.0
    return float(max(np.log(target) / np.log(median), _STEEPEST_GAMMA))
