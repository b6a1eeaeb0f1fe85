"""Options from dataclasses, in the same manner for all commands."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypeAlias, TypeVar

import tyro

Options = TypeVar("Options")

Flag: TypeAlias = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
"""An option without a value, off unless it is given."""
Model: TypeAlias = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MODEL", help_behavior_hint="")]
"""A workspace, or the folder of a COLMAP model."""


def parsed(options: type[Options], command: str, words: Sequence[str], examples: Sequence[str]) -> Options:
    """The options that `words` name; the docstring of the class is the help, that of each field its option's.

    Args:
        examples: command lines, shown with the help.
    Raises:
        SystemExit: with 0 after `--help`, with 2 where an option is unknown or its value does not do.
    """
    shown = "\n".join(f"  {example}" for example in examples)
    description = f"{inspect.getdoc(options)}\n\nExamples:\n{shown}"
    return tyro.cli(
        options,
        prog=f"sfm {command}",
        description=description,
        args=list(words),
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.HelptextFromCommentsOff),
    )
