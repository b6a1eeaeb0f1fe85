"""What a run was and took, for people who want to repeat it."""

from __future__ import annotations

import dataclasses
import json
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import sfm
from sfm.io.atomic import write_text
from sfm.pipeline.config import PipelineConfig, flattened
from sfm.pipeline.report import RunReport

_SHAPING_PACKAGES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "pillow", "pycolmap")


def write_manifest(
    path: Path, images_folder: Path, config: PipelineConfig, keys: Mapping[str, str], report: RunReport
) -> None:
    """Versions, settings, the key, time and figures of each stage, as JSON.

    Args:
        keys: one for each stage; equal keys stand for equal inputs, settings and code.
    """
    stages = {
        stage: {"key": keys.get(stage, ""), "time_s": round(seconds, 3)}
        for stage, seconds in report.stage_times_s.items()
    }
    manifest = {
        "parallax": sfm.__version__,
        "finished_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "system": platform.platform(),
        "packages": {name: installed_version(name) for name in _SHAPING_PACKAGES},
        "images_folder": str(images_folder),
        "seed": config.seed,
        "settings": dict(flattened(config)),
        "stages": stages,
        "peak_memory_bytes": report.peak_memory_bytes,
        "images": report.images,
        "skipped": dict(report.skipped),
        "missing": list(report.missing),
        "models": [dataclasses.asdict(model) for model in report.models],
    }
    write_text(path, json.dumps(manifest, indent=2, ensure_ascii=False) + "\n")


def installed_version(name: str) -> str | None:
    """The version of a distribution; None where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None
