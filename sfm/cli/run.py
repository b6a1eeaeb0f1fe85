"""`sfm run`: photos → camera poses and a sparse model."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from sfm.cli.parsing import Flag, parsed
from sfm.core.errors import ConfigError, ExitCode
from sfm.core.events import Note

EXAMPLES = (
    "sfm run photos -o scene",
    "sfm run photos -o scene --single-camera --camera-model OPENCV",
    "sfm run photos -o scene --intrinsics cameras.txt --set features.max_features=4000",
)


def _arg(metavar: str, default: str = "", **options: Any) -> Any:
    """How an option is shown; its default is that of the settings, which are not loaded for the help."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})" if default else "", **options)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SettingOptions:
    """The settings that have an option of their own, the same for all commands that compute in a workspace."""

    max_image_size: Annotated[int | None, _arg("PX", "3200")] = None
    """Longest side to which larger photos are reduced when features are sought; 0 for full size."""

    features: Annotated[str | None, _arg("NAME", "sift")] = None
    """Who finds and describes features: sift, orb, akaze, brisk, harris, shi_tomasi, fast, aliked, disk, and for
    videos klt."""

    masks: Annotated[Path | None, _arg("DIR", "IMAGES/masks or IMAGES/../masks")] = None
    """Masks, black where nothing shall be sought, called e.g. IMG.jpg.png, IMG.png, IMG_mask.png or mask_IMG.png for
    IMG.jpg; none for no masks."""

    camera_model: Annotated[str | None, _arg("MODEL", "SIMPLE_RADIAL")] = None
    """COLMAP's name of a camera model, e.g. SIMPLE_PINHOLE, OPENCV, OPENCV_FISHEYE."""

    intrinsics: Annotated[Path | None, _arg("FILE")] = None
    """Known cameras: a COLMAP cameras.txt or a Parallax camera TOML. One camera is shared by all photos; of several,
    a photo takes the one of its size, or else they are taken in the order of the photos. Held fixed."""

    refine_intrinsics: Flag = False
    """Adjust the given intrinsics too."""

    single_camera: Flag = False
    """All photos share one camera. By default those of equal size, make, model and focal length do."""

    camera_per_folder: Flag = False
    """The photos of a folder share a camera."""

    camera_per_image: Flag = False
    """Every photo has its own camera."""

    pairs: Annotated[str | None, _arg("METHOD", "auto")] = None
    """Which photos are compared: exhaustive, vocabulary, look, sequential (frames of a video), spatial (by GPS)."""

    pair_list: Annotated[Path | None, _arg("FILE")] = None
    """Compare the pairs of this file only: two names of photos a line."""

    seed: Annotated[int | None, _arg("N", "0")] = None
    """Of all random choices; the same seed gives the same result."""

    threads: Annotated[int, _arg("N", "0")] = 0
    """At most so many at once; 0 for all cores. The result does not depend on it."""

    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, _arg("KEY=VALUE")] = ()
    """Any other setting, by its key in sfm.toml; may be repeated."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunOptions(SettingOptions):
    """Camera poses and a sparse model from a folder of photos.

    A run that was interrupted goes on where it stopped when it is repeated; new photos in the folder are added. What
    is not given here is as in the workspace's sfm.toml, or else a default.
    """

    images: Annotated[tyro.conf.Positional[Path], _arg("IMAGES")]
    """Folder of photos; folders within are searched as well. It is only read."""

    output: Annotated[
        Path | None, tyro.conf.arg(aliases=["-o"], metavar="WORKSPACE", help_behavior_hint="(default: IMAGES-sfm)")
    ] = None
    """Workspace for all results. Without it a folder beside the photos."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(RunOptions, "run", words, EXAMPLES)
    check(options)

    from sfm.pipeline.observers import screen_progress, watched
    from sfm.pipeline.run import reconstruct

    workspace = options.output or default_workspace(options.images)
    with watched(screen_progress()) as observer:
        config, note = configured(options, workspace)
        if note:
            observer(Note(message=note))
        report = reconstruct(options.images, workspace, config, threads=options.threads, observer=observer)
    print(report.verdict())
    return ExitCode.OK


def default_workspace(images: Path) -> Path:
    """A folder beside the photos, never in them."""
    folder = images.absolute().resolve()
    return folder.with_name(f"{folder.name or 'photos'}-sfm")


def check(options: SettingOptions) -> None:
    """Raises ConfigError where options exclude each other or are out of range."""
    sharing = [options.single_camera, options.camera_per_folder, options.camera_per_image]
    if sum(sharing) > 1:
        raise ConfigError("--single-camera, --camera-per-folder and --camera-per-image exclude each other")
    if options.pair_list is not None and options.pairs not in (None, "list"):
        raise ConfigError("--pairs and --pair-list exclude each other")
    if options.threads < 0:
        raise ConfigError(f"--threads must not be negative, got {options.threads}")


def configured(options: SettingOptions, workspace: Path) -> tuple[Any, str]:
    """All settings: defaults, then the workspace's sfm.toml, then the command line; and what the file changed."""
    from sfm.pipeline.config import PipelineConfig, flattened, parsed_setting, read_toml, with_settings

    config, note = PipelineConfig(), ""
    path = workspace / "sfm.toml"
    given = dict(parsed_setting(text) for text in options.set) | dict(_shortcuts(options))
    # The next command may be called from another folder.
    given |= {k: str(Path(v).absolute()) for k in _PATHS if (v := given.get(k)) and v != "none"}
    if path.is_file():
        defaults = dict(flattened(config))
        config = read_toml(path, config)
        kept = {k: v for k, v in flattened(config) if v != defaults[k] and k not in given}
        if kept:
            told = ", ".join(f"{key} = {value!r}" for key, value in kept.items())
            note = f"settings from {path}: {told}"
    return with_settings(config, given, "command line"), note


_PATHS = ("masks", "cameras.intrinsics", "retrieval.pair_list", "features.model", "matching.lightglue")


def _shortcuts(options: SettingOptions) -> Iterator[tuple[str, Any]]:
    """The settings that have an option of their own."""
    if options.max_image_size is not None:
        yield "features.max_image_size", options.max_image_size
    if options.features is not None:
        yield "features.kind", options.features.lower()
    if options.masks is not None:
        yield "masks", "none" if str(options.masks) == "none" else str(options.masks.absolute())
    if options.camera_model is not None:
        yield "cameras.model", options.camera_model.upper()
    if options.intrinsics is not None:
        yield "cameras.intrinsics", str(options.intrinsics.absolute())
    if options.refine_intrinsics:
        yield "cameras.refine_intrinsics", True
    for sharing, wanted in (
        ("single", options.single_camera),
        ("folder", options.camera_per_folder),
        ("image", options.camera_per_image),
    ):
        if wanted:
            yield "cameras.sharing", sharing
    if options.pairs is not None:
        yield "retrieval.method", options.pairs.lower()
    if options.pair_list is not None:
        yield "retrieval.method", "list"
        yield "retrieval.pair_list", str(options.pair_list.absolute())
    if options.seed is not None:
        yield "seed", options.seed
