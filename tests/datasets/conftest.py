"""Small scenes that several files share, since making and rendering one costs a second."""

from __future__ import annotations

import numpy as np
import pytest

from datasets.synthetic import Renderer, Rendering, Scene, make_scene


@pytest.fixture(scope="session")
def orbit() -> Scene:
    return make_scene("orbit", images=4, width=320, height=240, seed=1)


@pytest.fixture(scope="session")
def orbit_renderer(orbit: Scene) -> Renderer:
    return Renderer(orbit.world)


@pytest.fixture(scope="session")
def orbit_pictures(orbit: Scene, orbit_renderer: Renderer) -> list[Rendering]:
    return [orbit_renderer.view(view) for view in orbit.views]


@pytest.fixture
def bilinear():
    """`bilinear(image, points2D)`: values between pixel centres, which lie at (0.5, 0.5)."""

    def sample(image: np.ndarray, points2D: np.ndarray) -> np.ndarray:
        x, y = points2D.T - 0.5
        height, width = image.shape[:2]
        x0 = np.clip(np.floor(x).astype(int), 0, width - 2)
        y0 = np.clip(np.floor(y).astype(int), 0, height - 2)
        u, v = (x - x0)[:, None], (y - y0)[:, None]
        flat = image.reshape(height, width, -1)
        top = (1 - u) * flat[y0, x0] + u * flat[y0, x0 + 1]
        low = (1 - u) * flat[y0 + 1, x0] + u * flat[y0 + 1, x0 + 1]
        return (1 - v) * top + v * low

    return sample
