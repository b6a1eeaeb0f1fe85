"""What a single stage came to: a few lines for a person, or all figures for a program."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

_NAMED_AT_MOST = 5


@dataclasses.dataclass(frozen=True, slots=True)
class FeaturesReport:
    """Keypoints of each image, why some have none, and the files that are no photos."""

    workspace: Path
    keypoints: Mapping[str, int]
    refused: Mapping[str, str]
    skipped: Mapping[str, str]

    def verdict(self) -> str:
        """A few lines for a person."""
        lines = [f"{_counted(len(self.keypoints), 'image')}, keypoints each: {_spread(self.keypoints.values())}"]
        lines += [_reasons("without features", self.refused)] if self.refused else []
        lines += [_reasons("skipped", self.skipped)] if self.skipped else []
        return "\n".join([*lines, f"next     sfm pairs {self.workspace}"])

    def to_json(self) -> dict[str, Any]:
        """Every figure."""
        return {
            "workspace": str(self.workspace),
            "keypoints": dict(self.keypoints),
            "without_features": dict(self.refused),
            "skipped": dict(self.skipped),
        }


@dataclasses.dataclass(frozen=True, slots=True)
class PairsReport:
    """The pairs to be matched, by names, of all images of the workspace; and why these."""

    workspace: Path
    images: Sequence[str]
    pairs: Sequence[tuple[str, str]]
    why: str

    def verdict(self) -> str:
        """A few lines for a person."""
        count = len(self.images)
        partners = Counter(dict.fromkeys(self.images, 0))
        partners.update(name for pair in self.pairs for name in pair)
        alone = [name for name in self.images if not partners[name]]
        lines = [
            f"{len(self.pairs)} of {count * (count - 1) // 2} pairs of {_counted(count, 'image')}: {self.why}",
            f"partners of each image: {_spread(partners.values())}",
        ]
        lines += [f"without a partner: {_named(alone)}"] if alone else []
        return "\n".join([*lines, f"next     sfm match {self.workspace}"])

    def to_json(self) -> dict[str, Any]:
        """Every pair."""
        pairs = [list(pair) for pair in self.pairs]
        return {"workspace": str(self.workspace), "images": list(self.images), "why": self.why, "pairs": pairs}


@dataclasses.dataclass(frozen=True, slots=True)
class MatchesReport:
    """Matches of each pair; verification needs `needed` of them."""

    workspace: Path
    matches: Mapping[tuple[str, str], int]
    needed: int

    def verdict(self) -> str:
        """A few lines for a person."""
        enough = [count for count in self.matches.values() if count >= self.needed]
        few = len(self.matches) - len(enough)
        lines = [
            f"{_counted(len(self.matches), 'pair')}, matches each: {_spread(self.matches.values())}",
            f"{_counted(few, 'pair')} with fewer than {self.needed}, which verification will not look at",
        ]
        best = sorted(self.matches, key=lambda pair: (-self.matches[pair], pair))[:3]
        lines += [f"{self.matches[pair]:8d} {pair[0]} – {pair[1]}" for pair in best if self.matches[pair]]
        return "\n".join([*lines, f"next     sfm verify {self.workspace}"])

    def to_json(self) -> dict[str, Any]:
        """The count of each pair."""
        rows = [{"image1": a, "image2": b, "matches": count} for (a, b), count in self.matches.items()]
        return {"workspace": str(self.workspace), "needed": self.needed, "pairs": rows}


@dataclasses.dataclass(frozen=True, slots=True)
class VerifiedPair:
    """A pair after verification: its kind and median triangulation angle, or the reason why it was rejected."""

    image1: str
    image2: str
    matches: int
    inliers: int
    kind: str
    angle_deg: float | None
    reason: str


@dataclasses.dataclass(frozen=True, slots=True)
class VerificationReport:
    """All pairs, and the images that they join, the largest group first; watermarks join nothing."""

    workspace: Path
    images_folder: Path
    pairs: Sequence[VerifiedPair]
    groups: Sequence[Sequence[str]]

    def verdict(self) -> str:
        """A table of the kinds, the reasons of the others, and what hangs together."""
        kept = [pair for pair in self.pairs if pair.kind]
        lines = [f"{len(kept)} of {_counted(len(self.pairs), 'pair')} verified"]
        lines += _table_of_kinds(kept)
        lines += [
            f"  rejected: {count} × {reason.replace('_', ' ')}"
            for reason, count in Counter(pair.reason for pair in self.pairs if pair.reason).most_common()
        ]
        linked = [group for group in self.groups if len(group) > 1]
        alone = [group[0] for group in self.groups if len(group) == 1]
        images = sum(map(len, self.groups))
        if linked:
            sizes = ", ".join(str(len(group)) for group in linked)
            lines.append(f"images that hang together: {sizes} of {images}")
        if alone:
            lines.append(f"images without a verified pair: {len(alone)} ({_named(alone)})")
        return "\n".join([*lines, f"next     {self._next()}"])

    def to_json(self) -> dict[str, Any]:
        """Every pair and group."""
        return {
            "workspace": str(self.workspace),
            "pairs": [dataclasses.asdict(pair) for pair in self.pairs],
            "groups": [list(group) for group in self.groups],
        }

    def _next(self) -> str:
        useful = any(pair.kind not in ("", "watermark") for pair in self.pairs)
        return (
            f"sfm run {self.images_folder} -o {self.workspace}"
            if useful
            else "other photos: no two of these show the same scene"
        )


def _table_of_kinds(pairs: Sequence[VerifiedPair]) -> list[str]:
    if not pairs:
        return []
    lines = [f"  {'kind':<20}{'pairs':>6}{'inliers':>9}{'of matches':>12}{'angle':>8}   (medians)"]
    for kind, count in Counter(pair.kind for pair in pairs).most_common():
        rows = [pair for pair in pairs if pair.kind == kind]
        inliers = np.median([pair.inliers for pair in rows])
        share = np.median([pair.inliers / pair.matches for pair in rows])
        angles = [pair.angle_deg for pair in rows if pair.angle_deg is not None]
        angle = f"{np.median(angles):.1f}°" if angles else "–"
        lines.append(f"  {kind.replace('_', ' '):<20}{count:>6}{inliers:>9.0f}{100 * share:>10.0f} %{angle:>8}")
    return lines


def _spread(values: Iterable[int]) -> str:
    """Least, middle and most of some counts."""
    counts = list(values)
    if not counts:
        return "none"
    return f"{min(counts)} to {max(counts)}, {np.median(counts):.0f} in the median"


def _reasons(what: str, reasons: Mapping[str, str]) -> str:
    told = "; ".join(f"{name}: {why}" for name, why in list(reasons.items())[:_NAMED_AT_MOST])
    more = f"; +{len(reasons) - _NAMED_AT_MOST} more" if len(reasons) > _NAMED_AT_MOST else ""
    return f"{len(reasons)} {what}: {told}{more}"


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _named(names: Sequence[str]) -> str:
    more = f", +{len(names) - _NAMED_AT_MOST} more" if len(names) > _NAMED_AT_MOST else ""
    return ", ".join(names[:_NAMED_AT_MOST]) + more
