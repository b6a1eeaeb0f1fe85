"""Names for what a result was computed from.

A stored result carries the key  hash(inputs, settings of its stage, code of its stage).  A run recomputes what carries
another key, and nothing else: one new image does not redo a thousand.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sfm.core.cameras import Camera


def key_of(*parts: Any) -> str:
    """A short hash of strings, numbers, arrays, cameras and settings, also nested in lists and dictionaries."""
    text = json.dumps(parts, default=_plain, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def file_digest(path: Path) -> str:
    """A hash of the content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


@cache
def code_digest(*packages: str) -> str:
    """A hash of the sources of packages, so that a changed algorithm does not pass old results for its own."""
    digest = hashlib.blake2b(digest_size=16)
    for package in packages:
        spec = importlib.util.find_spec(package)
        for root in (spec.submodule_search_locations or []) if spec else []:
            for path in sorted(Path(root).rglob("*.py")):
                digest.update(f"{package}/{path.relative_to(root).as_posix()}".encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    match value:
        case Camera():
            return [value.model, value.width, value.height, value.params.tolist(), value.has_prior_focal_length]
        case np.ndarray():
            return [str(value.dtype), list(value.shape), hashlib.blake2b(value.tobytes()).hexdigest()]
        case np.generic():
            return value.item()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    raise TypeError(f"{type(value).__name__} has no key")
