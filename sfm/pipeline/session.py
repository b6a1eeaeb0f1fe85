"""A workspace at work: locked, logged, its database open and brought up to date with the photos.

All commands that compute something in a workspace, the whole run as well as single stages, happen within a session.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
import traceback
from collections.abc import Iterator, Mapping
from pathlib import Path

import cv2

from sfm.core.errors import ConfigError, InputError, SfmError
from sfm.core.events import Event, Observer, StageFinished, StageStarted
from sfm.core.execution import available_threads
from sfm.io.atomic import check_writable, os_errors, write_text
from sfm.io.database import Database
from sfm.pipeline.config import PipelineConfig, to_toml
from sfm.pipeline.lock import locked
from sfm.pipeline.observers import LogFiles, watched
from sfm.pipeline.pairs import check_pair_settings
from sfm.pipeline.scene import Scene, read_scene
from sfm.pipeline.stages import Run, check_networks
from sfm.pipeline.warm_up import compile_kernels

DATABASE = "database.db"
_FOLDER_NOTE = "images_folder"


@dataclasses.dataclass(frozen=True, slots=True)
class Session:
    """What a command works with; `times_s` grows while the stages pass."""

    workspace: Path
    images_folder: Path
    scene: Scene
    run: Run
    times_s: Mapping[str, float]


@contextlib.contextmanager
def session(
    images_folder: Path | str | None,
    workspace: Path | str,
    config: PipelineConfig,
    *,
    command: str,
    threads: int,
    observer: Observer,
) -> Iterator[Session]:
    """Holds the workspace while the block runs.

    Args:
        images_folder: None for the one that the workspace was made from.
        command: names the log.
        threads: at most so many at once; 0 for all cores.
    Raises:
        InputError: there are no usable photos, there is no workspace where one must be, or a setting does not fit.
        WorkspaceLockedError: another run works in the workspace.
    """
    workspace = Path(workspace).absolute()
    if images_folder is None:
        folder, remedy = remembered_folder(workspace), f"if they have moved: `sfm features IMAGES -o {workspace}`"
    else:
        folder, remedy = Path(images_folder).absolute(), "name the folder that holds the photos"
    _check(folder, workspace, remedy)
    threads = threads or available_threads()
    with (
        os_errors(workspace),
        locked(workspace),
        _logged(workspace / "logs", command, observer) as (tell, times),
        Database.open(workspace / DATABASE) as database,
        _one_cv2_thread(),
    ):
        scene = read_scene(database, folder, config.cameras, threads=threads, observer=tell, masks=config.masks)
        run = Run(database, config, threads, tell, scene.images)
        check_networks(config)
        check_pair_settings(run)
        database.set_meta(_FOLDER_NOTE, str(folder))
        # Only now: settings that do not fit the photos must not be kept for the next run.
        write_text(workspace / "sfm.toml", to_toml(config))
        compile_kernels(tell, threads=threads)
        yield Session(workspace, folder, scene, run, times)


def is_workspace(folder: Path) -> bool:
    """Whether a run or a stage has begun there."""
    return (folder / DATABASE).is_file()


def remembered_folder(workspace: Path) -> Path:
    """The folder of photos that a workspace was made from.

    Raises:
        InputError: it is no workspace, or does not say.
    """
    begin = f"begin with `sfm features IMAGES -o {workspace}`"
    if not workspace.is_dir():
        cause = "is a file, not a workspace" if workspace.exists() else "there is no such workspace"
        raise InputError(cause, path=workspace, remedy=begin)
    if not is_workspace(workspace):
        raise InputError(f"is no workspace, it holds no {DATABASE}", path=workspace, remedy=begin)
    with Database.open(workspace / DATABASE, readonly=True) as database:
        noted = database.meta().get(_FOLDER_NOTE) or _folder_in_manifest(workspace)
    if not noted:
        raise InputError("does not say which photos it was made from", path=workspace, remedy=begin)
    return Path(noted)


def _folder_in_manifest(workspace: Path) -> str:
    """Where workspaces of before the note in the database have it."""
    try:
        return json.loads((workspace / "manifest.json").read_text(encoding="utf-8"))["images_folder"]
    except (OSError, ValueError, KeyError):
        return ""


def _check(images_folder: Path, workspace: Path, remedy: str) -> None:
    """The photos are there, and the workspace, which is made if need be, is apart from them."""
    if not images_folder.is_dir():
        cause = "is a file, not a folder of photos" if images_folder.exists() else "there is no such folder"
        raise InputError(cause, path=images_folder, remedy=remedy)
    if workspace.resolve().is_relative_to(images_folder.resolve()):
        raise ConfigError(
            "the workspace lies in the folder of the photos, which is never written to",
            path=workspace,
            remedy=f"choose another, e.g. -o {images_folder.resolve()}-sfm",
        )
    with os_errors(workspace):
        check_writable(workspace / "sfm.toml")
        workspace.mkdir(parents=True, exist_ok=True)


class _Stopwatch:
    """Wall time of each stage, all its rounds, as its events tell."""

    def __init__(self) -> None:
        self.times_s: dict[str, float] = {}
        self._started = 0.0

    def __call__(self, event: Event, /) -> None:
        match event:
            case StageStarted():
                self._started = time.perf_counter()
            case StageFinished(stage=stage):
                self.times_s[stage] = self.times_s.get(stage, 0.0) + time.perf_counter() - self._started

    def close(self) -> None:
        """Nothing is open."""


@contextlib.contextmanager
def _logged(folder: Path, command: str, observer: Observer) -> Iterator[tuple[Observer, dict[str, float]]]:
    """An observer that also writes the logs, a failure included; and the times of the stages so far."""
    log, stopwatch = LogFiles(folder, command), _Stopwatch()
    with watched(log, stopwatch) as note:

        def tell(event: Event, /) -> None:
            note(event)
            observer(event)

        try:
            yield tell, stopwatch.times_s
        except BaseException as error:
            expected = isinstance(error, SfmError | KeyboardInterrupt)
            log.write(f"{type(error).__name__}: {error}" if expected else traceback.format_exc())
            if not expected:
                error.add_note(f"log: {log.text_path}")
            raise


@contextlib.contextmanager
def _one_cv2_thread() -> Iterator[None]:
    """Several images at once on a thread each use the cores better than several threads on one image."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
