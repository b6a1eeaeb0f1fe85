"""Those who watch a run: the screen and the two log files.

stdout carries results, so all of this goes to stderr: bars where a person sits at a terminal, otherwise a line every
five seconds or every tenth of a stage.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol, runtime_checkable

from sfm.core.events import (
    Event,
    FeaturesExtracted,
    ImageCompared,
    ImageRead,
    ImageRegistered,
    Note,
    Observer,
    PairMatched,
    PairVerified,
    StageFinished,
    StageStarted,
)

_LINE_EVERY_S = 5.0
_LINE_EVERY_SHARE = 0.1
_LINE_GAP_S = 1.0
"""Between lines at least, however fast the shares pass."""
_ITEMS = (ImageRead, FeaturesExtracted, ImageCompared, PairMatched, PairVerified)


@runtime_checkable
class Watcher(Protocol):
    """An observer that must be told when it is over."""

    def __call__(self, event: Event, /) -> None:
        """Takes note."""
        ...

    def close(self) -> None:
        """Puts screen or file in order; it will not be called again."""
        ...


@contextlib.contextmanager
def watched(*watchers: Watcher) -> Iterator[Observer]:
    """One observer that tells all of them, and closes them when the block ends, however it ends."""

    def tell(event: Event, /) -> None:
        for watcher in watchers:
            watcher(event)

    with contextlib.ExitStack() as stack:
        for watcher in watchers:
            stack.callback(watcher.close)
        yield tell


class _Count:
    """How far the present stage is."""

    def __init__(self) -> None:
        self.stage, self.total, self.done, self.cached = "", 0, 0, 0

    def take(self, event: Event) -> bool:
        """Whether the event moved the count."""
        match event:
            case StageStarted(stage=stage, total=total, cached=cached):
                self.stage, self.total, self.done, self.cached = stage, total, 0, cached
            case ImageRegistered(registered=registered):
                self.done = registered
            case event if isinstance(event, _ITEMS):
                self.done += 1
            case _:
                return False
        return True


class LineProgress:
    """Plain lines where no person sits at a terminal."""

    def __init__(self) -> None:
        self._count = _Count()
        self._said_at, self._said_share = 0.0, 0.0

    def __call__(self, event: Event, /) -> None:
        """Prints a line where one is due."""
        moved = self._count.take(event)
        match event:
            case StageStarted(stage=stage, total=total, cached=cached):
                new = f"{total} to do" if total or not cached else "nothing to do"
                self._say(f"{stage}: {new}" + (f", {cached} known already" if cached else ""))
            case StageFinished(stage=stage, summary=summary):
                self._say(f"{stage}: {summary}")
            case Note(message=message, level=level):
                self._say(message if level == "info" else f"{level}: {message}")
            case _ if moved and self._is_due():
                self._say(f"{self._count.stage}: {self._count.done} of {self._count.total}")

    def close(self) -> None:
        """Nothing is left to be done."""

    def _is_due(self) -> bool:
        waited = time.monotonic() - self._said_at
        share = self._count.done / max(self._count.total, 1)
        return waited >= _LINE_EVERY_S or (waited >= _LINE_GAP_S and share >= self._said_share + _LINE_EVERY_SHARE)

    def _say(self, text: str) -> None:
        with contextlib.suppress(BrokenPipeError):  # that nobody listens any more is no reason to stop the work
            sys.stderr.write(f"{text}\n")
            sys.stderr.flush()
        self._said_at, self._said_share = time.monotonic(), self._count.done / max(self._count.total, 1)


class BarProgress:
    """A bar for each stage on a terminal."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self._bars = Progress(
            TextColumn("{task.description:<12}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[summary]}"),
            console=Console(stderr=True),
        )
        self._count = _Count()
        self._task = None
        self._bars.start()

    def __call__(self, event: Event, /) -> None:
        """Moves the bar of the present stage."""
        moved = self._count.take(event)
        match event:
            case StageStarted(stage=stage, total=total):
                self._task = self._bars.add_task(stage, total=total or None, summary="")
            case StageFinished(summary=summary) if self._task is not None:
                total = max(self._count.total, 1)
                self._bars.update(self._task, total=total, completed=total, summary=summary)
                self._bars.stop_task(self._task)
            case Note(message=message, level=level):
                self._bars.console.print(message, style="yellow" if level == "warning" else "dim", markup=False)
            case _ if moved and self._task is not None:
                self._bars.update(self._task, completed=self._count.done)

    def close(self) -> None:
        """Gives the terminal back."""
        self._bars.stop()


class LogFiles:
    """Everything, in `logs/<utc>-<command>.log` for people and `.jsonl` for programs."""

    def __init__(self, folder: Path, command: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        stem = f"{datetime.now(UTC):%Y%m%dT%H%M%S.%fZ}-{command}"
        self.text_path = folder / f"{stem}.log"
        self._text = self.text_path.open("w", encoding="utf-8")
        self._lines = (folder / f"{stem}.jsonl").open("w", encoding="utf-8")
        self._count = _Count()

    def __call__(self, event: Event, /) -> None:
        """Writes one line into each file."""
        self._count.take(event)
        now = datetime.now(UTC)
        level = getattr(event, "level", "info" if isinstance(event, StageStarted | StageFinished) else "debug")
        name = type(event).__name__
        fields = {f.name: getattr(event, f.name) for f in dataclasses.fields(event)}
        told = " ".join(f"{key}={value}" for key, value in fields.items() if value not in ("", None))
        self._text.write(f"{now:%H:%M:%S.%f} {level:<7} {name} {told}\n")
        progress = {"stage": self._count.stage, "done": self._count.done, "total": self._count.total}
        self._lines.write(
            json.dumps({"ts": now.isoformat(), "level": level, "event": name, **progress, **fields}, default=str) + "\n"
        )
        if level != "debug":
            self._text.flush()
            self._lines.flush()

    def write(self, text: str) -> None:
        """Adds free text, e.g. a traceback, to the log for people."""
        self._text.write(text if text.endswith("\n") else f"{text}\n")
        self._text.flush()

    def close(self) -> None:
        """Closes both files."""
        self._text.close()
        self._lines.close()


def screen_progress() -> Watcher:
    """Bars on a terminal, else lines; `NO_COLOR` and `CI` count as no terminal."""
    quiet = os.environ.get("NO_COLOR") or os.environ.get("CI") or os.environ.get("TERM") == "dumb"
    return BarProgress() if sys.stderr.isatty() and not quiet else LineProgress()
