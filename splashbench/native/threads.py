"""On how many threads the compiled kernels work."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from splashbench.parallel import thread_count

MAX_THREADS = 64  # as in threads.h

_requested: int | None = None


@contextmanager
def use_threads(count: int) -> Iterator[None]:
    """Use `count` threads within the body, in the whole process; else splashbench.parallel.thread_count()."""
    global _requested
    before, _requested = _requested, count
    try:
        yield
    finally:
        _requested = before


def kernel_threads() -> int:
    """On how many threads a kernel called now works."""
    return min(_requested or thread_count(), MAX_THREADS)
