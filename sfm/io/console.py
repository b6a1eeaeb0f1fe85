"""What `sfm`, `calib` and `stereo` have in common: a table of commands, and an end in good order whatever happens.

Each command is a module whose `main(words)` returns an exit code. All that goes wrong in it becomes one line on the
screen and a code. This module imports nothing heavy: `sfm --help` answers at once.
"""

from __future__ import annotations

import dataclasses
import difflib
import errno
import importlib
import os
import sys
from collections.abc import Callable, Mapping, Sequence

from sfm.core.errors import ExitCode, SfmError
from sfm.io.standard_streams import Interruptions, standard_streams

_OUTER = ("ENOSPC", "EDQUOT", "EFBIG", "EROFS", "EIO", "EMFILE", "ENFILE", "ENOMEM", "EACCES", "EPERM", "ENAMETOOLONG")
"""Refusals of the system, which no program can prevent, by their names in `errno`."""
_NO_MEMORY_OF_CV2 = -4


@dataclasses.dataclass(frozen=True, kw_only=True)
class Console:
    """A program with commands."""

    program: str
    """Its name; `<program>.cli.<command>` holds a command."""

    version: str

    title: str
    """One line: what goes in, and what comes out."""

    commands: Mapping[str, str]
    """What each is good for, in the order in which they are used."""

    examples: str

    goes_on: Callable[[str, Sequence[str]], bool]
    """Whether a command with these words, repeated after an interruption, goes on where it was."""

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Runs the command line and returns its exit code."""
        words = list(sys.argv[1:] if arguments is None else arguments)
        known = bool(words) and words[0] in self.commands
        goes_on = known and self.goes_on(words[0], words[1:])
        return guarded(lambda: self._answer(words), self.program, words, goes_on=goes_on)

    def _answer(self, words: list[str]) -> int:
        match words[:1]:
            case [] | ["-h" | "--help" | "help"]:
                sys.stdout.write(f"{self.help_text()}\n")
                return ExitCode.OK if words else ExitCode.USAGE
            case ["--version" | "-V"]:
                sys.stdout.write(f"{self.program} {self.version} (Parallax)\n")
                return ExitCode.OK
            case [name] if name not in self.commands:
                return self._unknown_command(name)
        settle_threads_and_kernels()
        return importlib.import_module(f"{self.program}.cli.{words[0]}").main(words[1:])

    def help_text(self) -> str:
        """The table of commands."""
        width = max(map(len, self.commands)) + 2
        rows = "\n".join(f"  {name:<{width}}{summary}" for name, summary in self.commands.items())
        return f"{self.title}\n\nUsage: {self.program} COMMAND ...\n\nCommands:\n{rows}\n\n{self.examples}"

    def _unknown_command(self, name: str) -> int:
        close = difflib.get_close_matches(name, self.commands, n=1)
        hint = f"did you mean `{self.program} {close[0]}`?" if close else f"commands are {', '.join(self.commands)}"
        _say(f"error: there is no command {name!r} — {hint}")
        return ExitCode.USAGE


def settle_threads_and_kernels() -> None:
    """Must come before NumPy and numba are imported: one thread for each image, and the cache of compiled kernels.

    Parallax works on several images and pairs at once, and each with a BLAS of one thread: faster than the reverse,
    and a BLAS may round differently on another number of threads.
    """
    for variable in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ[variable] = "1"
    from sfm.io.kernel_cache import use_kernel_cache

    use_kernel_cache()


def guarded(work: Callable[[], int], program: str, words: Sequence[str], *, goes_on: bool = False) -> int:
    """The exit code of `work`; what goes wrong becomes one line and a code.

    Args:
        words: the command line after the name of the program.
        goes_on: whether this command, repeated after an interruption, goes on where it was.
    """
    with standard_streams(), Interruptions() as interruptions:
        try:
            try:
                return work()
            finally:
                sys.stdout.flush()
        except BaseException as error:
            if interruptions.signal or isinstance(error, KeyboardInterrupt):
                return _interrupted(program, words, interruptions.signal, goes_on=goes_on)
            return _failed(error, program)


def _failed(error: BaseException, program: str) -> int:
    match error:
        case SfmError():
            _say(f"error: {error}")
            return error.exit_code
        case SystemExit():  # tyro has printed help, or what is wrong with the options
            return error.code if isinstance(error.code, int) else ExitCode.USAGE
        case BrokenPipeError():  # the reader of a stream that is not ours has seen enough
            return ExitCode.OK
        case OSError() if error.errno in [getattr(errno, name, None) for name in _OUTER]:
            return _refused(error)
        case _ if _is_out_of_memory(error):
            _say("error: memory is exhausted — fewer --threads or smaller photos take less")
            return ExitCode.BAD_INPUT
        case Exception():
            return _bug(error, program)
    raise error


def _refused(error: OSError) -> int:
    from sfm.io.atomic import refusal

    _say(f"error: {refusal(error, error.filename)}")
    return ExitCode.BAD_INPUT


def _is_out_of_memory(error: BaseException) -> bool:
    return isinstance(error, MemoryError) or (
        type(error).__module__ == "cv2" and getattr(error, "code", 0) == _NO_MEMORY_OF_CV2
    )


def _interrupted(program: str, words: Sequence[str], number: int, *, goes_on: bool) -> int:
    """Says what is left and how to go on, and ends at once: photos in work would take seconds for nothing."""
    import shlex

    from sfm.core.execution import has_abandoned

    line = shlex.join([program, *words])
    kept = "what was found is kept; to go on from there" if goes_on else "nothing half-done is left; to begin again"
    _say(f"\ninterrupted: {kept}, repeat: {line}")
    code = 128 + number if number else int(ExitCode.INTERRUPTED)
    if has_abandoned():
        os._exit(code)
    return code


def _bug(error: Exception, program: str) -> int:
    """One line for the user, and where the rest is."""
    where = [note for note in getattr(error, "__notes__", []) if note.startswith("log: ")]
    cause = " ".join(str(error).split())[:200]
    _say(f"error: this is a bug in Parallax: {type(error).__name__}: {cause}")
    _say(where[0] if where else f"log: {_crash_log(error, program)}")
    return ExitCode.BUG


def _crash_log(error: Exception, program: str) -> str:
    import tempfile
    import traceback

    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix=f"{program}-crash-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            traceback.print_exception(error, file=file)
            return file.name
    except OSError as refused:
        return f"could not be written: {refused}\n{''.join(traceback.format_exception(error))}"


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
