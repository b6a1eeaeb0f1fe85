"""What is photographed: shapes under a light; and who photographs it: views.

The world's z axis points up and its unit is the metre.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from datasets.synthetic.materials import Colour
from datasets.synthetic.shapes import Shape
from sfm.core.arrays import Value
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.scene import Frame, Rig

Place = tuple[float, float, float]


@dataclasses.dataclass(frozen=True, slots=True)
class Sun:
    """A light from infinitely far: the direction toward it, and irradiance on a surface that faces it."""

    toward: Place
    colour: Colour


@dataclasses.dataclass(frozen=True, slots=True)
class Lamp:
    """A light at a point; `colour` is the irradiance one metre away."""

    place: Place
    colour: Colour


@dataclasses.dataclass(frozen=True, slots=True)
class Ambient:
    """Light without a direction: on a surface that faces up and down, and the look of the sky."""

    above: Colour
    below: Colour
    zenith: Colour = (0.20, 0.34, 0.62)
    horizon: Colour = (0.72, 0.78, 0.84)


DAYLIGHT = Ambient(above=(0.34, 0.40, 0.50), below=(0.20, 0.18, 0.15))


@dataclasses.dataclass(frozen=True, slots=True)
class World:
    """Shapes and lights.

    Attributes:
        extent: the size in metres of what the photos are of; errors of positions are stated in its terms.
    """

    shapes: tuple[Shape, ...]
    lights: tuple[Sun | Lamp, ...]
    ambient: Ambient
    extent: float


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class View(Value):
    """One photo to be taken; `name` may hold a folder (a camera of a rig)."""

    name: str
    camera_id: int
    camera: Camera
    cam_from_world: Rigid3


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Scene(Value):
    """A world and its views; image ids are 1, 2, … in the order of the views."""

    name: str
    world: World
    views: tuple[View, ...]
    rigs: tuple[Rig, ...] = ()
    frames: tuple[Frame, ...] = ()

    @property
    def cameras(self) -> Mapping[int, Camera]:
        """The cameras by id."""
        return MappingProxyType({view.camera_id: view.camera for view in self.views})

    @property
    def cams_from_world(self) -> Rigid3:
        """All poses, batch (I,)."""
        return Rigid3.stack([view.cam_from_world for view in self.views])

    def thinned(self, keep: slice) -> Scene:
        """The scene with some of its views, for tests; rigs and frames are dropped."""
        return dataclasses.replace(self, views=self.views[keep], rigs=(), frames=())


def light_table(lights: tuple[Sun | Lamp, ...]) -> np.ndarray:
    """Rows (L, 7) for the kernel: kind, direction or place, colour."""
    rows = np.zeros((len(lights), 7))
    for row, light in zip(rows, lights, strict=True):
        if isinstance(light, Sun):
            toward = np.asarray(light.toward, dtype=np.float64)
            row[:] = [0, *(toward / np.linalg.norm(toward)), *light.colour]
        else:
            row[:] = [1, *light.place, *light.colour]
    return rows
