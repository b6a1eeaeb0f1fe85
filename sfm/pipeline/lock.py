"""One run at a time in a workspace.

The lock is a file that names process and host. A process that was killed leaves it behind; the next run on the same
host sees that nobody lives under that number any more, or somebody who started later, and takes over.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sfm.core.errors import WorkspaceLockedError

_NAME = ".lock"


@contextlib.contextmanager
def locked(workspace: Path) -> Iterator[None]:
    """Holds the lock of `workspace` while the block runs.

    Raises:
        WorkspaceLockedError: another run holds it.
    """
    path = workspace / _NAME
    if not _claim(path):
        owner = _owner(path)
        if _is_alive(owner) or not _remove_stale(path, owner) or not _claim(path):
            raise _locked_error(path)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def _claim(path: Path) -> bool:
    """Creates the file with its content in one step, which fails where one exists."""
    own = {"pid": os.getpid(), "host": socket.gethostname(), "started": _start_of(os.getpid())}
    draft = path.with_name(f"{_NAME}.{secrets.token_hex(4)}.tmp")
    try:
        draft.write_text(json.dumps(own))
        os.link(draft, path)
    except FileExistsError:
        return False
    except OSError:  # a file system without hard links; one that takes no file at all says so again
        try:
            with path.open("x") as file:
                file.write(json.dumps(own))
        except FileExistsError:
            return False
    finally:
        draft.unlink(missing_ok=True)
    return True


def _owner(path: Path) -> dict[str, Any]:
    try:
        owner = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return owner if isinstance(owner, dict) else {}


def _is_alive(owner: dict[str, Any]) -> bool:
    """Whether the owner may still run; unknown hosts and systems that cannot tell count as alive."""
    if not owner:
        return False
    if owner.get("host") != socket.gethostname() or os.name == "nt":
        return True
    pid = owner.get("pid")
    if not isinstance(pid, int) or pid <= 0:
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return _start_of(pid) == owner.get("started")


def _start_of(pid: int) -> str:
    """What tells processes apart that had the same number one after the other; empty where the system does not say."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except (OSError, IndexError):
        return ""
    return f"{boot}:{fields[19]}"  # field 22 of the whole line: ticks from boot to the start


def _remove_stale(path: Path, owner: dict[str, Any]) -> bool:
    """Moves the dead owner's file away; of several runs that try, only one moves that very file."""
    aside = path.with_name(f"{_NAME}.{secrets.token_hex(4)}.tmp")
    try:
        os.rename(path, aside)
    except FileNotFoundError:
        return True
    stale = _owner(aside) == owner
    if not stale:
        with contextlib.suppress(OSError):
            os.link(aside, path)
    aside.unlink(missing_ok=True)
    return stale


def _locked_error(path: Path) -> WorkspaceLockedError:
    owner = _owner(path)
    who = f"process {owner.get('pid', '?')} on {owner.get('host', '?')}"
    return WorkspaceLockedError(
        f"another run works in this workspace ({who})",
        path=path.parent,
        remedy=f"wait for it, or delete {path} if it is gone",
    )
