"""What the commands of single stages have in common: they go on in a workspace, and print what a stage came to."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Protocol

import tyro

from sfm.cli.parsing import Flag
from sfm.cli.run import SettingOptions, check, configured
from sfm.core.errors import ExitCode
from sfm.core.events import Note, Observer


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageOptions(SettingOptions):
    """A stage on a workspace."""

    workspace: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="WORKSPACE", help_behavior_hint="")]
    """That of `sfm features` or `sfm run`; it knows its photos."""

    json: Flag = False
    """Every figure as JSON."""


class Report(Protocol):
    """What a stage came to."""

    def verdict(self) -> str:
        """A few lines for a person."""
        ...

    def to_json(self) -> dict[str, Any]:
        """All figures."""
        ...


def run_stage(
    options: SettingOptions, workspace: Path, stage: Callable[[Any, Observer], Report], *, as_json: bool
) -> ExitCode:
    """Settings, progress on stderr, the stage itself, and its result on stdout."""
    check(options)
    from sfm.pipeline.observers import screen_progress, watched

    with watched(screen_progress()) as observer:
        config, note = configured(options, workspace)
        if note:
            observer(Note(message=note))
        report = stage(config, observer)
    print(json.dumps(report.to_json(), indent=2, ensure_ascii=False) if as_json else report.verdict())
    return ExitCode.OK
