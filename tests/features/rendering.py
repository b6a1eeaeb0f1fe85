"""Pictures with known places: spots, corners, and textures with detail at several scales."""

from __future__ import annotations

import cv2
import numpy as np

_FINER = 8


def blob_image(centers, sigma: float, shape=(240, 320)) -> np.ndarray:
    """Bright Gaussian spots at `centers`, px with the first pixel's centre at one half."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    image = np.full(shape, 60.0)
    for cx, cy in centers:
        image += 150 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def scattered(seed: int, shape=(480, 640), step: int = 48) -> np.ndarray:
    """A loose grid of places that are nowhere in particular within their pixel."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(44, shape[1] - 40, step), np.arange(44, shape[0] - 40, step))
    grid = np.stack([x, y], -1).reshape(-1, 2)
    return grid + rng.uniform(-4, 4, grid.shape)


def corner_image(seed: int, shape=(480, 640), half_diagonal: float = 15.0) -> tuple[np.ndarray, np.ndarray]:
    """Bright squares turned any way, each pixel the mean of 64; and the places of their corners."""
    rng = np.random.default_rng(seed)
    centers = scattered(seed, shape)
    angles = rng.uniform(0, np.pi / 2, len(centers))[:, None] + np.arange(4) * np.pi / 2
    corners = centers[:, None] + half_diagonal * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    fine = np.full((shape[0] * _FINER, shape[1] * _FINER), 70, np.uint8)
    for square in corners:
        cv2.fillPoly(fine, [np.rint((square * _FINER - 0.5) * 16).astype(np.int32)], 180, shift=4)
    image = cv2.resize(fine, shape[::-1], interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(image, (0, 0), 0.8), corners.reshape(-1, 2)


def texture(seed: int, shape=(200, 260)) -> np.ndarray:
    """Grey, with detail from 2 to 16 px."""
    rng = np.random.default_rng(seed)
    image = sum(
        cv2.resize(rng.normal(size=(shape[0] // s, shape[1] // s)), shape[::-1], interpolation=cv2.INTER_CUBIC) * s
        for s in (2, 4, 8, 16)
    )
    return np.clip(np.rint(128 + 6 * image), 0, 255).astype(np.uint8)


def errors_at(points2D: np.ndarray, places: np.ndarray, within: float) -> np.ndarray:
    """Found minus true for each place that has a point within some px."""
    gaps = points2D[None] - places[:, None]
    distances = np.linalg.norm(gaps, axis=2)
    nearest = np.argmin(distances, axis=1)
    found = distances[np.arange(len(places)), nearest] < within
    return gaps[np.arange(len(places)), nearest][found]
