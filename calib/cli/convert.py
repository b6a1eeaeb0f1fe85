"""`calib convert`: a calibration in another program's file."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from calib.cli.parsing import parsed
from sfm.core.errors import ConfigError, ExitCode, FormatError, Rejected

if TYPE_CHECKING:
    from sfm.core.cameras import Camera
    from sfm.io.camera_exchange import Reread
    from sfm.io.camera_records import CameraRecord
    from sfm.io.camera_set import CameraSet
    from sfm.io.rig_files import RigFile

EXAMPLES = (
    "calib convert camera.toml -o camera_info.yaml --to ros",
    "calib convert rig.toml -o camchain.yaml --to kalibr",
    "calib convert rig.toml -o colmap/cameras.txt",
    "calib convert left_intrinsics.yml -o camera.toml",
    "calib convert camera.toml -o cameras.txt --fit OPENCV",
)
_METRES = ("m", "metre", "meter")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ConvertOptions:
    """Reads a calibration of any known program and writes it for another.

    Principal points are moved by half a pixel where the programs count otherwise. A lens that the other program cannot
    say exactly is refused unless --fit asks for the nearest one. Every file is read again before it takes its place:
    the largest difference over the image is printed, and more than a millionth of a pixel is an error.
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE", help_behavior_hint="")]
    """A camera.toml or rig.toml, COLMAP's cameras.txt or .bin, OpenCV YAML or XML, ROS camera_info, Kalibr camchain,
    EuRoC sensor.yaml, BoofCV, nerfstudio transforms.json."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """What to write; its suffix names the format where it can."""

    to: Annotated[str, tyro.conf.arg(metavar="FORMAT", help_behavior_hint="")] = ""
    """parallax, colmap, opencv, ros, kalibr or nerfstudio; needed for .yaml, in which several programs write."""

    fit: Annotated[str, tyro.conf.arg(metavar="MODEL", help_behavior_hint="")] = ""
    """Take the nearest camera of this model, by least squares over the image, e.g. OPENCV, FULL_OPENCV,
    OPENCV_FISHEYE, EUCM; how far it is off is told."""

    camera: Annotated[str, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = ""
    """Only this camera of several."""

    size: Annotated[str, tyro.conf.arg(metavar="WxH", help_behavior_hint="")] = ""
    """Of the images, where the file does not say: 640x480."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    options = parsed(ConvertOptions, "convert", words, EXAMPLES)
    from sfm.io.atomic import check_writable
    from sfm.io.camera_exchange import format_of, read_camera_set, read_history, write_camera_set, write_poses_beside

    name = format_of(options.output, options.to)
    check_writable(options.output)
    if options.output.exists() and options.source.exists() and options.output.samefile(options.source):
        raise ConfigError("is both source and target", path=options.output, remedy="choose another -o")
    source, cameras = read_camera_set(options.source, _size(options.size))
    history, is_kept = read_history(options.source), name == "parallax" and not options.fit
    if options.camera:
        is_kept &= cameras.cams_from_rig is None
        cameras = _chosen(cameras, options.camera)
    print(f"{options.source} ({source}): {_told(cameras)}")
    if options.fit:
        cameras = _fitted(cameras, options.fit)
    found = write_camera_set(options.output, cameras, name, history if is_kept else None)
    print(f"{options.output} ({name}), read again:")
    print("\n".join(_lines(found)))
    beside = write_poses_beside(options.output, cameras, name)
    if beside:
        print(f"poses: {', '.join(map(str, beside))}")
    old = options.output.with_name(f"rigs{options.output.suffix.lower()}")
    if name == "colmap" and not beside and old.exists():
        print(f"note: {old} was there before and is not of these cameras; COLMAP would read both")
    for remark in _lost(cameras, name, beside):
        print(remark)
    if not is_kept and (tables := ", ".join(_tables(history))):
        print(f"note: {tables} of {options.source} {'are' if ',' in tables else 'is'} not in it")
    return ExitCode.OK


def _size(text: str) -> tuple[int, int] | None:
    if not text:
        return None
    match = re.fullmatch(r"(\d+)[x×](\d+)", text)
    if not match or not int(match.group(1)) or not int(match.group(2)):
        raise ConfigError(f"--size must be WIDTHxHEIGHT in px, got {text!r}", remedy="for example --size 640x480")
    return int(match.group(1)), int(match.group(2))


def _chosen(cameras: CameraSet, name: str) -> CameraSet:
    from sfm.io.camera_set import CameraSet

    if name not in cameras.names:
        raise ConfigError(f"there is no camera {name!r}", remedy=f"there are {', '.join(cameras.names)}")
    return CameraSet((name,), (cameras.cameras[cameras.names.index(name)],))


def _told(cameras: CameraSet) -> str:
    each = ", ".join(
        f"{name} {camera.model} {camera.width}x{camera.height}"
        for name, camera in zip(cameras.names, cameras.cameras, strict=True)
    )
    if len(cameras) == 1:
        return each
    return f"{each}; {'no poses' if cameras.cams_from_rig is None else 'with poses'}"


def _fitted(cameras: CameraSet, model: str) -> CameraSet:
    from sfm.core.cameras.conversion import difference

    near = []
    model = model.upper()
    for name, camera in zip(cameras.names, cameras.cameras, strict=True):
        found = _fit(camera, model, name)
        apart = difference(camera, found)
        line = f"  {name} as {model}: off by up to {apart.largest_px:.3g} px, rms {apart.rms_px:.3g} px"
        print(line + (f"; {apart.uncovered:.1%} of the image is not seen" if apart.uncovered else ""))
        near.append(found)
    return dataclasses.replace(cameras, cameras=tuple(near))


def _fit(camera: Camera, model: str, name: str) -> Camera:
    from sfm.core.cameras import MODELS
    from sfm.core.cameras.conversion import fitted

    names = [info.name for info in MODELS if info.focal_indices]
    if model not in names:
        raise ConfigError(f"--fit {model}: there is no such model", remedy=f"known are {', '.join(names)}")
    found = fitted(camera, model)
    if isinstance(found, Rejected):
        raise FormatError(f"{name} has no {model} near to it: {found.detail}")
    return found


def _lines(found: Sequence[Reread]) -> Iterator[str]:
    for one in found:
        pose = f", pose {one.motion:.1e}" if one.motion else ""
        yield f"  {one.name}: largest difference {one.apart.largest_px:.1e} px over the image{pose}"


def _tables(history: CameraRecord | RigFile | None) -> Iterator[str]:
    """What tells how cameras were calibrated, as the files of Parallax call it."""
    from sfm.io.camera_records import CameraRecord
    from sfm.io.rig_files import RigFile

    told: dict[str, object] = {}
    if isinstance(history, CameraRecord):
        told = {"[calibration]": history.facts, "[uncertainty]": history.uncertainty, "[board]": history.board}
        told |= {"[[finding]]": history.findings}
    elif isinstance(history, RigFile):
        told = {"[rig.provenance]": history.provenance, "standard deviations": history.sigmas}
    yield from (name for name, what in told.items() if what)


def _lost(cameras: CameraSet, name: str, beside: Sequence[Path]) -> Iterator[str]:
    """What the format has no place for."""
    posed = cameras.cams_from_rig is not None and len(cameras) > 1
    if posed and name == "colmap" and not beside:
        yield "note: the poses of the rig are not in it; call it cameras.txt or cameras.bin to have them in a rigs file"
    if posed and name == "kalibr" and cameras.unit not in _METRES:
        yield f"note: Kalibr means metres; these translations are in {cameras.unit or 'a unit that the file hides'}"
    if name == "nerfstudio":
        yield "note: there are no frames in it; copy the numbers to the top of a transforms.json that has them"
