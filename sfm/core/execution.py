"""Work on several threads whose results do not depend on how many there are.

Kernels and cv2 release the GIL, so plain threads use all cores. Results come back in the order of the items and
sums are taken over a fixed number of chunks in a fixed order: the output is bit-identical for any `threads`.
"""

from __future__ import annotations

import collections
import itertools
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import TypeVar, cast

Item = TypeVar("Item")
Result = TypeVar("Result")
_ABANDONABLE = "abandonable"


def available_threads() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine_bytes() -> int:
    """Memory of the machine; 8 GiB where it does not tell."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 8 << 30


def ordered_map(
    function: Callable[[Item], Result], items: Iterable[Item], *, threads: int = 1, ahead: int = 2,
    abandons: bool = False,
) -> Iterator[Result]:  # fmt: skip
    """`map(function, items)` on `threads` threads, yielded in the order of the items.

    Items are drawn lazily, at most `threads + ahead` of them in flight, so that memory stays bounded.
    An exception of `function` is raised where its result would have been yielded.

    Args:
        abandons: an interruption by the user does not wait for items in flight, which may take seconds and must leave
            nothing broken whenever they are cut off; see `has_abandoned`.
    """
    if threads <= 1:
        yield from map(function, items)
        return
    pending: collections.deque[Future[Result]] = collections.deque()
    pool = ThreadPoolExecutor(threads, thread_name_prefix=_ABANDONABLE if abandons else "")
    waits = True
    try:
        for item in items:
            pending.append(pool.submit(function, item))
            if len(pending) >= threads + ahead:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    except KeyboardInterrupt:
        waits = not abandons
        raise
    finally:
        pool.shutdown(wait=waits, cancel_futures=True)


def has_abandoned() -> bool:
    """Whether items that nobody waits for are still at work; Python itself would wait for them before it ends."""
    return any(thread.name.startswith(_ABANDONABLE) for thread in threading.enumerate())


class Workers:
    """Threads that are kept for many short calls: to start them takes longer than the work of one.

    They end when this is no longer referred to. A job must not call `map` of its own workers.
    """

    def __init__(self, threads: int) -> None:
        self.threads = max(threads, 1)
        self._pool = ThreadPoolExecutor(self.threads - 1) if self.threads > 1 else None

    def map(self, function: Callable[[Item], Result], jobs: Sequence[Item]) -> list[Result]:
        """`[function(job) for job in jobs]`; the calling thread takes jobs like the others."""
        if self._pool is None or len(jobs) < 2:
            return [function(job) for job in jobs]
        results: list[Result | None] = [None] * len(jobs)
        take_turns = partial(_take_jobs, function, jobs, itertools.count(), results)
        others = [self._pool.submit(take_turns) for _ in range(min(self.threads, len(jobs)) - 1)]
        try:
            take_turns()
        finally:
            for other in others:
                if not other.cancel():  # one that has not begun has nothing left to do
                    other.result()
        return cast("list[Result]", results)


def _take_jobs(
    function: Callable[[Item], Result], jobs: Sequence[Item], turn: Iterator[int], results: list[Result | None]
) -> None:
    """Does the job whose turn it is until none is left; `turn` is shared by threads."""
    while (k := next(turn)) < len(jobs):
        results[k] = function(jobs[k])


def chunk_bounds(count: int, chunks: int) -> list[tuple[int, int]]:
    """Splits `range(count)` into at most `chunks` contiguous, nearly equal, non-empty ranges."""
    chunks = min(max(1, chunks), count)
    if chunks == 0:
        return []
    edges = [count * k // chunks for k in range(chunks + 1)]
    return list(itertools.pairwise(edges))
