"""From the files of photos to their features: read, hidden by masks, prepared, searched; and the account of it.

Each photo is searched on its own, but for the frames of a video whose corners are followed: there the features of one
depend on those before it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from sfm.core.arrays import BoolArray
from sfm.core.cameras import Camera
from sfm.core.errors import ConfigError, ImageError, Rejected
from sfm.core.scene import Features
from sfm.features import NETWORKS, FeatureConfig, Frame, descriptor_kind, extract, reduced_image, track_features
from sfm.io.bookkeeping import Decision
from sfm.io.images import read_image
from sfm.io.masks import masked_share, read_mask
from sfm.pipeline.config import PipelineConfig
from sfm.pipeline.keys import file_digest
from sfm.prepare import prepare

STAGE = "features"


@dataclasses.dataclass(frozen=True, slots=True)
class MaskFile:
    """A mask and what stands for its content."""

    path: Path
    digest: str


@dataclasses.dataclass(frozen=True, slots=True)
class SceneImage:
    """An image of the run: its row in the database, its file and what stands for its content."""

    image_id: int
    name: str
    path: Path
    digest: str
    camera_id: int
    camera: Camera
    mask: MaskFile | None = None


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class FoundFeatures:
    """The features of a photo, none where it has none, and the decisions on the way."""

    features: Features
    decisions: tuple[Decision, ...]


def find_features(image: SceneImage, config: PipelineConfig) -> FoundFeatures:
    """The features of a photo outside of its mask."""
    decide = partial(Decision, STAGE, image.name)
    try:
        grey = read_image(image.path, gray=True)
        mask = read_mask(image.mask.path) if image.mask else None
    except ImageError as error:
        return FoundFeatures(_nothing(config.features), (decide("keypoints", 0.0, 1.0, "unreadable", error.cause),))
    decisions: list[Decision] = []
    found = extract(grey, config.features, mask, prepare=partial(_prepared, image, config, decisions))
    if isinstance(found, Rejected):
        decisions.append(decide("keypoints", 0.0, 1.0, found.reason, found.detail))
        return FoundFeatures(_nothing(config.features), tuple(decisions))
    if mask is not None and image.mask:
        percent = 100 * found.masked / max(found.found, 1)
        told = f"{percent:.0f} % of {found.found} keypoints masked, {masked_share(mask):.0%} of the pixels"
        decisions.append(decide("masked_percent", percent, None, "kept", f"{told} ({image.mask.path.name})"))
    wanted = config.features.contrast_threshold
    if found.contrast_threshold < wanted:
        told = f"fewer than {config.features.min_features} keypoints at {wanted:g}"
        decisions.append(decide("contrast_threshold", found.contrast_threshold, wanted, "lowered", told))
    decisions.append(decide("keypoints", float(len(found.features)), 1.0, "kept"))
    return FoundFeatures(found.features, tuple(decisions))


def follow_features(images: Sequence[SceneImage], config: PipelineConfig) -> Iterator[FoundFeatures]:
    """The corners of the frames of a video, one frame after the other.

    The corners of a frame carry the numbers that they have in the frames before; its mask counts for it alone.
    """
    decisions: list[Decision] = []
    full_from_reduced = np.ones(2)

    def frames() -> Iterator[Frame | None]:
        for image in images:
            decisions.clear()
            try:
                grey = read_image(image.path, gray=True)
                mask = read_mask(image.mask.path) if image.mask else None
            except ImageError as error:
                decisions.append(Decision(STAGE, image.name, "keypoints", 0.0, 1.0, "unreadable", error.cause))
                yield None
                continue
            reduced = reduced_image(grey, config.features.max_image_size)
            size = reduced.shape[1], reduced.shape[0]
            if mask is not None and image.mask:
                decisions.append(_sought_outside(image, mask, image.mask))
            full_from_reduced[:] = grey.shape[1] / size[0], grey.shape[0] / size[1]
            if mask is not None and mask.shape != reduced.shape:
                mask = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)
            yield Frame(_prepared(image, config, decisions, reduced), mask)

    for image, features in zip(images, track_features(frames(), config.tracking), strict=True):
        features = dataclasses.replace(features, points2D=features.points2D * full_from_reduced)
        if not decisions or decisions[-1].gate != "keypoints":
            verdict = "kept" if len(features) else "no_features"
            decisions.append(Decision(STAGE, image.name, "keypoints", float(len(features)), 1.0, verdict))
        yield FoundFeatures(features, tuple(decisions))


def _sought_outside(image: SceneImage, mask: BoolArray, file: MaskFile) -> Decision:
    """The share of the pixels that a mask hides: corners are not found first and masked then."""
    hidden = masked_share(mask)
    told = f"corners sought outside of the mask, {hidden:.0%} of the pixels ({file.path.name})"
    return Decision(STAGE, image.name, "masked_percent", 100 * hidden, None, "kept", told)


def _prepared(
    image: SceneImage, config: PipelineConfig, decisions: list[Decision], reduced: UInt8[np.ndarray, "H W"]
) -> UInt8[np.ndarray, "H W"]:
    """The reduced image as features are sought in it; adds to `decisions` what was done to it."""
    if config.prepare.mode == "off":
        return reduced
    prepared = prepare(reduced, config.prepare)
    verdict = "+".join(prepared.steps) or "as it is"
    decisions.append(Decision(STAGE, image.name, "preparation", None, None, verdict, prepared.summary()))
    return prepared.image


def model_digest(config: FeatureConfig) -> str:
    """What stands for the content of the file of a network; empty where features need none.

    Raises:
        ConfigError: there is no such file.
    """
    if config.kind not in NETWORKS:
        return ""
    if not config.model:
        raise ConfigError(f"{config.kind} needs the file of its network", remedy="--set features.model=FILE.onnx")
    try:
        return file_digest(Path(config.model))
    except OSError as error:
        raise ConfigError(f"cannot be read: {(error.strerror or str(error)).lower()}", path=config.model) from error


def _nothing(config: FeatureConfig) -> Features:
    none = np.zeros(0, np.float32)
    return Features(np.zeros((0, 2)), none, none, np.zeros((0, 128), np.uint8), descriptor_kind(config))
