"""Standard output and error, and the signals that end a program: what a command must bear from those around it.

A reader such as `head` goes away, a disk to which output is sent fills up, a shell closes a stream, a name of a file
is no text, a user presses Ctrl-C. None of it is a reason for a traceback, and the first is none to stop the work.
"""

from __future__ import annotations

import codecs
import contextlib
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Any, TextIO

from sfm.core.errors import InputError

_ESCAPED = "parallax-escaped"
_ENDING = ("SIGINT", "SIGTERM", "SIGHUP")
_TWICE_S = 0.5
"""Within it a second signal is the same again: the terminal sends it, and so does many a program that started us."""


@contextlib.contextmanager
def standard_streams() -> Iterator[None]:
    """Within, printing goes on when the reader has gone, and what cannot be encoded is escaped.

    Streams that somebody replaced, for instance a notebook, stay as they are. The block must flush.
    """
    _fill_closed()
    codecs.register_error(_ESCAPED, _escaped)
    before = sys.stdout, sys.stderr
    if sys.stdout is sys.__stdout__:
        sys.stdout = _forgiving(sys.stdout, 1, "standard output")
    if sys.stderr is sys.__stderr__:
        sys.stderr = _forgiving(sys.stderr, 2, "")
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def _fill_closed() -> None:
    """A database that got the number of a closed stream would have messages written into it."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free


def _forgiving(stream: TextIO | None, number: int, name: str) -> Any:
    buffer = getattr(stream, "buffer", None)
    if stream is not None and not isinstance(getattr(buffer, "raw", buffer), io.FileIO):
        return stream  # a console of Windows
    outlet = _Outlet(number, name)
    return io.TextIOWrapper(
        outlet if isinstance(buffer, io.FileIO) else io.BufferedWriter(outlet),  # the former with PYTHONUNBUFFERED
        encoding=stream.encoding if stream else "utf-8",
        errors=_ESCAPED,
        line_buffering=getattr(stream, "line_buffering", False),
        write_through=getattr(stream, "write_through", False),
    )


class _Outlet(io.FileIO):
    """A stream that leads nowhere from its first failure on.

    Args:
        name: with one, a failure other than that nobody reads any more is an error.
    """

    def __init__(self, number: int, name: str) -> None:
        super().__init__(number, "w", closefd=False)
        self._told_as = name

    def write(self, data: Any, /) -> int:
        """As of any file.

        Raises:
            InputError: for instance the disk is full; only the first time.
        """
        try:
            return super().write(data)
        except OSError as error:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            if self._told_as and not isinstance(error, BrokenPipeError):
                raise InputError((error.strerror or str(error)).lower(), path=self._told_as) from error
            return memoryview(data).nbytes


def _escaped(error: UnicodeError, /) -> tuple[str | bytes, int]:
    """Bytes in the name of a file come out as they went in; signs that the encoding lacks as `\\u2192`."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.backslashreplace_errors(error)


class Interruptions:
    """Ctrl-C, or a request of the system to end: the first becomes a `KeyboardInterrupt`, the second ends at once.

    `signal` is the number of the first, or 0. It remains true where a library has made another exception of it.
    """

    def __init__(self) -> None:
        self.signal = 0
        self._time_s = 0.0
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interruptions:
        if threading.current_thread() is threading.main_thread():
            for number in (getattr(signal, name) for name in _ENDING if hasattr(signal, name)):
                before = signal.getsignal(number)
                if before in (signal.SIG_DFL, signal.default_int_handler):  # `nohup` has some ignored
                    self._before[number] = signal.signal(number, self._interrupt)
        return self

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)

    def _interrupt(self, number: int, _: FrameType | None) -> None:
        now_s = time.monotonic()
        if not self.signal:
            self.signal, self._time_s = number, now_s
            raise KeyboardInterrupt
        if now_s > self._time_s + _TWICE_S:
            with contextlib.suppress(OSError):  # nothing may be printed within a signal
                os.write(2, (b"\x1b[?25h" if os.isatty(2) else b"") + b"\nended at once\n")
            os._exit(128 + number)
