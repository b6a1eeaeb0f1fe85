"""What can go wrong, in three kinds.

A caller's mistake is a `ValueError` or `TypeError`. A user's file or setting is an `SfmError` with path, cause
and remedy: one line on the screen, no traceback. Data that do not allow an operation are a value, `Rejected`.
"""

from __future__ import annotations

import dataclasses
from enum import IntEnum
from pathlib import Path


class ExitCode(IntEnum):
    """Exit codes of the console commands."""

    OK = 0
    BUG = 1
    USAGE = 2
    BAD_INPUT = 3
    RECONSTRUCTION_FAILED = 4
    QUALITY_GATE_FAILED = 5
    MISSING_DEPENDENCY = 6
    WORKSPACE_LOCKED = 7
    INTERRUPTED = 130


class SfmError(Exception):
    """Base of all errors that a user can mend; `exit_code` is what the command returns."""

    exit_code = ExitCode.BAD_INPUT

    def __init__(self, cause: str, *, path: Path | str | None = None, remedy: str = "") -> None:
        self.cause, self.path, self.remedy = cause, path, remedy
        super().__init__(cause, path, remedy)

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), self.cause, self.path, self.remedy)

    def __str__(self) -> str:
        where = f"{self.path}: " if self.path is not None else ""
        remedy = f" — {self.remedy}" if self.remedy else ""
        return f"{where}{self.cause}{remedy}"


def _rebuild(kind: type[SfmError], cause: str, path: Path | str | None, remedy: str) -> SfmError:
    return kind(cause, path=path, remedy=remedy)


class InputError(SfmError):
    """A user's file, folder or setting does not do."""


class ConfigError(InputError):
    """A setting is unknown or out of its range."""

    exit_code = ExitCode.USAGE


class ImageError(InputError):
    """An image cannot be used."""


class FormatError(InputError):
    """A file is not what its name or header promises."""


class ReconstructionError(SfmError):
    """The photos do not allow a reconstruction."""

    exit_code = ExitCode.RECONSTRUCTION_FAILED


class MissingDependencyError(SfmError):
    """An optional dependency is not installed."""

    exit_code = ExitCode.MISSING_DEPENDENCY


class WorkspaceLockedError(SfmError):
    """Another run works in the workspace, or its files come from an incompatible version."""

    exit_code = ExitCode.WORKSPACE_LOCKED


@dataclasses.dataclass(frozen=True, slots=True)
class Rejected:
    """Data that do not allow an operation: counted and reported, never raised.

    `reason` is one of a small set of snake_case words, stable enough to count; `detail` says it with numbers,
    e.g. `Rejected("too_few_inliers", "11 of 15 needed")`. It is falsy, so `if not geometry` reads well.
    """

    reason: str
    detail: str = ""

    def __bool__(self) -> bool:
        return False
