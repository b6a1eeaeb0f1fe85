"""The named scenes: a world and the way a camera goes through it.

The number of images sets how long the path is, not how far the steps are, up to the path's full length; only
beyond that do the steps get smaller. So few images overlap as well as many do.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from datasets.synthetic.buildings import single_facade, street, twin_facades
from datasets.synthetic.indoors import living_room
from datasets.synthetic.landscape import hills
from datasets.synthetic.paths import arc, example_camera, handheld
from datasets.synthetic.still_life import still_life
from datasets.synthetic.world import Scene, View, World
from sfm.core.cameras import Camera
from sfm.core.geometry.rigid import Rigid3
from sfm.core.geometry.rotation import Rotation3
from sfm.core.scene import Frame, Rig

Path = Callable[[int, np.random.Generator], list[Rigid3]]


@dataclasses.dataclass(frozen=True, slots=True)
class _Recipe:
    """How a scene is made: its world, its path, its usual number of images and field of view."""

    world: Callable[[int], World]
    path: Path
    images: int
    fov_deg: float


def _orbit_path(count: int, rng: np.random.Generator) -> list[Rigid3]:
    centers = arc(count, 15.0, 2.0, 1.75)
    centers[:, 2] += 0.25 * np.sin(2 * np.pi * np.arange(count) / 9)
    return handheld(centers, np.tile([0.0, 0.0, 0.85], (count, 1)), rng, sway=0.03)


def _facade_path(count: int, rng: np.random.Generator) -> list[Rigid3]:
    """Along the front and back again closer by."""
    steps = np.arange(count)
    reach = 12 * min(1.0, count / 24)
    sweep = np.where(steps < (count + 1) // 2, steps / max(1, count // 2), 2 - steps / max(1, count // 2))
    x = reach * (sweep - 0.5)
    y = np.where(steps < (count + 1) // 2, -12.0, -9.0)
    centers = np.stack([x, y, np.where(steps % 2, 1.6, 2.3)], -1)
    targets = np.stack([0.75 * x, 0 * x, np.full(count, 4.2)], -1)
    return handheld(centers, targets, rng, sway=0.1)


def _room_path(count: int, rng: np.random.Generator) -> list[Rigid3]:
    """Around the room with the back to the wall, looking across."""
    centers = arc(count, 15.0, 1.0, 1.45) * (1.9, 1.3, 1.0)
    targets = centers * (-0.9, -0.9, 0.0) + (0.0, 0.0, 1.05)
    return handheld(centers, targets, rng, sway=0.03)


def _terrain_path(count: int, rng: np.random.Generator) -> list[Rigid3]:
    """Lanes of a survey flight, 110 m above the datum, looking down and slightly ahead."""
    lane = max(3, round(np.sqrt(count)))
    along, across = np.arange(count) % lane, np.arange(count) // lane
    ahead = np.where(across % 2, -1.0, 1.0)
    x = 26.0 * np.where(across % 2, lane - 1 - along, along) - 13.0 * (lane - 1)
    y = 34.0 * across - 17.0 * ((count - 1) // lane)
    centers = np.stack([x, y, np.full(count, 110.0)], -1)
    targets = np.stack([x + 25 * ahead, y, np.zeros(count)], -1)
    return handheld(centers, targets, rng, sway=1.5)


def _street_path(count: int, rng: np.random.Generator) -> list[Rigid3]:
    """Forward along the street, weaving between the parked cars, with glances to either side."""
    steps = np.arange(count) * min(1.0, 24 / count)
    x, y = 1.3 * steps - 4.0, 1.3 * np.sin(2 * np.pi * steps / 8)
    centers = np.stack([x, y, np.full(count, 1.7)], -1)
    targets = np.stack([x + 12.0, 1.8 * np.sin(0.7 * steps), np.full(count, 2.3)], -1)
    return handheld(centers, targets, rng, sway=0.04)


def _twins_path(count: int, rng: np.random.Generator) -> list[Rigid3]:
    """Past the first front, the garden wall and the second front."""
    x = np.linspace(-20, 20, count)
    centers = np.stack([x, np.full(count, -12.0), np.where(np.arange(count) % 2, 1.6, 2.2)], -1)
    targets = np.stack([0.98 * x, 0 * x, np.full(count, 4.0)], -1)
    return handheld(centers, targets, rng, sway=0.1)


_RECIPES = {
    "orbit": _Recipe(still_life, _orbit_path, 24, 55.0),
    "facade": _Recipe(single_facade, _facade_path, 24, 65.0),
    "room": _Recipe(living_room, _room_path, 24, 70.0),
    "terrain": _Recipe(hills, _terrain_path, 25, 60.0),
    "street": _Recipe(street, _street_path, 24, 65.0),
    "twins": _Recipe(twin_facades, _twins_path, 28, 65.0),
    "rig": _Recipe(street, _street_path, 16, 65.0),
}
NAMES = tuple(_RECIPES)
"""All scenes."""
STILL_NAMES = tuple(name for name in NAMES if name != "rig")
"""Scenes of one camera."""
RIG_BASELINE = 0.4
"""Distance of the rig's cameras in metres."""


def make_scene(
    name: str,
    *,
    images: int | None = None,
    width: int = 1280,
    height: int = 960,
    camera_model: str = "SIMPLE_RADIAL",
    fov_deg: float | None = None,
    seed: int = 0,
) -> Scene:
    """A named scene.

    Args:
        images: moments at which photos are taken: a rig takes two at each. The scene's own number by default.
        fov_deg: horizontal field of view; the scene's own by default.
    Raises:
        ValueError: there is no scene of that name, or `images` is not positive.
    """
    if name not in _RECIPES:
        raise ValueError(f"unknown scene {name!r}; known are {', '.join(NAMES)}")
    recipe = _RECIPES[name]
    count = recipe.images if images is None else images
    if count < 1:
        raise ValueError(f"a scene needs at least one image, got {count}")
    world = recipe.world(1000 * seed)
    poses = recipe.path(count, np.random.default_rng([seed, 99]))
    camera = example_camera(camera_model, width, height, fov_deg=fov_deg or recipe.fov_deg)
    if name == "rig":
        return _rig_scene(world, poses, camera)
    views = tuple(View(f"{name}_{k:04d}", 1, camera, pose) for k, pose in enumerate(poses, 1))
    return Scene(name, world, views)


def _rig_scene(world: World, poses: list[Rigid3], camera: Camera) -> Scene:
    """Two cameras side by side, the right one turned a little outward; a frame is a left and a right image."""
    turn = Rotation3.exp(np.array([0.0, np.deg2rad(-5.0), 0.0]))
    right_from_left = Rigid3(turn, turn @ np.array([-RIG_BASELINE, 0.0, 0.0]))
    views, frames = [], []
    for k, pose in enumerate(poses, 1):
        views += [
            View(f"left/{k:04d}", 1, camera, pose),
            View(f"right/{k:04d}", 2, camera, right_from_left @ pose),
        ]
        frames.append(Frame(k, 1, pose, {1: 2 * k - 1, 2: 2 * k}))
    return Scene("rig", world, tuple(views), (Rig(1, 1, {2: right_from_left}),), tuple(frames))
