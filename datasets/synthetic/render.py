"""Pictures of a world through any camera, by casting the true ray of each sample.

The image is the radiance filtered by a tent two pixels wide. Where a pixel sees one surface, the filter is in the
texture itself (see `_texture_kernels`) and a single ray through the centre is enough. Where it does not — outlines,
creases, edges of shadows, surfaces seen at a grazing angle — rays go through a lattice of `samples` × `samples` points
a pixel, which neighbours share, and the tent is summed over them in linear light:

    weight(k) = (s − |k|) / s²,   k = −(s − 1) … s − 1 steps of 1 / s pixel from the centre, in x and in y.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from datasets.synthetic import _sampling_kernels as sampling
from datasets.synthetic import _surface_kernels as kernels
from datasets.synthetic import _texture_kernels as textures
from datasets.synthetic.world import View, World, light_table
from sfm.core.arrays import Mask, Points2D, Points3D, Rays
from sfm.core.cameras import Camera
from sfm.core.execution import available_threads, chunk_bounds, ordered_map
from sfm.core.geometry.rigid import Rigid3
from sfm.core.optional import import_open3d

_GRAZING = 0.25
"""Cosine of incidence below which a pixel's footprint is too long for the isotropic filter of the texture."""
_CREASE = 0.97
"""Cosine between normals of neighbours above which they count as one surface."""
_GAP = 0.01
"""Distance from a neighbour's tangent plane, as a share of the distance, above which there is a step between them."""
_BLOCK = 32768
"""Rays that are traced together: large enough for few calls, small enough for the cache."""
_LIFT = 1e-4
"""Start of a shadow ray above the surface, as a share of the distance from the camera: far above single precision."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """A picture and what is known of it; maps are of pixel centres.

    Attributes:
        radiance: linear RGB; 0 where the camera model has no ray.
        depth: z in the camera frame, metres, NaN where no surface is; below 0 only for cameras that see backward.
        normals: unit, in the camera frame, of the mesh's faces, facing the camera; NaN where no surface is.
        triangles: row of the triangle that is seen, −1 for none.
    """

    radiance: Float32[np.ndarray, "H W 3"]
    depth: Float64[np.ndarray, "H W"]
    normals: Float64[np.ndarray, "H W 3"]
    triangles: Int64[np.ndarray, "H W"]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Hits:
    """Where rays from one origin end; NaN and `MISS` where nowhere."""

    origin: np.ndarray
    directions: np.ndarray
    triangle_ids: np.ndarray
    distances: np.ndarray
    normals: np.ndarray
    lit: np.ndarray

    @property
    def points(self) -> np.ndarray:
        return self.origin + self.distances[:, None] * self.directions

    @staticmethod
    def joined(parts: list[_Hits]) -> _Hits:
        columns = [
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("directions", "triangle_ids", "distances", "normals", "lit")
        ]
        return _Hits(parts[0].origin, *columns)


class Renderer:
    """Holds a world in the form that rays are cast at.

    Args:
        threads: all cores by default. The result does not depend on it.
        samples: a side of the lattice of a pixel that needs more than one ray.
    """

    def __init__(self, world: World, *, threads: int | None = None, samples: int = 2) -> None:
        self._open3d = import_open3d()
        self._threads = threads or available_threads()
        self._samples = samples
        self._rays_of: tuple[Camera, Rays, Mask, np.ndarray] | None = None
        self._lights = light_table(world.lights)
        ambient = world.ambient
        self._ambient = np.array([ambient.above, ambient.below, ambient.zenith, ambient.horizon], dtype=np.float64)
        shapes = world.shapes
        self._corners = np.concatenate([shape.points[shape.triangles] for shape in shapes])
        texture = np.concatenate([shape.texture_points[shape.triangles] for shape in shapes])
        self._shapes = np.repeat(np.arange(len(shapes)), [len(shape.triangles) for shape in shapes])
        self._materials = np.stack([shape.material.row() for shape in shapes])
        across = np.cross(texture[:, 1] - texture[:, 0], texture[:, 2] - texture[:, 0])
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        shading = np.concatenate([shape.shading_normals() for shape in shapes])
        self._surface = (self._corners, texture, shading, across, self._shapes)
        self._caster = self._open3d.t.geometry.RaycastingScene(nthreads=1)
        tensor = self._open3d.core.Tensor
        triangles = np.arange(3 * len(self._corners), dtype=np.uint32).reshape(-1, 3)
        self._caster.add_triangles(tensor(self._corners.reshape(-1, 3).astype(np.float32)), tensor(triangles))

    def render(self, camera: Camera, cam_from_world: Rigid3) -> Rendering:
        """The picture that `camera` takes at a pose."""
        shape = (camera.height, camera.width)
        rays, valid, angles = self._pixel_rays(camera)
        world_from_cam = cam_from_world.inverse()
        blocks = self._picture(world_from_cam, rays, valid, angles)
        hits = _Hits.joined([hits for hits, _ in blocks])
        radiance = np.concatenate([radiance for _, radiance in blocks]).reshape(*shape, 3)
        refine = self._needs_samples(hits, shape) & valid.reshape(shape)
        if self._samples > 1 and refine.any():
            self._supersample(camera, world_from_cam, refine, angles, radiance)
        triangles = np.where(hits.triangle_ids == kernels.MISS, -1, hits.triangle_ids.astype(np.int64))
        return Rendering(
            radiance=radiance,
            depth=(hits.distances * rays[:, 2]).reshape(shape),
            normals=(cam_from_world.rotation @ hits.normals).reshape(*shape, 3),
            triangles=triangles.reshape(shape),
        )

    def _pixel_rays(self, camera: Camera) -> tuple[Rays, Mask, np.ndarray]:
        """Rays, validity and angles between neighbours of all pixels; kept, since most views share one camera."""
        if self._rays_of is None or self._rays_of[0] is not camera:
            rays, valid = camera.unproject(pixel_centers(camera))
            angles = _pixel_angles(rays.reshape(camera.height, camera.width, 3)).ravel()
            self._rays_of = (camera, rays, valid, angles)
        return self._rays_of[1:]

    def _needs_samples(self, hits: _Hits, shape: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
        """Pixels whose neighbourhood is not one surface in one light, or that see a surface at a grazing angle."""
        refine = np.zeros(shape, bool)
        sampling.find_mixed(
            self._shapes, hits.triangle_ids, hits.lit, hits.origin, hits.directions, hits.distances, hits.normals,
            _CREASE, _GAP, _GRAZING, refine,
        )  # fmt: skip
        return refine

    def view(self, view: View) -> Rendering:
        """The picture of a view."""
        return self.render(view.camera, view.cam_from_world)

    def surface_points(self, camera: Camera, cam_from_world: Rigid3, points2D: Points2D) -> tuple[Points3D, Rays]:
        """Points in the world that pixels see, and the surface's unit normals there, facing the camera; else NaN."""
        rays, valid = camera.unproject(points2D)
        hits = self._cast(cam_from_world.inverse(), rays, valid)
        return hits.points, hits.normals

    def samples(
        self, camera: Camera, cam_from_world: Rigid3, points2D: Points2D
    ) -> tuple[Points3D, Rays, Float32[np.ndarray, "N 3"]]:
        """As `surface_points`, with the radiance of each point."""
        rays, valid = camera.unproject(points2D)
        angles = np.full(len(rays), 1 / camera.mean_focal_length)
        blocks = self._picture(cam_from_world.inverse(), rays, valid, angles)
        hits = _Hits.joined([hits for hits, _ in blocks])
        return hits.points, hits.normals, np.concatenate([radiance for _, radiance in blocks])

    def visible(self, points3D: Points3D, center: np.ndarray, *, tolerance: float = 1e-5) -> Mask:
        """Whether the segment from each point of a surface to `center` meets nothing.

        `tolerance` is the share of the segment, at the point's end, that does not count.
        """
        reaches = np.isfinite(points3D[:, 0])
        segments = np.where(reaches[:, None], points3D - center, 1.0)
        ahead = np.concatenate([np.broadcast_to(center, segments.shape), segments], -1)
        return reaches & ~self._occluded(ahead, 1 - tolerance)

    def _occluded(self, rays: np.ndarray, far: float) -> np.ndarray:
        tensor = self._open3d.core.Tensor.from_numpy(np.ascontiguousarray(rays, dtype=np.float32))
        return self._caster.test_occlusions(tensor, tnear=0.0, tfar=far, nthreads=1).numpy()

    def _picture(
        self, world_from_cam: Rigid3, rays: Rays, valid: Mask, angles: np.ndarray
    ) -> list[tuple[_Hits, Float32[np.ndarray, "B 3"]]]:
        """Where the rays of a camera end and the radiance that comes along them, by blocks on threads."""

        def trace(block: tuple[int, int]) -> tuple[_Hits, np.ndarray]:
            rows = slice(*block)
            hits = self._cast(world_from_cam, rays[rows], valid[rows])
            self._cast_shadows(hits)
            return hits, self._radiance(hits, angles[rows], valid[rows])

        blocks = chunk_bounds(len(rays), -(-len(rays) // _BLOCK))
        return list(ordered_map(trace, blocks, threads=self._threads))

    def _cast(self, world_from_cam: Rigid3, rays: Rays, valid: Mask) -> _Hits:
        """Where the rays of a camera end; `lit` is still all 0."""
        count = len(rays)
        origin = np.array(world_from_cam.translation)
        directions = np.where(valid[:, None], rays, (0.0, 0.0, 1.0)) @ world_from_cam.rotation.matrix.T
        bundle = np.empty((count, 6), np.float32)
        bundle[:, :3], bundle[:, 3:] = origin, directions
        answer = self._caster.cast_rays(self._open3d.core.Tensor.from_numpy(bundle), nthreads=1)
        ids = np.where(valid, answer["primitive_ids"].numpy(), np.uint32(kernels.MISS))
        distances, normals = np.empty(count), np.empty((count, 3))
        kernels.resolve(origin, directions, ids, answer["t_hit"].numpy(), self._corners, distances, normals)
        return _Hits(origin, directions, ids, distances, normals, np.zeros((count, len(self._lights)), np.uint8))

    def _cast_shadows(self, hits: _Hits) -> None:
        """Fills `hits.lit`."""
        bundle, rows = np.empty((len(hits.directions), 6), np.float32), np.empty(len(hits.directions), np.int64)
        for m, light in enumerate(self._lights):
            count = kernels.shadow_rays(
                hits.origin, hits.directions, hits.distances, hits.normals, light, _LIFT, bundle, rows
            )
            far = 1.0 if light[0] == kernels.LAMP else np.inf
            hits.lit[rows[:count], m] = ~self._occluded(bundle[:count], far)

    def _radiance(self, hits: _Hits, angles: np.ndarray, valid: Mask) -> np.ndarray:
        out = np.empty((len(hits.directions), 3), np.float64)
        textures.shade(
            hits.origin, hits.directions, angles, hits.triangle_ids, hits.distances, hits.normals, hits.lit,
            self._surface, self._materials, self._lights, self._ambient, out,
        )  # fmt: skip
        out[~valid] = 0
        return out.astype(np.float32)

    def _supersample(
        self, camera: Camera, world_from_cam: Rigid3, refine: Bool[np.ndarray, "H W"], angles: np.ndarray,
        radiance: Float32[np.ndarray, "H W 3"],
    ) -> None:  # fmt: skip
        """Replaces the pixels in `refine` by the tent over the lattice."""
        s = self._samples
        height, width = refine.shape
        nodes = np.full(((height + 1) * s - 1, (width + 1) * s - 1), -1, np.int32)
        pixels = np.empty((min(nodes.size, (2 * s - 1) ** 2 * int(refine.sum())), 2))
        pixels = pixels[: sampling.place_nodes(refine, s, nodes, pixels)]
        rays, valid = camera.unproject(pixels)
        columns, rows = np.clip(pixels.astype(np.int64), 0, (width - 1, height - 1)).T
        blocks = self._picture(world_from_cam, rays, valid, angles[rows * width + columns] / s)
        sampling.sum_tent(refine, s, nodes, np.concatenate([colours for _, colours in blocks]), radiance)


def pixel_centers(camera: Camera) -> Points2D:
    """The centres of all pixels, row by row."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    return np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], -1)


def _pixel_angles(rays: Float64[np.ndarray, "H W 3"]) -> Float64[np.ndarray, "H W"]:
    """Radians between the rays of neighbouring pixels, mean of x and y; 0 where a neighbour has none."""
    across = np.linalg.norm(np.gradient(rays, axis=1), axis=-1)
    down = np.linalg.norm(np.gradient(rays, axis=0), axis=-1)
    return np.nan_to_num(0.5 * (across + down))
