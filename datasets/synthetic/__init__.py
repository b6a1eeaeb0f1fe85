"""Scenes rendered with exactly known cameras, poses and surfaces.

    scene = make_scene("orbit", images=12, width=640, height=480)
    for name in write_scene(scene, "orbit"): ...            photos and truth on disk
    renderer = Renderer(scene.world)
    renderer.view(scene.views[0])                           radiance, depth, normals
    flow(renderer, scene.views[0], scene.views[1])          optical flow and where it is visible

From a shell: `python -m datasets.synthetic orbit -o orbit --images 12 --size 640x480`.
"""

from datasets.synthetic.paths import example_camera, look_at
from datasets.synthetic.render import Renderer, Rendering
from datasets.synthetic.scenes import NAMES, STILL_NAMES, make_scene
from datasets.synthetic.sensor import CLEAN, SensorConfig, expose
from datasets.synthetic.truth import Flow, RectifiedPair, flow, reconstruction, rectified_pair
from datasets.synthetic.world import Scene, View, World
from datasets.synthetic.writer import photos, write_scene

__all__ = [
    "CLEAN",
    "NAMES",
    "STILL_NAMES",
    "Flow",
    "RectifiedPair",
    "Renderer",
    "Rendering",
    "Scene",
    "SensorConfig",
    "View",
    "World",
    "example_camera",
    "expose",
    "flow",
    "look_at",
    "make_scene",
    "photos",
    "reconstruction",
    "rectified_pair",
    "write_scene",
]
