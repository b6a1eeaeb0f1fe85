"""A reconstruction from a folder of photos: the pipeline on one page."""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2

from sfm.core.errors import ConfigError, InputError, SfmError
from sfm.core.events import SILENT, Event, Observer, StageFinished, StageStarted
from sfm.core.execution import available_threads
from sfm.core.scene import Reconstruction
from sfm.io.atomic import os_errors, write_text
from sfm.io.database import Database
from sfm.pipeline.config import DEFAULTS, PipelineConfig, to_toml
from sfm.pipeline.keys import key_of
from sfm.pipeline.lock import locked
from sfm.pipeline.manifest import write_manifest
from sfm.pipeline.memory import peak_memory_bytes
from sfm.pipeline.models import map_all
from sfm.pipeline.observers import LogFiles, watched
from sfm.pipeline.pairs import check_pair_settings, match_and_verify
from sfm.pipeline.report import RunReport, figures_of, no_model_error
from sfm.pipeline.scene import Scene, read_scene
from sfm.pipeline.stages import Run, extract_all
from sfm.pipeline.warm_up import compile_kernels


def reconstruct(
    images_folder: Path | str,
    workspace: Path | str,
    config: PipelineConfig = DEFAULTS,
    *,
    threads: int = 0,
    observer: Observer = SILENT,
) -> RunReport:
    """Poses and points from photos; what an earlier run in the workspace has done is not done again.

    Writes `database.db`, models `sparse/0 …` (largest first), `sfm.toml`, `manifest.json` and logs into `workspace`.
    The photos are only read. The models depend on photos and `config` alone, not on `threads` or on interruptions.

    Args:
        threads: at most so many at once; 0 for all cores.
    Raises:
        InputError: there are no usable photos, or a setting does not fit them.
        ReconstructionError: the photos do not allow a model.
        WorkspaceLockedError: another run works in the workspace.
    """
    images_folder, workspace = _checked(Path(images_folder), Path(workspace))
    threads = threads or available_threads()
    with (
        os_errors(workspace),
        locked(workspace),
        _logged(workspace / "logs", observer) as (tell, times),
        Database.open(workspace / "database.db") as database,
        _one_cv2_thread(),
    ):
        scene = read_scene(database, images_folder, config.cameras, threads=threads, observer=tell)
        run = Run(database, config, threads, tell, scene.images)
        check_pair_settings(run)
        # Only now: settings that do not fit the photos must not be kept for the next run.
        write_text(workspace / "sfm.toml", to_toml(config))
        compile_kernels(tell, threads=threads)
        feature_keys = extract_all(run)
        match_keys, pair_keys = match_and_verify(run, feature_keys)
        models, model_key = map_all(run, pair_keys, workspace / "sparse")

        if not models:
            (workspace / "manifest.json").unlink(missing_ok=True)  # of a run before, whose models are gone
            raise _no_model(run)
        report = _report(workspace, scene, models, times)
        keys = {
            "images": key_of([[image.name, image.digest, image.camera] for image in scene.images.values()]),
            "features": key_of(sorted(feature_keys.values())),
            "matching": key_of(sorted(match_keys.values())),
            "verification": key_of(sorted(pair_keys.values())),
            "mapping": model_key,
        }
        write_manifest(workspace / "manifest.json", images_folder, config, keys, report)
        return report


def _checked(images_folder: Path, workspace: Path) -> tuple[Path, Path]:
    """Absolute paths; the workspace exists."""
    images_folder, workspace = images_folder.absolute(), workspace.absolute()
    if not images_folder.is_dir():
        cause = "is a file, not a folder of photos" if images_folder.exists() else "there is no such folder"
        raise InputError(cause, path=images_folder, remedy="name the folder that holds the photos")
    if workspace.resolve().is_relative_to(images_folder.resolve()):
        raise ConfigError(
            "the workspace lies in the folder of the photos, which is never written to",
            path=workspace,
            remedy=f"choose another, e.g. -o {images_folder.resolve()}-sfm",
        )
    with os_errors(workspace):
        workspace.mkdir(parents=True, exist_ok=True)
    return images_folder, workspace


def _report(workspace: Path, scene: Scene, models: Sequence[Reconstruction], times_s: Mapping[str, float]) -> RunReport:
    registered = set(models[0].image_names)
    return RunReport(
        workspace=workspace,
        images=len(scene.images),
        skipped=scene.skipped,
        missing=[image.name for image in scene.images.values() if image.name not in registered],
        models=[figures_of(model, f"sparse/{k}") for k, model in enumerate(models)],
        stage_times_s=dict(times_s),
        peak_memory_bytes=peak_memory_bytes(),
    )


def _no_model(run: Run) -> SfmError:
    graph, rejected = run.database.read_view_graph(), run.database.rejected_pairs()
    inliers = {pair: len(geometry) for pair, geometry in graph.pairs.items()}
    return no_model_error(
        {image_id: image.name for image_id, image in run.images.items()},
        run.database.match_counts(),
        inliers,
        {pair: reason.reason for pair, reason in rejected.items()},
    )


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
def _logged(folder: Path, observer: Observer) -> Iterator[tuple[Observer, dict[str, float]]]:
    """An observer that also writes the logs, a failure included; and the times of the stages so far."""
    log, stopwatch = LogFiles(folder, "run"), _Stopwatch()
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
