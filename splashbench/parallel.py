"""Runs compiled kernels on several threads.

The kernels release the GIL, so plain Python threads do. Numba's own parallel loops bring an OpenMP runtime that spins
beside torch's and aborts the process when it is forked later. A kernel writes only what is its own part's, so results
do not depend on the number of threads. What one of the threads calls itself stays on it: parts that it waited for would
wait for a thread in their turn, and with all of them waiting none would ever begin.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from typing import Any, TypeVar

Item = TypeVar("Item")
Value = TypeVar("Value")

# More parts than threads, because the work along an axis of a grid is uneven.
_PARTS_PER_THREAD = 4
# `inside` is set on the threads of the pool.
_here = threading.local()


@lru_cache(maxsize=1)
def thread_count() -> int:
    """NUMBA_NUM_THREADS where set, else the processors this process may use."""
    configured = os.environ.get("NUMBA_NUM_THREADS", "")
    if configured.isdigit() and int(configured) > 0:
        return int(configured)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_count(), "splashbench", initializer=lambda: setattr(_here, "inside", True))


def _alone() -> bool:
    """Whether work stays on the calling thread."""
    return thread_count() == 1 or getattr(_here, "inside", False)


# Threads do not survive a fork; the child makes its own pool.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)


def over_range(kernel: Callable[..., None], count: int, *arguments: Any, smallest: int = 1) -> None:
    """Call kernel(*arguments, start, stop) for parts that together make up range(count), and wait.

    smallest: parts have at least this many elements, so that small loops stay on the calling thread.
    """
    parts = min(_PARTS_PER_THREAD * thread_count(), max(1, count // smallest))
    if parts == 1 or _alone():
        kernel(*arguments, 0, count)
        return
    edges = [count * part // parts for part in range(parts + 1)]
    futures = [_pool().submit(kernel, *arguments, start, stop) for start, stop in pairwise(edges)]
    for future in futures:
        future.result()


def each(function: Callable[[Item], Value], items: Iterable[Item]) -> list[Value]:
    """[function(item) for item in items], on all threads; for functions that release the GIL most of their time."""
    if _alone():
        return [function(item) for item in items]
    return list(_pool().map(function, items))
