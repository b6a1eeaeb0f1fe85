"""`sfm pairs`: which pairs of photos are to be matched."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from sfm.cli.parsing import parsed
from sfm.cli.stages import StageOptions, run_stage

EXAMPLES = (
    "sfm pairs scene",
    "sfm pairs scene --json > pairs.json",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PairsOptions(StageOptions):
    """Chooses the pairs of photos that are worth matching, and says why these.

    Features that are missing come first. Of few photos all pairs are chosen, of many those that a cheap look at all
    finds promising.
    """


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(PairsOptions, "pairs", words, EXAMPLES)
    from sfm.pipeline.single_stages import run_pairs

    return run_stage(
        options,
        options.workspace,
        lambda config, observer: run_pairs(options.workspace, config, threads=options.threads, observer=observer),
        as_json=options.json,
    )
