"""Two parts of a fit that do not need each other, made at the same time on two cores.

Each part has a `Run` of its own, so that what it reuses, notes and counts as stages is told apart. The fit's time is
then the longer part's. With a part that was reused, the other one had the cores to itself and takes a little less.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, TypeVar

from splashbench.parallel import thread_count

#: A `splashbench.harness.contract.Run`, whose module imports this one.
Run = Any
First = TypeVar("First")
Second = TypeVar("Second")


class _Abandoned(Exception):
    """The other part has failed."""


class _Part:
    """One of the two: its own `Run`, and how far it is."""

    def __init__(self, run: Run, report: Callable[[], None], failed: threading.Event) -> None:
        self.fraction, self.message, self.seconds = 0.0, "", 0.0
        self._report, self._failed = report, failed
        self.run = replace(
            run,
            reused={},
            stages={},
            notes={},
            decisions=[],
            _overhead_seconds=0.0,
            _inner_seconds=0.0,
            _report=self.hear,
            _checkpoints=None,
        )

    def hear(self, fraction: float, message: str) -> None:
        if self._failed.is_set():
            raise _Abandoned
        self.fraction, self.message = fraction, message
        self._report()

    def make(self, function: Callable[[Run], Any]) -> Any:
        start = time.perf_counter()
        try:
            return function(self.run)
        except BaseException:
            self._failed.set()
            raise
        finally:
            self.seconds = self.run.fit_seconds(time.perf_counter() - start)


def side_by_side(
    run: Run, first: Callable[[Run], First], second: Callable[[Run], Second], span: tuple[float, float]
) -> tuple[First, Second]:
    """See `Run.side_by_side`."""
    lock, failed, told = threading.Lock(), threading.Event(), [0.0]

    def report() -> None:
        with lock:
            done = (parts[0].fraction + parts[1].fraction) / 2
            told[0] = max(told[0], done)
            behind = min(parts, key=lambda part: part.fraction)
            run.progress(span[0] + (span[1] - span[0]) * told[0], behind.message or "starting")

    parts = (_Part(run, report, failed), _Part(run, report, failed))
    start = time.perf_counter()
    if thread_count() == 1:
        results = parts[0].make(first), parts[1].make(second)
        took = sum(part.seconds for part in parts)
    else:
        results = _both(parts, first, second)
        took = max(part.seconds for part in parts)
    wall = time.perf_counter() - start
    for part in parts:
        run.reused.update(part.run.reused)
        run.notes.update(part.run.notes)
        for decision in part.run.decisions:
            run.decide(decision)
        for name, seconds in part.run.stages.items():
            run.stages[name] = run.stages.get(name, 0.0) + seconds
    # `fit_seconds` takes the wall time and adds what was reused: what is over `took` is to go.
    run._overhead_seconds += wall + sum(sum(part.run.reused.values()) for part in parts) - took
    return results


def ahead(
    run: Run, first: Callable[[Run], First], second: Callable[[Run], Second], span: tuple[float, float]
) -> tuple[Callable[[], First], Second]:
    """See `Run.ahead`."""
    if thread_count() > 1:
        made, result = side_by_side(run, first, second, span)
        return lambda: made, result
    found: list[First] = []

    def late() -> First:
        if not found:
            # The bar stays where it is, and says what it waits for.
            told = run._told
            found.append(_within(run, first, lambda _, message: run.progress(told, message)))
        return found[0]

    result = _within(run, second, lambda done, message: run.progress(span[0] + (span[1] - span[0]) * done, message))
    return late, result


def _within(run: Run, function: Callable[[Run], Any], report: Callable[[float, str], None]) -> Any:
    """What `function` returns for a part of `run` that is made now, in its stages and notes."""
    # It offers no states of its own, but what `run` offers meanwhile is in none of its stages.
    saving = run._checkpoint_seconds
    part = replace(run, _overhead_seconds=0.0, _inner_seconds=0.0, _report=report, _checkpoints=None, _saving=saving)
    try:
        return function(part)
    finally:
        run._overhead_seconds += part._overhead_seconds
        run._inner_seconds += part._inner_seconds


def _both(parts: tuple[_Part, _Part], first: Callable[[Run], Any], second: Callable[[Run], Any]) -> tuple[Any, Any]:
    with ThreadPoolExecutor(1, thread_name_prefix="splashbench-part") as pool:
        other = pool.submit(parts[1].make, second)
        try:
            one = parts[0].make(first)
        except _Abandoned:
            other.result()  # raises what made it so
            raise
        return one, other.result()
