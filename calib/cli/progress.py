"""What commands tell on stderr while they work."""

from __future__ import annotations

import contextlib
import gc
import sys
from collections.abc import Iterator
from pathlib import Path

from sfm.core.events import Event, ImageRead, Note, Observer, StageStarted
from sfm.io.kernel_cache import is_complete, mark_complete, use_kernel_cache

_PART = "calibration"


def told() -> Observer:
    """Counts photos on a terminal; elsewhere says only what begins."""
    state = {"done": 0, "total": 0}
    watched = sys.stderr.isatty()

    def tell(event: Event, /) -> None:
        match event:
            case StageStarted(stage=stage, total=total):
                state["done"], state["total"] = 0, total
                if not watched or not total:
                    _say(f"{stage} of {total} photos" if total else stage)
            case ImageRead() if watched:
                state["done"] += 1
                end = "\n" if state["done"] == state["total"] else ""
                print(f"\rphotos {state['done']} of {state['total']}", end=end, file=sys.stderr, flush=True)
            case Note(message=message):
                _say(message)

    return tell


@contextlib.contextmanager
def kernels_announced(observer: Observer) -> Iterator[None]:
    """Says beforehand that the first run compiles, and notes afterwards that this is done."""
    folder = Path(use_kernel_cache())
    if is_complete(folder, _PART):
        yield
        return
    observer(Note(message="compiling kernels along the way (first run only), about 20 seconds in all"))
    # Compilation makes many objects that live long; to look through them again and again is a tenth of its time.
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()
    mark_complete(folder, _PART)


def _say(words: str) -> None:
    print(words, file=sys.stderr, flush=True)
