"""From the file of one photo to its features: read, hidden by its mask, prepared, searched; and the account of it."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from sfm.core.cameras import Camera
from sfm.core.errors import ConfigError, ImageError, Rejected
from sfm.core.scene import Features
from sfm.features import NETWORKS, FeatureConfig, descriptor_kind, extract
from sfm.io.database import Decision
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

    def prepare_and_tell(reduced: UInt8[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
        prepared = prepare(reduced, config.prepare)
        verdict = "+".join(prepared.steps) or "as it is"
        decisions.append(decide("preparation", None, None, verdict, prepared.summary()))
        return prepared.image

    preparation = None if config.prepare.mode == "off" else prepare_and_tell
    found = extract(grey, config.features, mask, prepare=preparation)
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
