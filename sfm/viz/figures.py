"""Pictures of a model without a graphics stack: points and frusta splatted into a z-buffer by NumPy.

A viewpoint is a pinhole camera of vertical field of view φ that looks from `position` at `target`. With f, r, d its
forward, right and down axes (d away from `up`), a point X is drawn at

    x = f_px · r·(X − position) / z + w/2,    y = f_px · d·(X − position) / z + h/2,    z = f·(X − position) > 0,
    f_px = h / (2 tan(φ / 2)).

Everything that is drawn becomes a list of coloured dots, points as they are and lines as dots at most a pixel apart.
The list is sorted from far to near and written in that order, so that the nearest dot stays: NumPy assigns
repeated indices in order. The picture is drawn at twice its size and averaged 2 × 2, which smooths the edges.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float64, UInt8

from sfm.core.arrays import Points3D, Value, Vector, readonly
from sfm.core.cameras import Camera
from sfm.core.scene import Reconstruction

BACKGROUND = (250, 250, 248)
FRUSTUM_COLOR = (214, 72, 30)

_SUPERSAMPLING = 2
_NEAR = 1e-3
"""Nearest depth that is drawn, as a share of the distance between the viewpoint and its target."""

Colors = UInt8[np.ndarray, "N 3"]
Segments = Float64[np.ndarray, "L 2 3"]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class View(Value):
    """A viewpoint in the world.

    Attributes:
        position, target, up: (3,) in scene units; `up` is any direction that is not along the line of sight.
        fov: vertical field of view in radians.

    Raises:
        ValueError: `position` is `target`, `up` lies along the line of sight, or `fov` is not in (0, π).
    """

    position: Vector
    target: Vector
    up: Vector
    fov: float = float(np.radians(45))

    def __post_init__(self) -> None:
        for name in ("position", "target", "up"):
            object.__setattr__(self, name, readonly(getattr(self, name), (3,)))
        forward = self.target - self.position
        if not np.linalg.norm(np.cross(forward, self.up)) > 1e-9 * np.linalg.norm(forward) * np.linalg.norm(self.up):
            raise ValueError("the line of sight has no length or runs along `up`")
        if not 0 < self.fov < np.pi:
            raise ValueError(f"the field of view must lie in (0, π), got {self.fov}")

    @property
    def axes(self) -> Float64[np.ndarray, "3 3"]:
        """Rows right, down, forward: the rotation `view_from_world`."""
        forward = _unit(self.target - self.position)
        right = _unit(np.cross(forward, self.up))
        return np.stack([right, np.cross(forward, right), forward])


def choose_view(
    reconstruction: Reconstruction,
    *,
    azimuth: float = float(np.radians(30)),
    elevation: float = float(np.radians(20)),
    aspect: float = 4 / 3,
) -> View:
    """A viewpoint that shows the points from the side of the cameras, with the cameras in the picture.

    "Up" is the mean of what the cameras hold up. The line of sight starts from the mean direction in which the cameras
    look (for cameras all around: from that of the first) and is turned by `azimuth` about up and raised by `elevation`,
    both in radians. The distance is the least at which 95 % of the points and all cameras are inside.

    Args:
        aspect: width over height of the picture to be.
    """
    poses = reconstruction.cams_from_world
    if len(poses) == 0:
        raise ValueError("a model without images has no side to be seen from")
    rotations, centers = poses.rotation.matrix, poses.center
    up = _unit_or(-rotations[:, 1].mean(0), -rotations[0, 1])
    forward = rotations[:, 2].mean(0)
    if np.linalg.norm(forward) < 0.3:
        forward = rotations[0, 2]
    level = _unit_or(forward - (forward @ up) * up, _any_normal(up))
    side = np.cross(level, up)
    seen = _inner_points(reconstruction)
    towards = np.cos(elevation) * (np.cos(azimuth) * level + np.sin(azimuth) * side) - np.sin(elevation) * up
    everything = np.concatenate([seen, centers])
    target = (everything.min(0) + everything.max(0)) / 2
    view = _view_of(everything, target, towards, up, aspect)
    for _ in range(3):  # the middle of the box is not that of its perspective picture
        target = target + _offset_of_middle(everything, view)
        view = _view_of(everything, target, towards, up, aspect)
    return view


def render_model(
    reconstruction: Reconstruction,
    width: int = 1280,
    height: int = 960,
    *,
    view: View | None = None,
    point_radius_px: float = 1.5,
    frustum_size: float | None = None,
) -> UInt8[np.ndarray, "H W 3"]:
    """A picture of the points in their colours and of the cameras as frusta.

    Args:
        view: by default that of `choose_view`.
        point_radius_px: of a point's dot, in px of the picture.
        frustum_size: length of a frustum's edges in scene units; 0 draws none. By default half of the median distance
            between neighbouring cameras.
    Raises:
        ValueError: `width` or `height` is not positive.
    """
    if width < 1 or height < 1:
        raise ValueError(f"a picture of {width} × {height} px has no pixels")
    if view is None:
        view = choose_view(reconstruction, aspect=width / height)
    size = (_SUPERSAMPLING * height, _SUPERSAMPLING * width)
    edges = frustum_edges(
        reconstruction, default_frustum_size(reconstruction) if frustum_size is None else frustum_size
    )
    line_points = _dots_of_lines(edges, view, size)
    canvas = _Canvas.of(size)
    canvas.draw(reconstruction.points3D, reconstruction.colors, view, _SUPERSAMPLING * point_radius_px)
    canvas.draw(
        line_points, np.tile(np.array(FRUSTUM_COLOR, np.uint8), (len(line_points), 1)), view, 0.75 * _SUPERSAMPLING
    )
    blocks = canvas.pixels.reshape(height, _SUPERSAMPLING, width, _SUPERSAMPLING, 3)
    return np.rint(blocks.mean((1, 3))).astype(np.uint8)


def default_frustum_size(reconstruction: Reconstruction) -> float:
    """Half of the median distance of a camera to its nearest neighbour; a tenth of the depth where there is one camera.

    Bounded by a quarter of the distance from the cameras to the points, so that frusta do not cover the scene.
    """
    centers = reconstruction.cams_from_world.center
    if len(centers) == 0:
        return 0.0
    seen = _inner_points(reconstruction)
    depth = float(np.median(np.linalg.norm(seen - centers.mean(0), axis=1))) if len(seen) else 1.0
    distances = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    spacing = float(np.median(distances.min(1))) if len(centers) > 1 else 0.2 * depth
    return float(np.clip(0.5 * spacing, 0.01 * depth, 0.25 * depth)) or 1.0


def frustum_edges(reconstruction: Reconstruction, size: float) -> Segments:
    """Eight segments a camera, apex to corners and around the image, in the world; corners without a ray drop out."""
    if size <= 0:
        return np.zeros((0, 2, 3))
    edges = [np.zeros((0, 2, 3))]
    corners = {camera_id: _corner_rays(camera) for camera_id, camera in reconstruction.cameras.items()}
    world_from_cams = reconstruction.cams_from_world.inverse()
    for row, camera_id in enumerate(reconstruction.image_camera_ids.tolist()):
        tips = world_from_cams[row] @ (size * corners[camera_id])
        apex = np.broadcast_to(world_from_cams[row].translation, tips.shape)
        edges += [np.stack([apex, tips], 1), np.stack([tips, np.roll(tips, -1, 0)], 1)]
    segments = np.concatenate(edges)
    return segments[np.isfinite(segments).all((1, 2))]


def _corner_rays(camera: Camera) -> Points3D:
    """Rays (4, 3) through the image's corners, cut at depth 1; of length 1 where they point sideways or back."""
    w, h = float(camera.width), float(camera.height)
    rays, _ = camera.unproject(np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]))
    depth = rays[:, 2:]
    return np.where(depth > 0.3, rays / np.where(depth > 0.3, depth, 1.0), rays)


def _inner_points(reconstruction: Reconstruction) -> Points3D:
    """The points without the outermost, judged along each axis: what lies within the middle 95 %."""
    points = reconstruction.points3D
    if len(points) < 20:
        return points
    low, high = np.percentile(points, [2.5, 97.5], axis=0)
    return points[np.all((points >= low) & (points <= high), axis=1)]


def _view_of(points: Points3D, target: Vector, towards: Vector, up: Vector, aspect: float) -> View:
    """The nearest viewpoint that looks along `towards` at the target with all points in the picture, and 8 % margin."""
    view = View(target - towards, target, up)
    x, y, z = ((points - target) @ view.axes.T).T
    slope = float(np.tan(view.fov / 2))
    distance = 1.08 * float(np.max(np.maximum(np.abs(x) / (slope * aspect), np.abs(y) / slope) - z))
    return dataclasses.replace(view, position=target - max(distance, 1e-6) * towards)


def _offset_of_middle(points: Points3D, view: View) -> Vector:
    """The shift of the target that brings the middle of the points' picture to the middle of the view."""
    x, y, z = ((points - view.position) @ view.axes.T).T
    middle = np.array([(slope.min() + slope.max()) / 2 for slope in (x / z, y / z)])
    return float(np.linalg.norm(view.target - view.position)) * (middle @ view.axes[:2])


@dataclasses.dataclass(slots=True)
class _Canvas:
    """Pixels and their depth while a picture is drawn."""

    pixels: UInt8[np.ndarray, "H W 3"]
    depth: Float64[np.ndarray, "H W"]

    @staticmethod
    def of(size: tuple[int, int]) -> _Canvas:
        return _Canvas(np.tile(np.array(BACKGROUND, np.uint8), (*size, 1)), np.full(size, np.inf))

    def draw(self, points: Points3D, colors: Colors, view: View, radius_px: float) -> None:
        """Draws discs, each at the depth of its point."""
        height, width = self.depth.shape
        x, y, z = _project(points, view, (height, width))
        order = np.argsort(-z, kind="stable")
        order = order[np.isfinite(x[order])]
        dx, dy = _disc(radius_px)
        columns = np.floor(x[order]).astype(np.int64)[:, None] + dx
        rows = np.floor(y[order]).astype(np.int64)[:, None] + dy
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        flat = (rows * width + columns)[inside]
        depth = np.broadcast_to(z[order][:, None], inside.shape)[inside]
        visible = depth < self.depth.reshape(-1)[flat]
        source = np.broadcast_to(order[:, None], inside.shape)[inside][visible]
        self.pixels.reshape(-1, 3)[flat[visible]] = colors[source]
        self.depth.reshape(-1)[flat[visible]] = depth[visible]


def _project(points: Points3D, view: View, size: tuple[int, int]) -> tuple[Vector, Vector, Vector]:
    """Pixels and depths (N,); NaN for what lies behind or beside the picture by more than its size."""
    height, width = size
    x, y, z = ((points - view.position) @ view.axes.T).T
    near = _NEAR * float(np.linalg.norm(view.target - view.position))
    focal = height / (2 * np.tan(view.fov / 2))
    depth = np.where(z > near, z, np.nan)
    column, row = focal * x / depth + width / 2, focal * y / depth + height / 2
    outside = ~((np.abs(column - width / 2) < 2 * width) & (np.abs(row - height / 2) < 2 * height))
    column[outside] = np.nan
    row[outside] = np.nan
    return column, row, z


def _dots_of_lines(segments: Segments, view: View, size: tuple[int, int]) -> Points3D:
    """Points along the segments, at most about a pixel apart in the picture."""
    if len(segments) == 0:
        return np.zeros((0, 3))
    height, _ = size
    start, end = segments[:, 0], segments[:, 1]
    near = _NEAR * float(np.linalg.norm(view.target - view.position))
    depth = np.minimum((start - view.position) @ view.axes[2], (end - view.position) @ view.axes[2])
    focal = height / (2 * np.tan(view.fov / 2))
    longest = focal * np.linalg.norm(end - start, axis=1) / np.maximum(depth, near)
    counts = np.clip(np.ceil(longest), 2, 4 * max(size)).astype(np.int64)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    share = (np.arange(counts.sum()) - first) / np.repeat(counts - 1, counts)
    return np.repeat(start, counts, 0) + share[:, None] * np.repeat(end - start, counts, 0)


def _disc(radius_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets of the pixels within a radius; at least the pixel itself."""
    reach = int(np.ceil(radius_px))
    dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    within = dx**2 + dy**2 <= max(radius_px, 0.5) ** 2
    return dx[within], dy[within]


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def _unit_or(vector: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """The direction of `vector`, or `otherwise` where it has hardly any."""
    return _unit(vector) if np.linalg.norm(vector) > 1e-3 else _unit(otherwise)


def _any_normal(vector: np.ndarray) -> np.ndarray:
    return np.cross(vector, np.eye(3)[np.argmin(np.abs(vector))])
