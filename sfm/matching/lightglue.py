"""Matches by a network that comes as an ONNX file: LightGlue.

The network is given  kpts0, kpts1 (1, N, 2)  and  desc0, desc1 (1, N, D),  and answers with pairs of rows (M, 2) and
a score for each. Keypoints are  (x − (W, H)/2) / (max(W, H)/2),  descriptors those of the network that found the
features (see `sfm.features.learned`), as unit vectors.

Reference:
    Lindenberger, Sarlin & Pollefeys, LightGlue: Local Feature Matching at Light Speed, ICCV 2023.
"""

from __future__ import annotations

import hashlib
import threading
from pathlib import Path

import cv2
import numpy as np

from sfm.core.arrays import FloatArray
from sfm.core.errors import ConfigError
from sfm.core.scene import DescriptorKind, Features, Matches

_OFFSET, _SCALE = 128.0, 256.0
_REMEDY = "give the ONNX file of LightGlue with inputs kpts0, kpts1, desc0, desc1"


class LightGlue:
    """The network of a file; one thread at a time asks it. `digest` stands for its content.

    Raises:
        ConfigError: the file is missing, or is no network.
    """

    def __init__(self, path: Path | str) -> None:
        self._path, self._lock = Path(path), threading.Lock()
        try:
            data = self._path.read_bytes()
        except OSError as error:
            raise ConfigError(f"cannot be read: {(error.strerror or str(error)).lower()}", path=path) from error
        self.digest = hashlib.blake2b(data, digest_size=16).hexdigest()
        try:
            self._net = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
            self._names = list(self._net.getUnconnectedOutLayersNames())
        except cv2.error as error:
            raise ConfigError("is no network that OpenCV can read", path=path, remedy=_REMEDY) from error

    def match(
        self,
        features1: Features,
        features2: Features,
        size1: tuple[int, int],
        size2: tuple[int, int],
        min_score: float = 0.0,
    ) -> Matches:
        """Matches with at least `min_score`, each feature once: in the one of highest score; sorted.

        Args:
            size1, size2: width and height of the images in px.
        Raises:
            ValueError: the features are not those of a network.
            ConfigError: the network answers with something else.
        """
        for features in (features1, features2):
            if features.kind != DescriptorKind.LEARNED:
                raise ValueError(f"LightGlue matches learned features, got {features.kind.name}")
        if not len(features1) or not len(features2):
            return Matches(np.zeros((0, 2), np.int32))
        inputs = {}
        for k, (features, size) in enumerate(((features1, size1), (features2, size2))):
            inputs[f"kpts{k}"], inputs[f"desc{k}"] = _normalised(features, size)
        pairs, scores = self._told(self._forward(inputs), len(features1), len(features2))
        return Matches(_once(pairs[scores >= min_score], scores[scores >= min_score]))

    def _forward(self, inputs: dict[str, np.ndarray]) -> list[np.ndarray]:
        try:
            with self._lock:
                for name, values in inputs.items():
                    self._net.setInput(values, name)
                return [np.array(output) for output in self._net.forward(self._names)]
        except cv2.error as error:
            raise ConfigError("the network does not take these features", path=self._path, remedy=_REMEDY) from error

    def _told(self, outputs: list[np.ndarray], count1: int, count2: int) -> tuple[np.ndarray, FloatArray]:
        """Pairs (M, 2) and scores (M,)."""
        # Two matches have two scores, which look like one match: names that tell come first.
        told = sorted(zip(self._names, outputs, strict=True), key=lambda named: "score" in named[0])
        tables = [(name, o) for name, o in told if o.ndim >= 2 and o.shape[-1] == 2]
        chosen, table = tables[0] if tables else ("", None)
        pairs = None if table is None else table.reshape(-1, 2)
        others = [o for name, o in reversed(told) if name != chosen]
        scores = None if pairs is None else next((o.reshape(-1) for o in others if o.size == len(pairs)), None)
        if pairs is None or scores is None:
            shapes = ", ".join(f"{n} {o.shape}" for n, o in zip(self._names, outputs, strict=True))
            raise ConfigError(f"the network answers with {shapes}", path=self._path, remedy=_REMEDY)
        rows = np.rint(pairs).astype(np.int64)
        known = ((rows >= 0) & (rows < [count1, count2])).all(axis=1)
        return rows[known], scores[known].astype(np.float64)


def _normalised(features: Features, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    extent = np.array(size, np.float64)
    # Networks have the first pixel's centre at 0.
    points = (features.points2D - 0.5 - extent / 2) / (extent.max() / 2)
    descriptors = (features.descriptors.astype(np.float64) - _OFFSET) / _SCALE
    return points[None].astype(np.float32), descriptors[None].astype(np.float32)


def _once(pairs: np.ndarray, scores: FloatArray) -> np.ndarray:
    order = np.argsort(-scores, kind="stable")
    for column in (0, 1):
        _, first = np.unique(pairs[order, column], return_index=True)
        order = order[np.sort(first)]
    kept = pairs[order]
    return kept[np.lexsort((kept[:, 1], kept[:, 0]))].astype(np.int32)
