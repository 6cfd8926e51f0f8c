"""Runs a compiled kernel on several threads.

The kernels release the GIL, so plain Python threads do. Numba's own parallel loops would bring a second OpenMP beside
torch's: their idle threads spin against each other, and numba warns or aborts on forks and nested use.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache


@lru_cache(maxsize=1)
def thread_count() -> int:
    """Threads to render with: NUMBA_NUM_THREADS where set, else one per processor this process may use."""
    configured = os.environ.get("NUMBA_NUM_THREADS", "")
    if configured.isdigit() and int(configured) > 0:
        return int(configured)
    return max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=max(1, thread_count() - 1), thread_name_prefix="splashbench-render")


# Threads do not survive a fork; the child makes its own pool.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)


def run_on_all(kernel: Callable[[int, int], None]) -> None:
    """Call kernel(worker, workers) for every worker and wait; the last one runs on the calling thread."""
    workers = thread_count()
    futures = [_pool().submit(kernel, worker, workers) for worker in range(workers - 1)]
    kernel(workers - 1, workers)
    for future in futures:
        future.result()
