"""A picture of a COLMAP model: its points and cameras, from the cameras' side.

python scripts/render_cloud.py MODEL OUT.png [--size 1280x960] [--azimuth 30] [--elevation 20] [--zoom 2] [--radius 1.5]
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from sfm.core.errors import SfmError
from sfm.io.colmap_model import read_model
from sfm.viz.figures import choose_view, render_model


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--size", default="1280x960", help="WIDTHxHEIGHT in px")
    parser.add_argument("--azimuth", type=float, default=30, help="degrees to the side of the cameras' mean direction")
    parser.add_argument("--elevation", type=float, default=20, help="degrees above it")
    parser.add_argument(
        "--zoom", type=float, default=1, help="go nearer by this factor, towards the middle of the cameras"
    )
    parser.add_argument("--radius", type=float, default=1.5, help="radius of a point's dot in px")
    parser.add_argument("--frusta", type=float, help="length of a frustum in scene units; 0 for none")
    options = parser.parse_args()
    width, height = (int(word) for word in options.size.split("x"))
    try:
        model = read_model(options.model)
    except SfmError as error:
        print(f"error: {error}", file=sys.stderr)
        return int(error.exit_code)
    azimuth, elevation = np.radians([options.azimuth, options.elevation]).tolist()
    view = choose_view(model, azimuth=azimuth, elevation=elevation, aspect=width / height)
    target = view.target + (1 - 1 / options.zoom) * (model.cams_from_world.center.mean(0) - view.target)
    position = target + (view.position - view.target) / options.zoom
    view = dataclasses.replace(view, position=position, target=target)
    picture = render_model(model, width, height, view=view, point_radius_px=options.radius, frustum_size=options.frusta)
    Image.fromarray(picture).save(options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
