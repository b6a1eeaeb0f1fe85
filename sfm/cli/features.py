"""`sfm features`: the keypoints of all photos."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from sfm.cli.parsing import Flag, parsed
from sfm.cli.run import SettingOptions, default_workspace
from sfm.cli.stages import run_stage
from sfm.core.errors import ConfigError

EXAMPLES = (
    "sfm features photos -o scene",
    "sfm features scene --max-image-size 2400",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeaturesOptions(SettingOptions):
    """Finds the keypoints of all photos, the first stage of `sfm run`; then come `sfm pairs`, `match` and `verify`.

    The first time it needs the folder of the photos, which the workspace then remembers. What is there already is not
    computed again, and `sfm run` goes on from it.
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGES|WORKSPACE", help_behavior_hint="")]
    """Folder of photos, or a workspace that knows its own."""

    output: Annotated[
        Path | None, tyro.conf.arg(aliases=["-o"], metavar="WORKSPACE", help_behavior_hint="(default: IMAGES-sfm)")
    ] = None
    """Workspace for all results. Without it a folder beside the photos."""

    json: Flag = False
    """Every figure as JSON."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(FeaturesOptions, "features", words, EXAMPLES)
    from sfm.pipeline.session import is_workspace
    from sfm.pipeline.single_stages import run_features

    known = is_workspace(options.source)
    if known and options.output:
        raise ConfigError(
            f"{options.source} is a workspace, so that -o has no meaning", remedy="name the folder of the photos"
        )
    images = None if known else options.source
    workspace = options.source if known else options.output or default_workspace(options.source)
    return run_stage(
        options,
        workspace,
        lambda config, observer: run_features(images, workspace, config, threads=options.threads, observer=observer),
        as_json=options.json,
    )
