"""The `calib` command. This module imports nothing heavy: `calib --help` answers at once."""

from __future__ import annotations

import difflib
import importlib
import os
import sys
from collections.abc import Sequence

from calib import __version__
from sfm.core.errors import ExitCode, SfmError

COMMANDS = {
    "board": "a board to print: PDF or SVG at true scale",
    "detect": "the corners of a board in photos, and what they look like",
    "camera": "photos of a board → a camera, and how far to trust it",
    "check": "whether other photos agree with a camera, and which would help most",
    "report": "a calibration, of a camera or a rig, as one HTML page",
    "view": "the boards before the cameras, in the Rerun viewer",
    "stereo": "two cameras that are mounted together, and how they stand",
    "rig": "several such cameras, of any models",
    "handeye": "where a camera sits on a robot, from photos and the robot's poses",
    "undistort": "photos as a lens without distortion would have taken them",
    "convert": "a calibration in another program's file: OpenCV, ROS, Kalibr, COLMAP, nerfstudio",
}
"""In the order in which they are used; `calib.cli.<name>` holds each."""

_EXAMPLES = """\
Examples:
  calib board chessboard --cols 9 --rows 6 --square 25mm -o board.pdf
  calib camera photos --board board.toml -o camera.toml
  calib check camera.toml more_photos
  calib stereo left right --board board.toml -o rig.toml
  calib board --help               # the options of a command, with examples"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    match words[:1]:
        case [] | ["-h" | "--help" | "help"]:
            print(help_text())
            return ExitCode.OK if words else ExitCode.USAGE
        case ["--version" | "-V"]:
            print(f"calib {__version__} (Parallax)")
            return ExitCode.OK
        case [name] if name not in COMMANDS:
            return _unknown_command(name)
    return _guarded(words[0], words[1:])


def help_text() -> str:
    """The table of commands."""
    width = max(map(len, COMMANDS)) + 2
    rows = "\n".join(f"  {name:<{width}}{summary}" for name, summary in COMMANDS.items())
    return (
        "Parallax calibration: printed board and photos in, calibrated camera out.\n\n"
        f"Usage: calib COMMAND ...\n\nCommands:\n{rows}\n\n{_EXAMPLES}"
    )


def _unknown_command(name: str) -> int:
    close = difflib.get_close_matches(name, COMMANDS, n=1)
    hint = f"did you mean `calib {close[0]}`?" if close else f"commands are {', '.join(COMMANDS)}"
    print(f"error: there is no command {name!r} — {hint}", file=sys.stderr)
    return ExitCode.USAGE


def _guarded(name: str, words: list[str]) -> int:
    """Runs a command; what goes wrong becomes one line and an exit code."""
    _settle_threads_and_kernels()
    try:
        code = importlib.import_module(f"calib.cli.{name}").main(words)
        sys.stdout.flush()
        return code
    except SfmError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("\ninterrupted; what was found is kept, so that a repetition goes on from there", file=sys.stderr)
        return _interrupted()
    except BrokenPipeError:  # the reader, e.g. `head`, has seen enough
        sys.stdout = None
        return ExitCode.OK
    except SystemExit as error:  # tyro has printed help, or what is wrong with the options
        return error.code if isinstance(error.code, int) else ExitCode.USAGE
    except OSError as error:
        return _bug(error) if error.filename is not None else _no_output(error)
    except Exception as error:
        return _bug(error)


def _no_output(error: OSError) -> int:
    """Files say what is wrong by themselves (see `sfm.io.atomic`): this was the screen, or where it is sent to."""
    sys.stdout = None  # Python would try again at the end
    print(f"error: standard output: {(error.strerror or str(error)).lower()}", file=sys.stderr)
    return ExitCode.BAD_INPUT


def _interrupted() -> int:
    """Ends at once: photos that are being looked at would take seconds, and nobody wants them any more."""
    from sfm.core.execution import has_abandoned

    if has_abandoned():
        sys.stderr.flush()
        os._exit(ExitCode.INTERRUPTED)
    return ExitCode.INTERRUPTED


def _settle_threads_and_kernels() -> None:
    """Must come before NumPy and numba are imported: one thread for each image, and the cache of compiled kernels."""
    for variable in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
        os.environ[variable] = "1"
    from sfm.io.kernel_cache import use_kernel_cache

    use_kernel_cache()


def _bug(error: Exception) -> int:
    """One line for the user, and where the rest is."""
    cause = " ".join(str(error).split())[:200]
    print(f"error: this is a bug in Parallax: {type(error).__name__}: {cause}", file=sys.stderr)
    print(f"log: {_crash_log(error)}", file=sys.stderr)
    return ExitCode.BUG


def _crash_log(error: Exception) -> str:
    import tempfile
    import traceback

    with tempfile.NamedTemporaryFile("w", prefix="calib-crash-", suffix=".log", delete=False, encoding="utf-8") as file:
        traceback.print_exception(error, file=file)
        return file.name
