"""Checkpoints: states of a fit that is under way, saved outside its clock.

A method offers its state as often as it likes (`Run.checkpoint`). At the marks, the same for every method, the harness
takes one, and besides whatever a method calls a milestone. Making and saving them are no part of the fit's time, nor
of the stage that they fall into.
"""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np

from splashbench.harness.channel import GOES_ON, PAUSED
from splashbench.submission.identity import MAX_CHECKPOINTS

#: Seconds of the fit at which a state is asked for: two for each doubling, for a month. Each is a little early, so that
#: what comes at the first offer after it counts within 10, 30, 60, 120 and 300 seconds.
MARKS = tuple(4.8 * 2 ** (k / 2) for k in range(40))


class Savable(Protocol):
    """What `splashbench.harness.contract.Fitted` has of use here."""

    def save(self, directory: Path) -> None:
        """Write the model into the empty folder `directory`."""
        ...


class Checkpoints:
    """Takes the states of one fit, each into a folder of its own below `folder`: 00, 01 and so on.

    Attributes:
        seconds: of the fit, when each state was offered; never before its mark, unless it is a milestone.
        spent: seconds that making and saving them took.
    """

    def __init__(
        self,
        folder: Path,
        marks: Sequence[float],
        elapsed: Callable[[], float],
        synchronise: Callable[[], None],
        tell: Callable[[str], None] = lambda mark: None,
    ) -> None:
        """marks: rising seconds. elapsed: those of the fit so far. synchronise: waits for what a device computes.

        tell: is told when the fit pauses and goes on (channel.py).
        """
        self.seconds: list[float] = []
        self.spent = 0.0
        self._folder, self._elapsed, self._synchronise = folder, elapsed, synchronise
        self._left, self._tell = list(reversed(marks)), tell

    def offer(self, state: Callable[[], Savable], milestone: bool = False) -> None:
        """Take what `state` makes where a mark has come, or a `milestone` was reached; at most MAX_CHECKPOINTS."""
        if len(self.seconds) >= MAX_CHECKPOINTS:
            return
        if not milestone and (not self._left or self._elapsed() < self._left[-1]):
            return
        self._synchronise()
        elapsed, start = self._elapsed(), time.perf_counter()
        self._tell(PAUSED)
        place = self._folder / f"{len(self.seconds):02d}"
        place.mkdir(parents=True)
        with _random_numbers_kept():
            state().save(place)
        self.seconds.append(elapsed)
        # Of the marks that one long step went past, one state serves all.
        while self._left and self._left[-1] <= elapsed:
            self._left.pop()
        self._tell(GOES_ON)
        self.spent += time.perf_counter() - start


@contextmanager
def _random_numbers_kept() -> Iterator[None]:
    """Whatever is drawn within from the global generators of Python, numpy and torch is drawn again after."""
    torch = sys.modules.get("torch")
    python, legacy = random.getstate(), np.random.get_state()  # noqa: NPY002 - whoever draws from it is to be undone
    drawn = torch.random.get_rng_state() if torch is not None else None
    try:
        yield
    finally:
        random.setstate(python)
        np.random.set_state(legacy)  # noqa: NPY002
        if torch is not None:
            torch.random.set_rng_state(drawn)
