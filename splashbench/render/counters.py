"""What the renderer was asked to do: the harness reads primitives per frame, and the backend used, from here.

Counted per camera, before anything is culled. Plain module state: a method runs in a process of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

last: int = 0
"""Gaussians of the latest rendering, frozen ones included."""
_calls: int = 0
_total: int = 0
_backends: set[str] = set()


def reset() -> None:
    """Start counting from zero. The backends seen are kept."""
    global last, _calls, _total
    last, _calls, _total = 0, 0, 0


def record(primitives: int, backend: str) -> None:
    """Note one rendering of `primitives` Gaussians by `backend`."""
    global last, _calls, _total
    last = primitives
    _calls += 1
    _total += primitives
    _backends.add(backend)


@contextmanager
def uncounted() -> Iterator[None]:
    """Render within without counting, as for an opacity that is asked for beside the image itself."""
    global last, _calls, _total
    before = last, _calls, _total
    try:
        yield
    finally:
        last, _calls, _total = before


def calls() -> int:
    """Renderings since `reset`."""
    return _calls


def total() -> int:
    """Gaussians of all renderings since `reset`."""
    return _total


def backends() -> list[str]:
    """The backends that this process has rendered with, such as ["cpu (avx2)"]."""
    return sorted(_backends)
