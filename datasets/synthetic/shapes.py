"""Shapes: triangle meshes that carry their own texture coordinates.

A shape is built in coordinates of its own, z up, in metres; `texture_points` are these coordinates and stay with
the surface wherever the shape is moved, so that two copies of a shape look the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float64, Int64

from datasets.synthetic import _texture_kernels
from datasets.synthetic.materials import Material
from sfm.core.arrays import Points3D, Value
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Shape(Value):
    """A mesh of one material.

    Attributes:
        points, texture_points: (V, 3) metres.
        triangles: (T, 3) rows of `points`.
        smooth: light varies over it as over a curved surface; else each triangle is flat.
    """

    points: Points3D
    texture_points: Points3D
    triangles: Int64[np.ndarray, "T 3"]
    material: Material
    smooth: bool = False

    def moved(self, place: Sequence[float], yaw_deg: float = 0.0) -> Shape:
        """The shape turned about its z axis and then moved; its texture goes with it."""
        turn = Rotation3.exp(np.array([0.0, 0.0, np.deg2rad(yaw_deg)]))
        world_from_shape = Rigid3(turn, np.asarray(place, dtype=np.float64))
        return dataclasses.replace(self, points=world_from_shape @ self.points)

    def shading_normals(self) -> Float64[np.ndarray, "T 3 3"]:
        """Unit normals at the corners of each triangle."""
        corners = self.points[self.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        if self.smooth:
            sums = np.zeros_like(self.points)
            for k in range(3):
                np.add.at(sums, self.triangles[:, k], normals)
            at_corners = sums[self.triangles]
        else:
            at_corners = np.repeat(normals[:, None], 3, axis=1)
        return at_corners / np.linalg.norm(at_corners, axis=-1, keepdims=True)


def _shape(points: np.ndarray, triangles: np.ndarray, material: Material, *, smooth: bool = False) -> Shape:
    points = np.asarray(points, dtype=np.float64)
    return Shape(points, points, np.asarray(triangles, dtype=np.int64), material, smooth)


def box(low: Sequence[float], high: Sequence[float], material: Material) -> Shape:
    """An axis-aligned box between two corners."""
    bits = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(8)])
    points = np.where(bits, np.asarray(high, dtype=np.float64), np.asarray(low, dtype=np.float64))
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return _shape(points, np.array(triangles), material)


def surface(
    function: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]],
    u: np.ndarray,
    v: np.ndarray,
    material: Material,
    *,
    smooth: bool = True,
) -> Shape:
    """The surface (x, y, z) = function(u, v) over a grid of parameters."""
    uu, vv = np.meshgrid(u, v, indexing="ij")
    points = np.stack(np.broadcast_arrays(*function(uu, vv)), -1).reshape(-1, 3)
    cells = np.arange(len(u) * len(v)).reshape(len(u), len(v))
    a, b, c, d = (cells[i : i + len(u) - 1, j : j + len(v) - 1].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    corners = points[triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    return _shape(points, triangles[area > 1e-12], material, smooth=smooth)


def plane(half_x: float, half_y: float, material: Material) -> Shape:
    """A level rectangle around the origin."""
    ends = np.array([-1.0, 1.0])
    return surface(lambda u, v: (half_x * u, half_y * v, 0.0 * u), ends, ends, material, smooth=False)


def revolved(profile: Sequence[tuple[float, float]], material: Material, *, sides: int = 48) -> Shape:
    """The surface of revolution about z of a profile of (radius, height)."""
    radius, height = np.array(profile, dtype=np.float64).T
    turns = np.linspace(0, 2 * np.pi, sides + 1)
    index = np.arange(len(profile), dtype=np.float64)

    def point(t: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        r, z = np.interp(k, index, radius), np.interp(k, index, height)
        return r * np.cos(t), r * np.sin(t), z

    return surface(point, turns, index, material)


def rock(
    size: Sequence[float], material: Material, *, roughness: float, wavelength: float, seed: int, rows: int = 120
) -> Shape:
    """An ellipsoid of half axes `size` whose radius varies by noise; on z = 0 it stands sunk by a tenth."""
    seam = np.linspace(0, 2 * np.pi, 2 * rows + 1)
    poles = np.linspace(0, np.pi, rows + 1)

    def point(t: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        unit = np.stack([np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)], -1)
        # The first and the last column, and all points of a pole, are one place.
        unit[-1] = unit[0]
        unit[:, 0], unit[:, -1] = (0, 0, 1), (0, 0, -1)
        x, y, z = np.moveaxis(unit * np.asarray(size), -1, 0)
        gain = 1 + roughness * noise(np.stack([x, y, z], -1).reshape(-1, 3), wavelength, seed).reshape(x.shape)
        return gain * x, gain * y, gain * z + 0.9 * size[2]

    return surface(point, seam, poles, material)


def gable(half_x: float, half_y: float, height: float, material: Material, *, overhang: float = 0.3) -> Shape:
    """A saddle roof over a rectangle, ridge along x, eaves at z = 0."""
    x, y, drop = half_x + overhang, half_y + overhang, -overhang * height / half_y
    points = [(-x, -y, drop), (x, -y, drop), (x, y, drop), (-x, y, drop), (-x, 0, height), (x, 0, height)]
    triangles = [(0, 1, 5), (0, 5, 4), (2, 3, 4), (2, 4, 5), (3, 0, 4), (1, 2, 5), (0, 2, 1), (0, 3, 2)]
    return _shape(np.array(points), np.array(triangles), material)


def terrain(half: float, step: float, height: Callable[[np.ndarray], np.ndarray], material: Material) -> Shape:
    """A height field over a square; `height` maps points (N, 3) of the plane z = 0 to heights (N,)."""
    axis = np.linspace(-half, half, round(2 * half / step) + 1)

    def point(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        flat = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
        return x, y, height(flat).reshape(x.shape)

    return surface(point, axis, axis, material)


def noise(points: Points3D, wavelength: float, seed: int, *, octaves: int = 6, gain: float = 0.5) -> np.ndarray:
    """Noise (N,) of order 1 at points (N, 3)."""
    out = np.empty(len(points))
    _texture_kernels.fbm_at(np.array(points, dtype=np.float64), wavelength, octaves, gain, seed, out)
    return out
