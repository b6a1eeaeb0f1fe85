"""`sfm match`: the matches of the chosen pairs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from sfm.cli.parsing import parsed
from sfm.cli.stages import StageOptions, run_stage

EXAMPLES = (
    "sfm match scene",
    "sfm match scene --set matching.max_ratio=0.75",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MatchOptions(StageOptions):
    """Matches the features of the chosen pairs of photos.

    Features and pairs that are missing come first. Which matches a rigid scene explains is for `sfm verify` to say.
    """


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(MatchOptions, "match", words, EXAMPLES)
    from sfm.pipeline.single_stages import run_matching

    return run_stage(
        options,
        options.workspace,
        lambda config, observer: run_matching(options.workspace, config, threads=options.threads, observer=observer),
        as_json=options.json,
    )
