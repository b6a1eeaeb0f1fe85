from __future__ import annotations

import json
import os
import socket
import subprocess
import sys

import pytest

from sfm.core.errors import ExitCode, WorkspaceLockedError
from sfm.pipeline.lock import locked


def write_lock(folder, **changes):
    owner = {"pid": os.getpid(), "host": socket.gethostname(), "started": "another boot:1"} | changes
    (folder / ".lock").write_text(json.dumps(owner))


def test_the_lock_is_there_while_held_and_gone_after(tmp_path):
    with locked(tmp_path):
        assert json.loads((tmp_path / ".lock").read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


def test_a_second_run_is_refused(tmp_path):
    with locked(tmp_path), pytest.raises(WorkspaceLockedError, match="another run works") as caught, locked(tmp_path):
        pass
    assert caught.value.exit_code == ExitCode.WORKSPACE_LOCKED
    with locked(tmp_path):
        pass


def test_an_exception_gives_the_lock_back(tmp_path):
    with pytest.raises(RuntimeError), locked(tmp_path):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="Windows does not tell whether a process lives")
def test_the_lock_of_a_dead_process_is_taken_over(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    write_lock(tmp_path, pid=dead.pid)
    with locked(tmp_path):
        assert json.loads((tmp_path / ".lock").read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not os.path.exists("/proc/self/stat"), reason="needs the start time of processes")
def test_a_process_number_that_was_given_out_again_does_not_hold_the_lock(tmp_path):
    write_lock(tmp_path)  # our own number, but of a process that started at another time
    with locked(tmp_path):
        pass


def test_a_process_on_another_host_counts_as_alive(tmp_path):
    write_lock(tmp_path, host="elsewhere")
    with pytest.raises(WorkspaceLockedError, match="on elsewhere"), locked(tmp_path):
        pass
    assert (tmp_path / ".lock").exists()


def test_a_lock_that_names_nobody_is_taken_over(tmp_path):
    (tmp_path / ".lock").write_text("")
    with locked(tmp_path):
        pass
