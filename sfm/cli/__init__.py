"""The `sfm` command. This module imports nothing heavy: `sfm --help` answers at once."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from collections.abc import Sequence

from sfm import __version__
from sfm.core.errors import ExitCode, SfmError

COMMANDS = {
    "run": "photos → camera poses and a sparse model",
    "features": "the first stage alone: keypoints of all photos",
    "pairs": "the next: which pairs of photos are to be matched",
    "match": "the next: matches of these pairs",
    "verify": "the next: which matches a rigid scene explains, and how",
    "inspect": "photos: sharpness, exposure, EXIF, copies, what cannot be read",
    "refine": "bundle adjustment of any COLMAP model",
    "view": "look at a workspace in the Rerun viewer",
    "compare": "pose errors of a model against a reference",
    "convert": "a model from one format to another: COLMAP binary, text, PLY",
    "doctor": "what is installed, what is missing and how to get it",
}
"""In the order in which they are used; `sfm.cli.<name>` holds each."""

_EXAMPLES = """\
Examples:
  sfm run photos -o scene          # reconstruct a folder of photos
  sfm view scene                   # look at the result
  sfm run --help                   # the options of a command, with examples"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    match words[:1]:
        case [] | ["-h" | "--help" | "help"]:
            print(help_text())
            return ExitCode.OK if words else ExitCode.USAGE
        case ["--version" | "-V"]:
            print(f"sfm {__version__} (Parallax)")
            return ExitCode.OK
        case [name] if name not in COMMANDS:
            return _unknown_command(name)
    return _guarded(words[0], words[1:])


def help_text() -> str:
    """The table of commands."""
    width = max(map(len, COMMANDS)) + 2
    rows = "\n".join(f"  {name:<{width}}{summary}" for name, summary in COMMANDS.items())
    return (
        "Parallax: structure from motion, photos in, camera poses and geometry out.\n\n"
        f"Usage: sfm COMMAND ...\n\nCommands:\n{rows}\n\n{_EXAMPLES}"
    )


def _unknown_command(name: str) -> int:
    close = difflib.get_close_matches(name, COMMANDS, n=1)
    hint = f"did you mean `sfm {close[0]}`?" if close else f"commands are {', '.join(COMMANDS)}"
    print(f"error: there is no command {name!r} — {hint}", file=sys.stderr)
    return ExitCode.USAGE


def _guarded(name: str, words: list[str]) -> int:
    """Runs a command; what goes wrong becomes one line and an exit code."""
    _settle_threads_and_kernels()
    try:
        return importlib.import_module(f"sfm.cli.{name}").main(words)
    except SfmError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print(f"\ninterrupted; to go on, repeat: {_shell_line(name, words)}", file=sys.stderr)
        return ExitCode.INTERRUPTED
    except BrokenPipeError:  # the reader, e.g. `head`, has seen enough
        sys.stdout = None
        return ExitCode.OK
    except SystemExit as error:  # tyro has printed help, or what is wrong with the options
        return error.code if isinstance(error.code, int) else ExitCode.USAGE
    except Exception as error:
        return _bug(error)


def _settle_threads_and_kernels() -> None:
    """Must come before NumPy and numba are imported.

    Parallax works on several images and pairs at once, and each with a BLAS of one thread: faster than the reverse,
    and a BLAS may round differently on another number of threads.
    """
    for variable in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ[variable] = "1"
    from sfm.io.kernel_cache import use_kernel_cache

    use_kernel_cache()


def _shell_line(name: str, words: Sequence[str]) -> str:
    import shlex

    return shlex.join(["sfm", name, *words])


def _bug(error: Exception) -> int:
    """One line for the user, and where the rest is."""
    where = [note for note in getattr(error, "__notes__", []) if note.startswith("log: ")]
    cause = " ".join(str(error).split())[:200]
    print(f"error: this is a bug in Parallax: {type(error).__name__}: {cause}", file=sys.stderr)
    print(where[0] if where else f"log: {_crash_log(error)}", file=sys.stderr)
    return ExitCode.BUG


def _crash_log(error: Exception) -> str:
    import tempfile
    import traceback

    with tempfile.NamedTemporaryFile("w", prefix="sfm-crash-", suffix=".log", delete=False, encoding="utf-8") as file:
        traceback.print_exception(error, file=file)
        return file.name
