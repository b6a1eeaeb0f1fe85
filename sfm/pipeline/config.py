"""All settings of a run, and their TOML form.

Precedence: defaults < `sfm.toml` in the workspace < command line.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from sfm.core.cameras import COLMAP_MODELS
from sfm.core.errors import ConfigError
from sfm.features import FeatureConfig, TrackingConfig
from sfm.mapping import MappingConfig
from sfm.matching import MatchingConfig
from sfm.prepare import PrepareConfig
from sfm.retrieval import RetrievalConfig
from sfm.verification import VerificationConfig
from sfm.viewgraph import CycleConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """Which cameras took the images."""

    model: str = "SIMPLE_RADIAL"
    """Camera model, COLMAP's name. One focal length and one distortion parameter are what photos of any scene
    determine safely. Ignored where `intrinsics` are given."""

    sharing: Literal["auto", "single", "folder", "image"] = "auto"
    """Which images share a camera: those of equal size, make, model and focal length (auto), all of them (single),
    those of a folder, or none (image). Fewer parameters are better determined."""

    intrinsics: str = ""
    """A COLMAP cameras.txt or a Parallax camera TOML; empty where the cameras are not known."""

    refine_intrinsics: bool = False
    """Adjust given intrinsics too. Those that were not given are always adjusted."""

    def __post_init__(self) -> None:
        names = [model.name for model in COLMAP_MODELS]
        if self.model not in names:
            raise ConfigError(f"unknown camera model {self.model!r}", remedy=nearest(self.model, names))
        if self.sharing not in ("auto", "single", "folder", "image"):
            raise ConfigError(f"cameras.sharing must be auto, single, folder or image, got {self.sharing!r}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PipelineConfig:
    """The settings of all stages; the same settings and photos give the same bytes."""

    cameras: CameraConfig = dataclasses.field(default_factory=CameraConfig)
    prepare: PrepareConfig = dataclasses.field(default_factory=PrepareConfig)
    features: FeatureConfig = dataclasses.field(default_factory=FeatureConfig)
    tracking: TrackingConfig = dataclasses.field(default_factory=TrackingConfig)
    """Of the features `klt`."""
    retrieval: RetrievalConfig = dataclasses.field(default_factory=RetrievalConfig)
    matching: MatchingConfig = dataclasses.field(default_factory=MatchingConfig)
    verification: VerificationConfig = dataclasses.field(default_factory=VerificationConfig)
    cycles: CycleConfig = dataclasses.field(default_factory=CycleConfig)
    mapping: MappingConfig = dataclasses.field(default_factory=MappingConfig)
    masks: str = ""
    """Folder of masks, black where nothing shall be sought (see `sfm.io.masks`); empty for a folder called masks in
    that of the photos or beside it, if there is one; none for no masks."""
    seed: int = 0
    """Of all random choices."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ConfigError(f"seed must not be negative, got {self.seed}")
        if self.features.kind == "klt" and self.matching.guided:
            raise ConfigError("the corners of klt have no descriptors that guided matching could compare")


DEFAULTS = PipelineConfig()


def with_settings(config: PipelineConfig, settings: Mapping[str, Any], source: Path | str) -> PipelineConfig:
    """`config` with other values at some dotted keys, e.g. `{"features.max_features": 4000}`.

    Raises:
        ConfigError: a key is unknown, or a value has the wrong type or range; it names `source`.
    """
    known = dict(flattened(config))
    for key, value in settings.items():
        if key not in known:
            raise ConfigError(f"unknown setting {key!r}", path=source, remedy=nearest(key, list(known)))
        config = _replaced(config, key.split("."), value, key, source)
    return config


def read_toml(path: Path, base: PipelineConfig) -> PipelineConfig:
    """`base` with the settings that the file names.

    Raises:
        ConfigError: the file is no TOML, or as for `with_settings`.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"cannot be read as TOML: {error}", path=path) from error
    return with_settings(base, dict(_flat_table(table)), path)


def to_toml(config: PipelineConfig) -> str:
    """All settings as TOML."""
    sections: dict[str, list[str]] = {}
    for key, value in flattened(config):
        section, _, name = key.rpartition(".")
        sections.setdefault(section, []).append(f"{name} = {json.dumps(value, ensure_ascii=False)}")
    top = "\n".join(sections.pop("", []))
    tables = [f"[{section}]\n" + "\n".join(lines) for section, lines in sections.items()]
    return "\n\n".join([top, *tables]) + "\n"


def parsed_setting(text: str) -> tuple[str, Any]:
    """Key and value of `key=value`; the value as in TOML, or a bare word.

    Raises:
        ConfigError: there is no `=`.
    """
    key, equals, value = text.partition("=")
    if not equals:
        raise ConfigError(f"expected KEY=VALUE, got {text!r}", remedy="e.g. --set features.max_features=4000")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


def flattened(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of nested dataclasses; None is left out, TOML has none."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from flattened(value, f"{prefix}{field.name}.")
        elif value is not None:
            yield f"{prefix}{field.name}", value


def nearest(word: str, known: list[str]) -> str:
    """A hint that names the known word nearest to `word`, or all if few."""
    lower = {name.lower(): name for name in known}
    lower |= {name.lower().rpartition(".")[2]: name for name in known}
    close = difflib.get_close_matches(word.lower(), lower, n=1, cutoff=0.5)
    if close:
        return f"did you mean {lower[close[0]]}?"
    return f"known are {', '.join(known[:20])}"


def _flat_table(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat_table(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _replaced(config: Any, names: list[str], value: Any, key: str, source: Path | str) -> Any:
    name, *rest = names
    if rest:
        inner = _replaced(getattr(config, name), rest, value, key, source)
    else:
        inner = _converted(value, typing.get_type_hints(type(config))[name], key, source)
    try:
        return dataclasses.replace(config, **{name: inner})
    except ConfigError as error:
        raise ConfigError(error.cause, path=error.path or source, remedy=error.remedy) from error
    except ValueError as error:
        raise ConfigError(str(error), path=source) from error


def _converted(value: Any, hint: Any, key: str, source: Path | str) -> Any:
    options = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    for option in options:
        if typing.get_origin(option) is Literal:
            if value in typing.get_args(option):
                return value
        elif option is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
        elif isinstance(option, type) and isinstance(value, option) and isinstance(value, bool) == (option is bool):
            return value
    expected = " or ".join(
        " | ".join(map(str, typing.get_args(option))) if typing.get_origin(option) is Literal else option.__name__
        for option in options
    )
    raise ConfigError(f"{key} must be {expected}, got {value!r}", path=source)
