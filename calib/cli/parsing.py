"""Options from dataclasses, in the same manner for all commands."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias, TypeVar

import tyro

from sfm.core.errors import ConfigError

if TYPE_CHECKING:
    from calib.boards import Board

Options = TypeVar("Options")

Flag: TypeAlias = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
"""An option without a value, off unless it is given."""


def parsed(options: type[Options], command: str, words: Sequence[str], examples: Sequence[str]) -> Options:
    """The options that `words` name; the docstring of the class is the help, that of each field its option's.

    Raises:
        SystemExit: with 0 after `--help`, with 2 where an option is unknown or its value does not do.
    """
    shown = "\n".join(f"  {example}" for example in examples)
    return tyro.cli(
        options,
        prog=f"calib {command}",
        description=f"{inspect.getdoc(options)}\n\nExamples:\n{shown}",
        args=list(words),
        config=(tyro.conf.FlagCreatePairsOff, tyro.conf.HelptextFromCommentsOff),
    )


def board_of(text: str) -> Board:
    """The board that `--board` names: a `board.toml`, or a word such as `chessboard:9x6:25mm`.

    Raises:
        InputError: the file cannot be read.
        ConfigError: file or word describe no board.
    """
    from calib.boards_text import parse_board, parse_board_toml
    from sfm.io.atomic import os_errors

    if not text.lower().endswith(".toml"):
        return parse_board(text)
    path = Path(text)
    with os_errors(path):
        content = path.read_bytes()
    try:
        return parse_board_toml(content.decode())
    except ConfigError as error:
        raise ConfigError(error.cause, path=path, remedy=error.remedy) from error
    except UnicodeDecodeError as error:
        raise ConfigError("is no text in UTF-8", path=path) from error


def pixel_size(text: str) -> tuple[int, int]:
    """Width and height of `752x480`.

    Raises:
        ConfigError: it is no size.
    """
    found = re.fullmatch(r"\s*(\d+)\s*[x×,]\s*(\d+)\s*", text.lower())
    if not found or min(int(found[1]), int(found[2])) < 1:
        raise ConfigError(f"{text!r} is no size", remedy="give width and height in px, as in 752x480")
    return int(found[1]), int(found[2])
