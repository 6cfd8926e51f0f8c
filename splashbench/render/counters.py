"""How many Gaussians were handed to the renderer: the harness reads primitives per frame from here.

Counted per forward call, before anything is culled. Plain module state: a method runs in a process of its own.
"""

from __future__ import annotations

last: int = 0
"""Gaussians passed to the latest forward call."""
_calls: int = 0
_total: int = 0


def reset() -> None:
    """Start counting from zero."""
    global last, _calls, _total
    last, _calls, _total = 0, 0, 0


def record(primitives: int) -> None:
    """Note one forward call on `primitives` Gaussians."""
    global last, _calls, _total
    last = primitives
    _calls += 1
    _total += primitives


def calls() -> int:
    """Forward calls since `reset`."""
    return _calls


def total() -> int:
    """Gaussians passed to all forward calls since `reset`."""
    return _total
