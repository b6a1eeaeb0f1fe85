"""Features of a network that comes as an ONNX file: ALIKED, DISK and others that answer alike.

The network is given the photo as  (1, 3, H, W),  RGB in [0, 1] (grey photos three times the same), its sides filled up
to multiples of 32, and answers with keypoints (N, 2), scores (N) and descriptors (N, D), D ≤ 128; a leading 1 does
not matter. They are told by their names, where these say `keypoint`, `score`, `descriptor`, or else by their shapes.
Keypoints are px with the first pixel's centre at 0, or in [−1, 1] from corner to corner of the input.

Descriptors are made unit vectors and stored as  128 + 256 d,  rounded: distances do not feel the offset, and bytes take
a quarter of the room (two entries in 100,000 beyond ±½ are cut).

Reference:
    Zhao et al., ALIKED, IEEE Trans. Instrumentation and Measurement 2023.
    Tyszkiewicz, Fua & Trulls, DISK, NeurIPS 2020.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from sfm.core.errors import ConfigError
from sfm.features.config import FeatureConfig
from sfm.features.keypoints import Described, Keypoints, Selection

_MULTIPLE = 32
_SCALE, _OFFSET = 256.0, 128.0
_LONGEST = 128
_SIGMA = 1.5
"""Scale that stands for the precision of such keypoints, px."""
_REMEDY = "give the ONNX file of a network that answers with keypoints, scores and descriptors"


class _Network:
    """A network that one thread at a time may ask."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, threading.Lock()
        try:
            data = path.read_bytes()
        except OSError as error:
            raise ConfigError(f"cannot be read: {(error.strerror or str(error)).lower()}", path=path) from error
        try:
            self._net = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
            self._names = list(self._net.getUnconnectedOutLayersNames())
        except cv2.error as error:
            raise ConfigError("is no network that OpenCV can read", path=path, remedy=_REMEDY) from error

    def __call__(self, blob: np.ndarray) -> dict[str, np.ndarray]:
        """The outputs by name, without leading axes of length 1."""
        try:
            with self._lock:
                self._net.setInput(blob)
                outputs: Sequence[Any] = self._net.forward(self._names)
                outputs = [np.array(output) for output in outputs]
        except cv2.error as error:
            height, width = blob.shape[2:]
            cause = f"the network does not take an image of {width}×{height} px"
            raise ConfigError(cause, path=self._path, remedy=_REMEDY) from error
        return dict(zip(self._names, outputs, strict=True))


@lru_cache(maxsize=2)
def _network(path: str, modified_ns: int) -> _Network:
    return _Network(Path(path))


def detect_learned(grey: UInt8[np.ndarray, "H W"], config: FeatureConfig, select: Selection) -> Described:
    """What the network of `config.model` finds.

    Raises:
        ConfigError: the file is missing, is no network, or one that answers with something else.
    """
    if not config.model:
        raise ConfigError(f"{config.kind} needs the file of its network", remedy="--set features.model=FILE.onnx")
    path = Path(config.model)
    try:
        modified = path.stat().st_mtime_ns
    except OSError as error:
        raise ConfigError("there is no such file", path=path, remedy=_REMEDY) from error
    padded = cv2.copyMakeBorder(
        grey, 0, -grey.shape[0] % _MULTIPLE, 0, -grey.shape[1] % _MULTIPLE, cv2.BORDER_REPLICATE
    )
    blob = np.ascontiguousarray(np.repeat((padded.astype(np.float32) / 255)[None, None], 3, axis=1))
    points, scores, descriptors = _told(_network(config.model, modified)(blob), path)
    if len(points) and np.abs(points).max() <= 1:
        points = (points + 1) / 2 * [padded.shape[1], padded.shape[0]] - 0.5
    inside = (points >= -0.5).all(axis=1) & (points <= [grey.shape[1] - 0.5, grey.shape[0] - 0.5]).all(axis=1)
    points, scores, descriptors = points[inside], scores[inside], descriptors[inside]
    keypoints = Keypoints(
        points + 0.5,
        np.full(len(points), _SIGMA, np.float32),
        np.zeros(len(points), np.float32),
        scores.astype(np.float32),
    )
    rows = select(keypoints)
    return keypoints[rows], quantized(descriptors[rows])


def quantized(descriptors: Float[np.ndarray, "N D"]) -> UInt8[np.ndarray, "N D"]:
    """128 + 256 d / |d|, rounded and cut to bytes."""
    lengths = np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
    return np.clip(np.rint(_OFFSET + _SCALE * descriptors / lengths), 0, 255).astype(np.uint8)


def _told(outputs: dict[str, np.ndarray], path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keypoints (N, 2), scores (N,) and descriptors (N, D) of one image."""
    found: dict[str, np.ndarray] = {}
    for name, output in outputs.items():
        values = output.astype(np.float64)
        values = values[0] if values.ndim > 1 and values.shape[0] == 1 and _kind(name, values[0]) else values
        kind = _kind(name, values)
        if kind:
            found[kind] = values.reshape(-1) if kind == "score" else values
    lengths = {len(values) for values in found.values()}
    shapes = ", ".join(f"{name} {output.shape}" for name, output in outputs.items())
    if set(found) != {"keypoint", "score", "descriptor"} or len(lengths) != 1:
        raise ConfigError(f"the network answers with {shapes}", path=path, remedy=_REMEDY)
    return found["keypoint"], found["score"], found["descriptor"]


def _kind(name: str, values: np.ndarray) -> str:
    """Which of the three an output is; empty for none."""
    is_column = values.ndim == 1 or (values.ndim == 2 and values.shape[1] == 1)
    shaped = {
        "keypoint": values.ndim == 2 and values.shape[1] == 2,
        "descriptor": values.ndim == 2 and 2 < values.shape[1] <= _LONGEST,
        "score": is_column,
    }
    named = [kind for kind in shaped if kind in name.lower()]
    return next((kind for kind in named or shaped if shaped[kind]), "")
