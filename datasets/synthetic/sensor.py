"""From linear radiance to the 8-bit photo: exposure, vignetting, blur, noise and gamma.

With radiance L, gain g = 2^EV and the fall-off v of light at distance ρ from the centre (1 at the corner):

    signal  S = blur(g (1 − v ρ²) L)          photo = round(255 γ(S + n)),   var n = noise² (S + 0.01)

that is, the noise of photons with a floor, `noise` at white; γ is the transfer curve of sRGB.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from sfm.core.arrays import FloatArray


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class SensorConfig:
    """What a sensor does to an image. The defaults are those of a good hand-held camera by day."""

    noise: float = 0.008
    """Standard deviation at white, as a share of it."""
    blur_px: float = 0.3
    """Standard deviation of the lens's blur."""
    vignetting: float = 0.15
    """Share of the light that is lost at the corners."""
    exposure_ev: float = 0.0
    """Exposure of all images, stops."""
    exposure_jitter_ev: float = 0.1
    """Standard deviation of the exposure from image to image, stops."""
    jpeg_quality: int | None = 93
    """1 to 100; None writes PNG."""

    def __post_init__(self) -> None:
        if min(self.noise, self.blur_px, self.vignetting, self.exposure_jitter_ev) < 0 or self.vignetting >= 1:
            raise ValueError("noise, blur and exposure jitter must be at least 0, vignetting in [0, 1)")
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"JPEG quality must lie in 1 … 100, got {self.jpeg_quality}")

    @property
    def suffix(self) -> str:
        """Of the image files."""
        return ".png" if self.jpeg_quality is None else ".jpg"


CLEAN = SensorConfig(noise=0.0, blur_px=0.0, vignetting=0.0, exposure_jitter_ev=0.0, jpeg_quality=None)
"""Only the gamma."""


def expose(
    radiance: Float32[np.ndarray, "H W 3"], config: SensorConfig, rng: np.random.Generator
) -> UInt8[np.ndarray, "H W 3"]:
    """The photo of a radiance image, RGB."""
    height, width = radiance.shape[:2]
    y, x = np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    reach = (x * x * width**2 + y * y * height**2) / (width**2 + height**2)
    gain = 2.0 ** (config.exposure_ev + config.exposure_jitter_ev * rng.standard_normal())
    signal = radiance * (gain * (1 - config.vignetting * reach))[..., None].astype(np.float32)
    if config.blur_px > 0:
        signal = cv2.GaussianBlur(signal, (0, 0), config.blur_px)
    if config.noise > 0:
        spread = np.float32(config.noise) * np.sqrt(signal + np.float32(0.01))
        signal = signal + spread * rng.standard_normal(signal.shape, dtype=np.float32)
    return np.rint(255 * gamma(np.clip(signal, 0, 1))).astype(np.uint8)


def gamma(linear: FloatArray | np.ndarray) -> np.ndarray:
    """The transfer curve of sRGB, of values in [0, 1] (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055)


def encode(photo: UInt8[np.ndarray, "H W 3"], config: SensorConfig) -> bytes:
    """The bytes of the image file."""
    options = [] if config.jpeg_quality is None else [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality]
    _, data = cv2.imencode(config.suffix, cv2.cvtColor(photo, cv2.COLOR_RGB2BGR), options)
    return data.tobytes()
