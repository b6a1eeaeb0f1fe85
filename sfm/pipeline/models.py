"""The last stage: models from the view graph, in colour, on disk."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path

from sfm.core.events import Event, ImageRegistered, StageFinished, StageStarted
from sfm.core.scene import Reconstruction, ViewGraph
from sfm.io.atomic import replace_folders
from sfm.io.bookkeeping import Decision
from sfm.io.colmap_model import model_format, read_model, write_model
from sfm.io.images import read_image
from sfm.mapping import map_incrementally
from sfm.pipeline.colors import colorize
from sfm.pipeline.keys import code_digest, file_digest, key_of
from sfm.pipeline.stages import Pair, Run
from sfm.viewgraph import calibrate_focal_lengths, cycle_consistency, poses_under, without_contradictions

STAGE = "mapping"


def map_all(run: Run, pair_keys: Mapping[Pair, str], folder: Path) -> tuple[list[Reconstruction], str]:
    """Models of all images that hang together, the largest first, written to `folder`/0 and so on; and their key."""
    key = _key(run, pair_keys)
    stored = run.database.stage_keys(STAGE)
    if stored.get("models") == key and stored.get("files") == _files_key(folder):
        models = _read_all(folder)
        run.observer(StageStarted(stage=STAGE, cached=len(models)))
    else:
        run.database.clear_stage(STAGE)
        run.observer(StageStarted(stage=STAGE, total=len(run.images)))
        paths = {image.name: image.path for image in run.images.values()}
        models = [colorize(model, lambda name: read_image(paths[name])) for model in _map(run)]
        _write_all(models, folder)
        if models:
            run.database.set_stage_keys(STAGE, {"models": key, "files": _files_key(folder)})
    sizes = ", ".join(str(len(model.image_ids)) for model in models) or "no"
    run.observer(StageFinished(stage=STAGE, summary=f"{sizes} of {len(run.images)} images"))
    return models, key


def _map(run: Run) -> list[Reconstruction]:
    database, config = run.database, run.config
    counts = database.feature_counts()
    used = {image_id: image for image_id, image in run.images.items() if counts.get(image_id)}
    decisions: list[Decision] = []

    def note(event: Event, /) -> None:
        if isinstance(event, ImageRegistered):
            verdict, numbers = event.reason or "registered", (float(event.inliers), float(event.needed))
            detail = f"{event.visible} points visible, {event.registered} images before"
            decisions.append(Decision(STAGE, event.name, "inliers", *numbers, verdict, detail))
        run.observer(event)

    graph = database.read_view_graph()
    keypoints = {image_id: database.read_keypoints(image_id) for image_id in used}
    image_cameras = {image_id: image.camera_id for image_id, image in used.items()}
    guessed = {image.camera_id: image.camera for image in used.values()}
    cameras = calibrate_focal_lengths(graph, guessed, image_cameras, doubt_known=not config.cameras.intrinsics)
    decisions += [
        Decision(STAGE, image.name, "focal_px", cameras[k].mean_focal_length, guessed[k].mean_focal_length, "estimated")
        for image in used.values()
        if cameras[k := image.camera_id] is not guessed[k]
    ]
    graph, contradicting = _consistent(run, poses_under(graph, keypoints, cameras, image_cameras))
    decisions += contradicting
    models = map_incrementally(
        graph,
        keypoints,
        cameras,
        image_cameras,
        {image_id: image.name for image_id, image in used.items()},
        config.mapping,
        keypoint_scales={image_id: database.read_keypoint_scales(image_id) for image_id in used},
        seed=config.seed,
        threads=run.threads,
        refine_intrinsics=refines_intrinsics(run),
        observer=note,
    )
    with database.transaction():
        database.clear_ledger(STAGE)
        database.record(*decisions)
    return models


def _consistent(run: Run, graph: ViewGraph) -> tuple[ViewGraph, list[Decision]]:
    """The view graph without the pairs that contradict the others, and what is noted of these."""
    config = run.config.cycles
    found = cycle_consistency(graph, config)
    decisions = [
        Decision(
            *(STAGE, "\t".join(run.pair_names(pair)), "cycle_consistency", one.consistency, config.min_consistency),
            "dropped" if config.drop else "contradicts",
            f"rotation against that of {one.evidence:.1f} triplets, {len(graph.pairs[pair])} matches",
        )
        for pair, one in found.items()
        if one.contradicts
    ]
    return without_contradictions(graph, found) if config.drop else graph, decisions


def refines_intrinsics(run: Run) -> bool:
    """Given intrinsics are held fixed unless the user says otherwise."""
    cameras = run.config.cameras
    return cameras.refine_intrinsics or not cameras.intrinsics


def _key(run: Run, pair_keys: Mapping[Pair, str]) -> str:
    code = code_digest("sfm.viewgraph", "sfm.mapping", "sfm.bundle", "sfm.core", "sfm.pipeline", "sfm.io")
    images = [[k, image.name, image.digest, image.camera_id, image.camera] for k, image in sorted(run.images.items())]
    pairs = [[*pair, key] for pair, key in sorted(pair_keys.items())]
    given = bool(run.config.cameras.intrinsics)
    return key_of(
        code, run.config.cycles, run.config.mapping, run.config.seed, refines_intrinsics(run), given, images, pairs
    )


def _model_folders(folder: Path) -> list[Path]:
    """The folders 0, 1, … without a gap."""
    return list(itertools.takewhile(model_format, (folder / str(k) for k in itertools.count())))


def _files_key(folder: Path) -> str:
    files = [path for model in _model_folders(folder) for path in sorted(model.glob("*.bin"))]
    return key_of([[path.relative_to(folder).as_posix(), file_digest(path)] for path in files])


def _read_all(folder: Path) -> list[Reconstruction]:
    return [read_model(path) for path in _model_folders(folder)]


def _write_all(models: list[Reconstruction], folder: Path) -> None:
    """Puts these models in the place of all that are there, also if there are none: old ones must not pass for new."""

    def make(staging: Path) -> None:
        for k, model in enumerate(models):
            write_model(model, staging / str(k))

    if models or folder.exists():
        replace_folders(folder, make, obsolete=_numbered(folder))


def _numbered(folder: Path) -> list[Path]:
    """All folders with a number for a name, largest first, so that no gap arises while they are taken away."""
    found = [path for path in folder.glob("[0-9]*") if path.name.isdecimal() and path.is_dir()]
    return sorted(found, key=lambda path: int(path.name), reverse=True)
