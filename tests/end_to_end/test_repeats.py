"""The same photos and settings give the same bytes, on any number of threads and however often the run was killed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sfm.pipeline.config import PipelineConfig
from sfm.pipeline.run import reconstruct

pytestmark = pytest.mark.slow

KILLED_WHILE_WRITING = """
import os, signal, sys
from sfm.cli import main
import sfm.pipeline.run

renames, count, replace = 0, int(sys.argv[1]), os.replace

def counted(source, target):
    global renames
    if "sparse" in str(target):
        renames += 1
        if renames > count:
            os.kill(os.getpid(), signal.SIGKILL)
    replace(source, target)

os.replace = counted
main(sys.argv[2:])
"""


def model_bytes(workspace: Path) -> dict[str, bytes]:
    files = [path for path in sorted((workspace / "sparse").rglob("*")) if path.is_file()]
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= {path.name for path in files}
    return {path.relative_to(workspace).as_posix(): path.read_bytes() for path in files}


def present_stage(workspace: Path) -> str:
    """The stage that the last run in the workspace has begun, and "" before it has begun one or when all are done."""
    logs = sorted((workspace / "logs").glob("*.jsonl"))
    rows = [json.loads(line) for line in logs[-1].read_text().splitlines() if line.endswith("}")] if logs else []
    starts = [row for row in rows if row["event"] in ("StageStarted", "StageFinished")]
    return starts[-1]["stage"] if starts and starts[-1]["event"] == "StageStarted" else ""


def test_one_thread_and_two_give_the_same_bytes(few, finished, tmp_path):
    reconstruct(few / "photos", tmp_path / "ws", threads=1)
    assert model_bytes(tmp_path / "ws") == model_bytes(finished)


@pytest.mark.skipif(os.name == "nt", reason="SIGKILL is POSIX")
def test_a_run_killed_in_every_stage_ends_with_the_bytes_of_one_that_was_not(few, finished, environment, sfm, tmp_path):
    rng = np.random.default_rng(5)
    words = ["run", str(few / "photos"), "-o", "ws", "--threads", "1"]
    for stage in ("features", "matching", "verification", "mapping"):
        logs = len(list(tmp_path.glob("ws/logs/*.jsonl")))
        with subprocess.Popen(
            [sys.executable, "-m", "sfm", *words], env=environment, cwd=tmp_path, stderr=subprocess.DEVNULL
        ) as process:
            until = time.monotonic() + 120
            while len(list(tmp_path.glob("ws/logs/*.jsonl"))) == logs or present_stage(tmp_path / "ws") != stage:
                assert process.poll() is None, f"ended before {stage} was met"
                assert time.monotonic() < until
                time.sleep(0.002)
            time.sleep(rng.uniform(0, 0.08))
            process.kill()
        assert process.returncode == -signal.SIGKILL
    result = sfm(*words)
    assert result.returncode == 0, result.stderr
    assert model_bytes(tmp_path / "ws") == model_bytes(finished)
    assert not list((tmp_path / "ws").rglob("*.tmp"))


@pytest.mark.skipif(os.name == "nt", reason="SIGKILL is POSIX")
def test_a_run_killed_while_it_writes_leaves_no_model_of_two_minds(few, finished, environment, sfm, tmp_path):
    """Models of another seed are there, and the run ends in the middle of the exchange."""
    workspace, words = tmp_path / "ws", ["run", str(few / "photos"), "-o", "ws", "--seed", "0"]
    shutil.copytree(finished, workspace)
    reconstruct(few / "photos", workspace, PipelineConfig(seed=1), threads=2)
    old, new = model_bytes(workspace), model_bytes(finished)
    assert old != new
    for renames in (1, 2):  # before the old models go, and before the new ones come
        killed = subprocess.run(
            [sys.executable, "-c", KILLED_WHILE_WRITING, str(renames), *words],
            env=environment, cwd=tmp_path, capture_output=True, check=False,
        )  # fmt: skip
        assert killed.returncode == -signal.SIGKILL, killed.stderr
        left = {
            path.relative_to(workspace).as_posix(): path.read_bytes()
            for path in (workspace / "sparse").glob("[0-9]*/*")
        }
        assert left in (old, new, {})
    result = sfm(*words)
    assert result.returncode == 0, result.stderr
    assert model_bytes(workspace) == new
    assert not list(workspace.rglob("*.tmp"))
