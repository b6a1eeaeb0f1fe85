"""A scene on disk: photos, and the truth beside them.

FOLDER/images/*.jpg           photos
FOLDER/truth/sparse/0         COLMAP model: true cameras, poses, points and tracks
FOLDER/truth/depth/*.npy      (H, W) float32, z in metres, NaN where there is no surface
FOLDER/truth/normals/*.npy    (H, W, 3) float16, unit, camera frame, facing the camera, NaN likewise
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from datasets.synthetic.render import Renderer, Rendering
from datasets.synthetic.sensor import SensorConfig, encode, expose
from datasets.synthetic.truth import reconstruction
from datasets.synthetic.world import Scene
from sfm.core.execution import available_threads, ordered_map
from sfm.io.colmap_model import write_model


def photos(
    scene: Scene, renderer: Renderer, sensor: SensorConfig, *, seed: int = 0, threads: int = 1
) -> Iterator[tuple[Rendering, np.ndarray]]:
    """Each view's rendering and photo (H, W, 3) uint8, in the order of the views, `threads` of them at once."""

    def take(row: int) -> tuple[Rendering, np.ndarray]:
        rendering = renderer.view(scene.views[row])
        return rendering, expose(rendering.radiance, sensor, np.random.default_rng([seed, row, 12]))

    yield from ordered_map(take, range(len(scene.views)), threads=threads, ahead=0)


def write_scene(
    scene: Scene,
    folder: Path | str,
    *,
    sensor: SensorConfig = SensorConfig(),
    seed: int = 0,
    maps: bool = True,
    samples: int = 2,
    points_per_image: int = 400,
    threads: int | None = None,
) -> Iterator[str]:
    """Writes a scene, and yields the name of each photo when it is done. The same arguments give the same bytes.

    Args:
        maps: depth and normals are written, too.
        samples: see `Renderer`.
        threads: views at once; all cores by default.
        points_per_image: pixels of each view from which true points are taken.
    """
    folder = Path(folder)
    # A view for each thread: what a single view does in sequence would leave the other cores idle.
    renderer = Renderer(scene.world, threads=1, samples=samples)
    taken = photos(scene, renderer, sensor, seed=seed, threads=threads or available_threads())
    for view, (rendering, photo) in zip(scene.views, taken, strict=True):
        _write(folder / "images" / (view.name + sensor.suffix), encode(photo, sensor))
        if maps:
            _write_array(folder / "truth/depth" / (view.name + ".npy"), rendering.depth.astype(np.float32))
            _write_array(folder / "truth/normals" / (view.name + ".npy"), rendering.normals.astype(np.float16))
        yield view.name + sensor.suffix
    model = reconstruction(scene, renderer, points_per_image=points_per_image, suffix=sensor.suffix, seed=seed)
    (folder / "truth/sparse").mkdir(parents=True, exist_ok=True)
    write_model(model, folder / "truth/sparse/0")


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _write_array(path: Path, array: np.ndarray) -> None:
    buffer = io.BytesIO()
    np.save(buffer, array)
    _write(path, buffer.getvalue())
