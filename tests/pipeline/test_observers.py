from __future__ import annotations

import json

import pytest

from sfm.core.events import FeaturesExtracted, ImageRegistered, Note, StageFinished, StageStarted
from sfm.pipeline import observers
from sfm.pipeline.observers import BarProgress, LineProgress, LogFiles, watched

STORY = [
    Note(message="hello"),
    StageStarted(stage="features", total=40, cached=2),
    *[FeaturesExtracted(name=f"{k}.jpg", count=k) for k in range(40)],
    StageFinished(stage="features", summary="done"),
    StageStarted(stage="mapping", total=3),
    ImageRegistered(name="a", registered=2, points=10),
    ImageRegistered(name="b", registered=2, points=10, reason="too_few_inliers"),
    Note(message="careful", level="warning"),
    StageFinished(stage="mapping", summary="2 of 3"),
]


def test_lines_come_at_starts_and_ends_and_after_a_tenth_but_not_more_often_than_allowed(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(observers.time, "monotonic", lambda: now[0])
    progress = LineProgress()
    for event in STORY:
        now[0] += 0.3
        progress(event)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["hello", "features: 40 to do, 2 known already"]
    assert lines[-3:] == ["mapping: 3 to do", "warning: careful", "mapping: 2 of 3"]
    counts = [int(line.split()[1]) for line in lines if line.endswith("of 40")]
    assert counts == sorted(counts)
    assert 8 <= len(counts) <= 10


def test_a_slow_stage_is_heard_of_every_five_seconds(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(observers.time, "monotonic", lambda: now[0])
    progress = LineProgress()
    progress(StageStarted(stage="features", total=100000))
    for k in range(20):
        now[0] += 1
        progress(FeaturesExtracted(name=str(k), count=1))
    assert capsys.readouterr().err.splitlines()[1:] == [f"features: {n} of 100000" for n in (5, 10, 15, 20)]


def test_bars_survive_a_story(capsys):
    progress = BarProgress()
    for event in STORY:
        progress(event)
    progress.close()
    assert "features" in capsys.readouterr().err


def test_logs_hold_every_event_with_its_place(tmp_path):
    log = LogFiles(tmp_path, "run")
    with watched(log) as tell:
        for event in STORY:
            tell(event)
    rows = [json.loads(line) for line in next(tmp_path.glob("*.jsonl")).read_text().splitlines()]
    assert [row["event"] for row in rows] == [type(event).__name__ for event in STORY]
    assert (rows[20]["stage"], rows[20]["done"], rows[20]["total"]) == ("features", 19, 40)
    assert {row["level"] for row in rows} == {"info", "debug", "warning"}
    assert len(next(tmp_path.glob("*.log")).read_text().splitlines()) == len(STORY)


def test_watchers_are_closed_even_when_the_run_fails():
    closed = []

    class Watcher:
        def __call__(self, event, /) -> None: ...

        def close(self) -> None:
            closed.append(1)

    with pytest.raises(RuntimeError), watched(Watcher(), Watcher()):
        raise RuntimeError
    assert closed == [1, 1]
