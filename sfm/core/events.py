"""What the stages tell the world: typed events to an injected observer.

Progress bars, the JSON log, the report, the live view and tests are observers. A stage never prints.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol, runtime_checkable


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Base of all events."""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class StageStarted(Event):
    """A stage begins; `total` items lie ahead of it (0: unknown), `cached` more were done by an earlier run."""

    stage: str
    total: int = 0
    cached: int = 0


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class StageFinished(Event):
    """A stage ends; `summary` is one line for a person."""

    stage: str
    summary: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Note(Event):
    """Something a person should read, e.g. that kernels compile; `level` is info or warning."""

    message: str
    level: str = "info"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ImageRead(Event):
    """An image was opened, or skipped for `reason`."""

    name: str
    reason: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class FeaturesExtracted(Event):
    """Keypoints of one image are known."""

    name: str
    count: int


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ImageCompared(Event):
    """What one image has in common with the others is known; this decides which pairs are matched."""

    name: str


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PairMatched(Event):
    """Putative matches of one pair are known."""

    name1: str
    name2: str
    count: int


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PairVerified(Event):
    """The geometry of one pair was estimated (`kind`) or rejected (`reason`)."""

    name1: str
    name2: str
    matches: int
    inliers: int
    kind: str = ""
    reason: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ImageRegistered(Event):
    """An image found its pose, or did not for `reason`."""

    name: str
    registered: int
    points: int
    inliers: int = 0
    needed: int = 0
    visible: int = 0
    reason: str = ""


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class BundlePlanned(Event):
    """An adjustment is about to take its memory; `solver` is dense, sparse or iterative."""

    scope: str
    images: int
    points: int
    observations: int
    solver: str
    memory_bytes: int


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class BundleAdjusted(Event):
    """An adjustment ended."""

    scope: str
    images: int
    points: int
    observations: int
    iterations: int
    initial_cost: float
    final_cost: float
    reason: str


@runtime_checkable
class Observer(Protocol):
    """Anything that can be told of an event."""

    def __call__(self, event: Event, /) -> None:
        """Takes note; must not raise and must not block."""
        ...


def SILENT(event: Event, /) -> None:
    """The observer that does nothing."""
