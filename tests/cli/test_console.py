"""The guards that all commands share: streams that fail, interruptions, outputs that cannot be written."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from sfm.core.errors import ExitCode, InputError
from sfm.io.console import guarded
from sfm.io.standard_streams import Interruptions, standard_streams
from tests.pictures import texture

CONSOLES = {name: importlib.import_module(f"{name}.cli").CONSOLE for name in ("sfm", "calib")}
COMMANDS = [(name, command) for name, console in CONSOLES.items() for command in console.commands]
every_command = pytest.mark.parametrize(("program", "command"), COMMANDS)

TARGETS = {
    ("sfm", "run"): ["photos", "-o", "{}"],
    ("sfm", "features"): ["photos", "-o", "{}"],
    ("sfm", "refine"): ["model", "-o", "{}"],
    ("sfm", "view"): ["absent", "--save", "{}.rrd"],
    ("sfm", "convert"): ["model", "{}.ply"],
    ("calib", "board"): ["chessboard:9x6:25mm", "-o", "{}.pdf"],
    ("calib", "detect"): ["absent", "--board", "chessboard:9x6:25mm", "-o", "{}.json"],
    ("calib", "camera"): ["absent", "--board", "chessboard:9x6:25mm", "-o", "{}.toml"],
    ("calib", "check"): ["absent.toml", "absent", "--suggest", "{}.svg"],
    ("calib", "report"): ["absent.toml", "absent", "-o", "{}.html"],
    ("calib", "view"): ["absent.toml", "absent", "--save", "{}.rrd"],
    ("calib", "stereo"): ["absent", "absent2", "--board", "chessboard:9x6:25mm", "-o", "{}.toml"],
    ("calib", "rig"): ["absent", "absent2", "--board", "chessboard:9x6:25mm", "-o", "{}.toml"],
    ("calib", "handeye"): [
        "absent", "--poses", "absent.csv", "--camera", "absent.toml", "--board", "chessboard:9x6:25mm", "-o", "{}.toml",
    ],
    ("calib", "undistort"): ["absent.toml", "absent", "-o", "{}"],
    ("calib", "convert"): ["absent.toml", "-o", "{}.json", "--to", "nerfstudio"],
}  # fmt: skip
"""Commands that write where they are told: words that name a target and, where that is possible, no source."""
KEEP_TO_THEIR_WORKSPACE = {("sfm", "pairs"), ("sfm", "match"), ("sfm", "verify")}
ONLY_READ = {("sfm", "inspect"), ("sfm", "compare"), ("sfm", "doctor")}


@contextlib.contextmanager
def standard_output(number: int, monkeypatch: pytest.MonkeyPatch, encoding: str = "utf-8") -> Iterator[None]:
    """Within, the process's own standard output leads to the open file `number`."""
    kept = os.dup(1)
    os.dup2(number, 1)
    try:
        with open(1, "w", encoding=encoding, closefd=False) as stream, monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", stream)
            patch.setattr(sys, "__stdout__", stream)
            yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


@every_command
def test_a_reader_that_has_seen_enough_is_no_error(program, command, monkeypatch, capsys):
    for words in ([command, "--help"], ["--help"], ["--version"]):
        reads, writes = os.pipe()
        os.close(reads)
        with standard_output(writes, monkeypatch):
            assert CONSOLES[program].main(words) == ExitCode.OK
        os.close(writes)
    assert capsys.readouterr().err == ""


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device that is always full")
@every_command
def test_output_that_does_not_fit_is_told_in_one_line(program, command, monkeypatch, capsys):
    with open("/dev/full", "wb") as full, standard_output(full.fileno(), monkeypatch):
        assert CONSOLES[program].main([command, "--help"]) == ExitCode.BAD_INPUT
    assert capsys.readouterr().err == "error: standard output: no space left on device\n"


@every_command
def test_an_interruption_says_what_is_kept_and_how_to_go_on(program, command, monkeypatch, capsys):
    def interrupted(words: list[str]) -> int:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(10)
        raise AssertionError

    monkeypatch.setattr(f"{program}.cli.{command}.main", interrupted)
    assert CONSOLES[program].main([command, "a b", "-o", "c"]) == ExitCode.INTERRUPTED
    (line,) = capsys.readouterr().err.split("\n")[1:-1]
    assert re.match(r"interrupted: (what was found is kept|nothing half-done is left); to ", line)
    assert line.endswith(f", repeat: {program} {command} 'a b' -o c")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.skipif(not os.path.exists("/proc/self"), reason="a folder that nobody can write to")
@pytest.mark.parametrize(("program", "command"), list(TARGETS))
@pytest.mark.parametrize("place", ["/proc/x", "file/x"])
def test_a_target_that_cannot_be_written_is_known_before_the_work(
    program, command, place, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sfm.io.images.read_image", None)
    Path("file").write_text("")
    Path("photos").mkdir()
    Image.fromarray(texture(1, (40, 40))).save("photos/1.png")
    Path("model").mkdir()
    Path("model/cameras.txt").write_text("not even looked at")
    Path("model/images.txt").write_text("")
    Path("model/points3D.txt").write_text("")
    assert CONSOLES[program].main([command, *(word.format(place) for word in TARGETS[program, command])]) == 3
    told = capsys.readouterr().err
    assert re.fullmatch(rf"error: (/\S*/)?{place.split('/x')[0]}\S*: .*\n", told), told
    assert sorted(os.listdir()) == ["file", "model", "photos"]


@pytest.fixture(autouse=True)
def interruptible():
    """Shells that start a run in the background have it ignore interruptions, and all that it starts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_of_every_command_it_is_known_what_it_writes():
    assert set(COMMANDS) == set(TARGETS) | KEEP_TO_THEIR_WORKSPACE | ONLY_READ


def test_printing_goes_on_and_the_code_stays_when_nobody_reads_any_more(monkeypatch):
    def work() -> int:
        for k in range(50_000):
            sys.stdout.write(f"line {k}\n")
        return ExitCode.QUALITY_GATE_FAILED

    reads, writes = os.pipe()
    os.close(reads)
    with standard_output(writes, monkeypatch):
        assert guarded(work, "sfm", []) == ExitCode.QUALITY_GATE_FAILED
    os.close(writes)


def test_names_that_are_no_text_and_signs_that_an_encoding_lacks_are_printed(monkeypatch):
    reads, writes = os.pipe()
    for encoding, text in (("utf-8", "b\udcfcro"), ("ascii", "a → b")):
        with standard_output(writes, monkeypatch, encoding):

            def work(text: str = text) -> int:
                sys.stdout.write(text)
                return 0

            assert guarded(work, "sfm", []) == 0
    os.close(writes)
    with open(reads, "rb") as file:
        assert file.read() == b"b\xfcroa \\u2192 b"


def test_streams_that_were_replaced_stay(monkeypatch):
    mine = io.StringIO()
    monkeypatch.setattr(sys, "stdout", mine)
    with standard_streams():
        assert sys.stdout is mine


@pytest.mark.parametrize(
    ("error", "code", "told"),
    [
        (OSError(28, "No space left on device"), 3, "error: no space left on device — make room there"),
        (PermissionError(13, "Permission denied", "x.txt"), 3, "error: x.txt: permission denied — check the perm"),
        (MemoryError(), 3, "error: memory is exhausted — fewer --threads"),
        (InputError("is odd", path="a", remedy="mend it"), 3, "error: a: is odd — mend it\n"),
        (FileNotFoundError(2, "No such file", "x.txt"), 1, "error: this is a bug in Parallax: FileNotFoundError: "),
        (SystemExit(2), 2, ""),
    ],
)
def test_what_goes_wrong_is_one_line_and_a_code(error, code, told, capsys, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def work() -> int:
        raise error

    assert guarded(work, "sfm", []) == code
    assert capsys.readouterr().err.startswith(told)


def test_an_interruption_that_a_library_swallows_is_one_still(capsys):
    def work() -> int:
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        except KeyboardInterrupt as error:
            raise ImportError("initialisation failed") from error
        return 0

    assert guarded(work, "sfm", ["compare"]) == 130
    assert "nothing half-done is left" in capsys.readouterr().err


def test_signals_that_are_ignored_stay_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Interruptions():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.skipif(os.name == "nt", reason="signals are POSIX")
def test_a_second_interruption_ends_at_once(environment):
    script = (
        "import os, signal, sys, time\n"
        "from sfm.io.console import guarded\n"
        "def stubborn():\n"
        "    try:\n"
        "        os.kill(os.getpid(), signal.SIGTERM); time.sleep(60)\n"
        "    finally:\n"
        "        os.kill(os.getpid(), signal.SIGTERM)\n"  # at once: the same again
        "        time.sleep(0.6); os.kill(os.getpid(), signal.SIGTERM); time.sleep(60)\n"
        "sys.exit(guarded(stubborn, 'sfm', []))"
    )
    result: Any = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=50,
        preexec_fn=lambda: signal.signal(signal.SIGTERM, signal.SIG_DFL),
    )  # fmt: skip
    assert (result.returncode, result.stderr) == (143, "\nended at once\n")


def test_a_closed_stream_is_never_taken_by_a_file(environment, tmp_path):
    script = (
        "import os, sys\n"
        "from sfm.io.console import guarded\n"
        "def work():\n"
        "    number = os.open('file', os.O_CREAT | os.O_WRONLY); print('out'); print('err', file=sys.stderr)\n"
        "    return number\n"
        "os.close(0); os.close(1); os.close(2); sys.stdout = sys.__stdout__ = sys.stderr = sys.__stderr__ = None\n"
        "sys.exit(guarded(work, 'sfm', []))"
    )
    assert subprocess.run([sys.executable, "-c", script], env=environment, cwd=tmp_path, timeout=50).returncode == 3
    assert (tmp_path / "file").read_bytes() == b""
