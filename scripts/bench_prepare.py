"""Verified matches between photos of which one was spoilt, with and without preparation.

    python -m scripts.bench_prepare FOLDER... [--size 800] [--step 1] [--modes off auto] [--json FILE]

Of each folder two pairs of photos that follow each other are taken. The first photo of a pair is spoilt in known ways
(dark, flat, noisy, specks), the second stays as it is. Matches that verification accepts are counted for every mode of
`sfm.prepare`, and for a contrast threshold that is lowered where too little is found.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import get_args

import cv2
import numpy as np

from sfm.core.cameras.priors import infer_camera
from sfm.core.errors import Rejected
from sfm.core.scene import Features
from sfm.features import FeatureConfig
from sfm.features.extraction import extract
from sfm.io.images import list_images, read_image
from sfm.matching import match_features
from sfm.prepare import PrepareConfig, prepare
from sfm.prepare.preparation import PrepareMode
from sfm.verification import verify_pair

FULL_WELL = 4000
"""Electrons of a white pixel at full exposure; three stops below it has an eighth."""
READ_NOISE = 4.0
FEATURES = FeatureConfig(max_features=6000, min_features=0)
LOWERED = FeatureConfig(max_features=6000, min_features=2000)


def linear(value: np.ndarray) -> np.ndarray:
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def encoded(value: np.ndarray) -> np.ndarray:
    value = np.clip(value, 0, 1)
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * np.maximum(value, 1e-9) ** (1 / 2.4) - 0.055)


def underexposed(value: np.ndarray, rng: np.random.Generator, stops: float, noisy: bool) -> np.ndarray:
    light = linear(value) / 2**stops
    if noisy:
        light = (rng.poisson(light * FULL_WELL) + rng.normal(0, READ_NOISE, value.shape)) / FULL_WELL
    return encoded(light)


def speckled(value: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    chance = rng.random(value.shape)
    return np.where(chance < 0.01, 0, np.where(chance > 0.99, 1, value))


SPOILS: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "as they are": lambda value, rng: value,
    "gamma 3": lambda value, rng: value**3,
    "a tenth of the range": lambda value, rng: 0.45 + 0.1 * value,
    "-3 EV": partial(underexposed, stops=3, noisy=False),
    "-3 EV, shot noise": partial(underexposed, stops=3, noisy=True),
    "noise of 6 %": lambda value, rng: value + rng.normal(0, 0.06, value.shape),
    "specks, 2 %": speckled,
}


def spoilt(grey: np.ndarray, name: str) -> np.ndarray:
    value = SPOILS[name](grey / 255, np.random.default_rng(1))
    return np.clip(np.rint(255 * value), 0, 255).astype(np.uint8)


def pairs_of(folder: Path, step: int) -> Iterator[tuple[Path, Path]]:
    names = list_images(folder).names
    for first in sorted({len(names) // 4, len(names) // 2}):
        if first + step < len(names):
            yield folder / names[first], folder / names[first + step]


def reduced(path: Path, size: int) -> np.ndarray:
    grey = read_image(path, gray=True)
    factor = min(1.0, size / max(grey.shape))
    return cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else grey


def verified(grey1: np.ndarray, other: Features, size2: tuple[int, int], config: FeatureConfig, mode: str) -> int:
    preparation = PrepareConfig(mode=mode)  # type: ignore[arg-type]
    found = extract(grey1, config, prepare=lambda image: prepare(image, preparation).image)
    if isinstance(found, Rejected):
        return 0
    matches = match_features(found.features, other)
    camera1, camera2 = (infer_camera("SIMPLE_RADIAL", s[1], s[0], None) for s in (grey1.shape, size2))
    rng = np.random.default_rng(0)
    geometry = verify_pair(found.features.points2D, other.points2D, matches, camera1, camera2, rng=rng)
    return 0 if isinstance(geometry, Rejected) else len(geometry)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--size", type=int, default=800)
    parser.add_argument("--step", type=int, default=1)
    parser.add_argument("--modes", nargs="+", default=list(get_args(PrepareMode)), help="off must be the first")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    cv2.setNumThreads(1)
    modes = [*options.modes, "lowered contrast"]
    counts: dict[str, list[list[int]]] = {name: [] for name in SPOILS}
    for first, second in (pair for folder in options.folders for pair in pairs_of(folder, options.step)):
        grey1, grey2 = reduced(first, options.size), reduced(second, options.size)
        other = extract(grey2, FEATURES)
        if isinstance(other, Rejected):
            continue
        for name in SPOILS:
            image = spoilt(grey1, name)
            row = [verified(image, other.features, grey2.shape, FEATURES, mode) for mode in modes[:-1]]
            row.append(verified(image, other.features, grey2.shape, LOWERED, "off"))
            counts[name].append(row)
        print(f"{first.parent.parent.name}/{first.name} - {second.name}", flush=True)
    print(f"\n{'':22}" + "".join(f"{mode:>18}" for mode in modes) + "\nsums over all pairs")
    for name, rows in counts.items():
        print(f"{name:22}" + "".join(f"{total:18}" for total in np.sum(rows, axis=0)))
    print("worst pair, as a part of `off`, of pairs with at least 30")
    for name, rows in counts.items():
        table = np.array([row for row in rows if row[0] >= 30] or [[1] * len(modes)])
        print(f"{name:22}" + "".join(f"{worst:18.2f}" for worst in (table / table[:, :1]).min(axis=0)))
    if options.json:
        options.json.write_text(json.dumps({"modes": modes, "counts": counts}, indent=1))


if __name__ == "__main__":
    main()
