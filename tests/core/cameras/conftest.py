"""Cameras of every model with realistic random parameters, and points that they see."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sfm.core.cameras import MODELS, Camera, model_by_name

# Half-widths of the uniform distributions from which parameters are drawn; distortion as lenses have it.
_PERSPECTIVE_SPREAD = {"k": 0.25, "k1": 0.25, "k2": 0.08, "k3": 0.03, "k4": 0.1, "k5": 0.03, "k6": 0.01}
_PERSPECTIVE_SPREAD |= {"s2": 1e-6, "s4": 1e-6}  # of the fourth power of a radius that may be 20
_FISHEYE_SPREAD = {"k": 0.06, "k1": 0.06, "k2": 0.012, "k3": 0.004, "k4": 0.001, "sx1": 1e-3, "sy1": 1e-3}


def random_camera(model: str, rng: np.random.Generator) -> Camera:
    info = model_by_name(model)
    width = int(rng.integers(600, 4000))
    height = int(width * rng.uniform(0.5, 1.0))
    focal = rng.uniform(0.3, 0.5) * width if info.is_fisheye else rng.uniform(0.6, 1.5) * width
    spread = _FISHEYE_SPREAD if info.is_fisheye else _PERSPECTIVE_SPREAD
    values = {
        "f": focal, "fx": focal, "fy": focal * rng.uniform(0.97, 1.03),
        "cx": width * rng.uniform(0.45, 0.55), "cy": height * rng.uniform(0.45, 0.55),
        "w": width, "h": height, "alpha": rng.uniform(0.2, 0.8), "beta": rng.uniform(0.7, 1.3),
        "xi": rng.uniform(-0.3, 0.6),
    }  # fmt: skip
    params = [
        values[name] if name in values else rng.uniform(-1, 1) * spread.get(name, 2e-3) for name in info.param_names
    ]
    return Camera(model, width, height, np.array(params, dtype=float))


def points_within(camera: Camera, max_angle: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points at up to `max_angle` from the axis, at distances from 0.1 to 100."""
    angle, turn = max_angle * np.sqrt(rng.uniform(0, 1, count)), rng.uniform(-np.pi, np.pi, count)
    rays = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    return rays * 10 ** rng.uniform(-1, 2, (count, 1))


@pytest.fixture(
    scope="session", params=[(m.name, seed) for m in MODELS for seed in range(2)], ids=lambda p: f"{p[0]}-{p[1]}"
)
def camera(request: pytest.FixtureRequest) -> Camera:
    name, seed = request.param
    return random_camera(name, np.random.default_rng([seed, model_by_name(name).model_id]))


@pytest.fixture
def seen_points(camera: Camera) -> Callable[..., np.ndarray]:
    """`seen_points(count, limit)`: points well within the camera's range and at most `limit` from the axis."""

    def draw(count: int, limit: float = np.pi) -> np.ndarray:
        radius = 0.93 * min(camera.max_radius, np.pi if camera.model_info.is_fisheye else 2.5)
        widest = radius if camera.model_info.is_fisheye else np.arctan(radius)
        return points_within(camera, min(widest, limit), count, np.random.default_rng(1))

    return draw
