"""Writes that are there whole or not at all.

A file is written under a temporary name in its own folder and then renamed over the target, which POSIX and Windows
do in one step. A reader, or a run that was killed and starts again, never meets half a file.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

from sfm.core.errors import InputError

Chunks: TypeAlias = Iterable[Any]
"""Pieces of a file, each `bytes` or a contiguous array: what `file.write` takes."""
_PROBED = 4096
"""Bytes, one block of most disks."""


@contextlib.contextmanager
def os_errors(path: Path) -> Iterator[None]:
    """Turns the system's refusals into an `InputError` that says what to do about them."""
    try:
        yield
    except OSError as error:
        raise refusal(error, path) from error


def refusal(error: OSError, path: Path | str | None) -> InputError:
    """What the system refuses, with what can be done about it."""
    return InputError((error.strerror or str(error)).lower(), path=path, remedy=_remedy(error))


def _remedy(error: OSError) -> str:
    match error:
        case PermissionError():
            return "check the permissions of the file and of its folder"
        case FileNotFoundError():
            return "check the spelling of the path"
        case FileExistsError() | NotADirectoryError() | IsADirectoryError():
            return "choose another path, or move what lies there"
    match error.errno:
        case errno.ENAMETOOLONG:
            return "choose a shorter name"
        case errno.EFBIG:
            return "the system limits the size of files, see `ulimit -f`"
        case errno.EMFILE | errno.ENFILE:
            return "close other programs, or raise the limit of open files, see `ulimit -n`"
        case errno.ENOSPC:
            return "make room there, or choose another disk or folder"
    return "choose another disk or folder"


def check_writable(*targets: Path | None) -> None:
    """Finds out before long work whether files can be written where they are wanted; leaves nothing behind.

    Raises:
        InputError: the system refuses, or a folder has the name of a file.
    """
    for target in targets:
        if target is None:
            continue
        with os_errors(target):
            if target.is_dir():
                raise IsADirectoryError(errno.EISDIR, "is a folder")
            folder = next(parent for parent in Path(os.path.abspath(target)).parents if parent.exists())
            probe = _beside(folder / target.name)
            try:
                probe.write_bytes(bytes(_PROBED))  # a full disk takes the name of a file, but not a byte
            finally:
                with contextlib.suppress(OSError):
                    probe.unlink()


def _beside(target: Path) -> Path:
    return target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")


@contextlib.contextmanager
def atomic_path(target: Path, *, sync: bool = False) -> Iterator[Path]:
    """Lends a temporary path beside `target`; what was written there replaces `target` when the block ends well.

    Args:
        sync: wait until the file is on the disk, so that it also survives a power cut.
    Raises:
        InputError: the system refuses, e.g. in a read-only folder.
    """
    temporary = _beside(target)
    with os_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield temporary
            if sync:
                _sync(temporary)
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)


def write_chunks(target: Path, chunks: Chunks, *, sync: bool = False) -> None:
    """Writes the pieces one after the other; see `atomic_path`."""
    with atomic_path(target, sync=sync) as temporary, temporary.open("wb") as file:
        for chunk in chunks:
            file.write(chunk)


def write_bytes(target: Path, data: bytes, *, sync: bool = False) -> None:
    """Writes `data`; see `atomic_path`."""
    write_chunks(target, [data], sync=sync)


def write_text(target: Path, text: str, *, sync: bool = False) -> None:
    """Writes `text` as UTF-8 with line feeds on every system; see `atomic_path`."""
    write_chunks(target, [text.encode()], sync=sync)


def write_folder(folder: Path, files: Mapping[str, Chunks], *, obsolete: Iterable[str] = ()) -> None:
    """Writes several files that belong together.

    All of them are written before the first takes its place. A new folder appears in one step; in a folder that
    exists the files are exchanged one by one, so that only a kill within these few renames can leave a mixture.

    Args:
        files: by name.
        obsolete: names of files in `folder` that the new ones supersede; they are removed last.
    Raises:
        InputError: the system refuses; `folder` is then as it was, save for such a mixture.
    """
    folder = Path(os.path.abspath(folder))
    exists = folder.is_dir()
    name = f".{folder.name}.{secrets.token_hex(4)}.tmp"
    staging = folder / name if exists else folder.with_name(name)
    with os_errors(folder):
        try:
            staging.mkdir(parents=True)
            for name, chunks in files.items():
                with (staging / name).open("wb") as file:
                    for chunk in chunks:
                        file.write(chunk)
            if not exists:
                os.replace(staging, folder)
                return
            for name in files:
                os.replace(staging / name, folder / name)
            for name in obsolete:
                (folder / name).unlink(missing_ok=True)
        finally:
            shutil.rmtree(staging, ignore_errors=True)


def replace_folders(parent: Path, make: Callable[[Path], None], *, obsolete: Iterable[Path]) -> None:
    """Exchanges folders in `parent` that belong together.

    All new ones are complete before the old ones go. A kill in between leaves some of either kind or none, but each
    of them whole. What an earlier kill left is removed; so nobody else may be at work in `parent`.

    Args:
        make: fills the folder that it is given with the new folders, or leaves it empty.
        obsolete: the old ones, which go even if no new one takes their place.
    Raises:
        InputError: the system refuses; unless it is the very exchange that fails, the old folders are still there.
    """
    with os_errors(parent):
        parent.mkdir(parents=True, exist_ok=True)
        for path in parent.glob(".*.tmp"):
            shutil.rmtree(path)
        staging, waste = (parent / f".{kind}.{secrets.token_hex(4)}.tmp" for kind in ("new", "old"))
        try:
            staging.mkdir()
            waste.mkdir()
            make(staging)
            for path in obsolete:
                os.replace(path, waste / path.name)
            for path in sorted(staging.iterdir()):
                os.replace(path, parent / path.name)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
            shutil.rmtree(waste, ignore_errors=True)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
