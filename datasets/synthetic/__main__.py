"""`python -m datasets.synthetic SCENE -o DIR`: renders a scene with its truth."""

from __future__ import annotations

import argparse
import sys
import time

from datasets.synthetic.scenes import NAMES, make_scene
from datasets.synthetic.sensor import CLEAN, SensorConfig
from datasets.synthetic.writer import write_scene
from sfm.core.cameras import COLMAP_MODELS
from sfm.core.errors import SfmError


def main(arguments: list[str] | None = None) -> int:
    """Runs the command and returns its exit code."""
    options = _parser().parse_args(arguments)
    try:
        _run(options)
    except SfmError as error:
        print(error, file=sys.stderr)
        return int(error.exit_code)
    return 0


def _run(options: argparse.Namespace) -> None:
    width, height = options.size
    scene = make_scene(
        options.scene, images=options.images, width=width, height=height, camera_model=options.camera_model,
        fov_deg=options.fov, seed=options.seed,
    )  # fmt: skip
    start = time.perf_counter()
    written = write_scene(
        scene, options.output, sensor=_sensor(options), seed=options.seed, maps=options.maps, samples=options.samples,
        threads=options.threads,
    )  # fmt: skip
    for count, name in enumerate(written, 1):
        seconds = (time.perf_counter() - start) / count
        print(f"{count}/{len(scene.views)} {name}  {seconds:.2f} s an image", file=sys.stderr)
    print(options.output)


def _sensor(options: argparse.Namespace) -> SensorConfig:
    if options.clean:
        return CLEAN
    return SensorConfig(
        noise=options.noise, blur_px=options.blur, vignetting=options.vignetting,
        exposure_jitter_ev=options.exposure_jitter, jpeg_quality=options.jpeg_quality or None,
    )  # fmt: skip


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.partition("x")
    if not cross or not width.isdigit() or not height.isdigit() or min(int(width), int(height)) < 2:
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, such as 1280x960, got {text!r}")
    return int(width), int(height)


def _positive(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text!r}")
    return int(text)


def _parser() -> argparse.ArgumentParser:
    usual = SensorConfig()
    parser = argparse.ArgumentParser(prog="python -m datasets.synthetic", description=__doc__)
    add = parser.add_argument
    add("scene", choices=NAMES)
    add("-o", "--output", required=True, help="folder for images/ and truth/")
    add("--images", type=_positive, help="number of moments; the scene's own by default")
    add("--size", type=_size, default=(1280, 960), help="WIDTHxHEIGHT in px (1280x960)")
    add("--camera-model", choices=[model.name for model in COLMAP_MODELS], default="SIMPLE_RADIAL")
    add("--fov", type=float, help="horizontal field of view in degrees; the scene's own by default")
    add("--seed", type=int, default=0)
    add("--samples", type=_positive, default=2, help="rays a side of a pixel that needs more than one (2)")
    add("--no-maps", dest="maps", action="store_false", help="no depth and normals")
    add("--threads", type=_positive, help="all cores by default")
    sensor = parser.add_argument_group("sensor").add_argument
    sensor("--clean", action="store_true", help="no sensor effects, PNG")
    sensor("--noise", type=float, default=usual.noise, help="standard deviation at white, as a share of it")
    sensor("--blur", type=float, default=usual.blur_px, help="standard deviation in px")
    sensor("--vignetting", type=float, default=usual.vignetting, help="share of light lost at the corners")
    sensor("--exposure-jitter", type=float, default=usual.exposure_jitter_ev, help="stops, from image to image")
    sensor("--jpeg-quality", type=int, default=usual.jpeg_quality, help="1 to 100; 0 writes PNG")
    return parser


if __name__ == "__main__":
    sys.exit(main())
