"""A reconstruction from a folder of photos: the pipeline on one page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sfm.core.errors import SfmError
from sfm.core.events import SILENT, Observer
from sfm.core.scene import Reconstruction
from sfm.pipeline.config import DEFAULTS, PipelineConfig
from sfm.pipeline.keys import key_of
from sfm.pipeline.manifest import write_manifest
from sfm.pipeline.memory import peak_memory_bytes
from sfm.pipeline.models import map_all
from sfm.pipeline.pairs import match_and_verify
from sfm.pipeline.report import RunReport, figures_of, no_model_error
from sfm.pipeline.session import Session, session
from sfm.pipeline.stages import Run, extract_all


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
    with session(images_folder, workspace, config, command="run", threads=threads, observer=observer) as at_work:
        run = at_work.run
        feature_keys = extract_all(run)
        match_keys, pair_keys = match_and_verify(run, feature_keys)
        models, model_key = map_all(run, pair_keys, at_work.workspace / "sparse")

        manifest = at_work.workspace / "manifest.json"
        if not models:
            manifest.unlink(missing_ok=True)  # of a run before, whose models are gone
            raise _no_model(run)
        report = _report(at_work, models)
        keys = {
            "images": key_of([[image.name, image.digest, image.camera] for image in run.images.values()]),
            "features": key_of(sorted(feature_keys.values())),
            "matching": key_of(sorted(match_keys.values())),
            "verification": key_of(sorted(pair_keys.values())),
            "mapping": model_key,
        }
        write_manifest(manifest, at_work.images_folder, config, keys, report)
        return report


def _report(at_work: Session, models: Sequence[Reconstruction]) -> RunReport:
    registered = set(models[0].image_names)
    scene = at_work.scene
    return RunReport(
        workspace=at_work.workspace,
        images=len(scene.images),
        skipped=scene.skipped,
        missing=[image.name for image in scene.images.values() if image.name not in registered],
        models=[figures_of(model, f"sparse/{k}") for k, model in enumerate(models)],
        stage_times_s=dict(at_work.times_s),
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
