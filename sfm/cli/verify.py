"""`sfm verify`: which matches a rigid scene explains."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from sfm.cli.parsing import parsed
from sfm.cli.stages import StageOptions, run_stage

EXAMPLES = (
    "sfm verify scene",
    "sfm verify scene --set verification.ransac.max_error_px=2",
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class VerifyOptions(StageOptions):
    """Finds the geometry of the matched pairs: its kind, the matches that agree with it, and why others have none.

    Stages that are missing come first. Where the verified pairs leave weak spots, more pairs are matched and verified,
    as `sfm run` does, which then has only the mapping left.
    """


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(VerifyOptions, "verify", words, EXAMPLES)
    from sfm.pipeline.single_stages import run_verification

    return run_stage(
        options,
        options.workspace,
        lambda config, observer: run_verification(
            options.workspace, config, threads=options.threads, observer=observer
        ),
        as_json=options.json,
    )
