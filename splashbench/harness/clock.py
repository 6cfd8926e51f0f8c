"""The clock of a run, read from outside: what the keeper stamped, and what counts as the fit's time.

A method can write marks of its own into its line (channel.py). It gains little by it: what passes between the fit's
end and the process's end counts as fit, beyond what saving takes, and so does a start that is far too long. What stays
free is what an honest method may need: START_SECONDS to import, END_SECONDS and the model's bytes to save.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

from pydantic import BaseModel, ConfigDict

from splashbench.harness.channel import FIT_ENDS, FIT_STARTS, GOES_ON, PAUSED, SAVED, TIMING_ENDS, TIMING_STARTS
from splashbench.harness.messages import Outcome

#: Seconds that starting may take, to import libraries; and saving and ending, to which the model's bytes add.
START_SECONDS, END_SECONDS = 120.0, 10.0
SAVED_BYTES_PER_SECOND = 5e6
# The median of frame times is reported, and the mean seen from outside: more than this apart is no median.
_FASTER = 2.0


class Report(BaseModel):
    """What the keeper saw of one phase; times are seconds of one clock.

    Attributes:
        started, ended: of the method's process. marks: what it told, and when that came. strays: what it had left.
        outcome: what it told last of how the phase ended; None where it told nothing of the kind.
    """

    model_config = ConfigDict(extra="forbid")
    started: float
    ended: float
    marks: list[tuple[str, float]]
    strays: list[str]
    outcome: Outcome | None


@dataclass(frozen=True)
class FitTime:
    """Attributes: seconds of the fit; states: of it so far, at each pause; paused: seconds of all pauses together."""

    seconds: float
    states: list[float]
    paused: float


def fit_time(report: Report, storage_bytes: int) -> FitTime | None:
    """How long the fit took; None where its marks are not those of a fit that came to its end.

    storage_bytes: of the model that it saved.
    """
    starts = _one(report, FIT_STARTS)
    ends, saved = _one(report, FIT_ENDS), _one(report, SAVED)
    if starts is None or ends is None or saved is None or not starts <= ends <= saved <= report.ended:
        return None
    states, paused, pause = [], 0.0, None
    for name, at in _between(report, starts, ends):
        if name == PAUSED and pause is None:
            pause = at
            states.append(at - starts - paused)
        elif name == GOES_ON and pause is not None:
            paused += at - pause
            pause = None
    late = max(0.0, starts - report.started - START_SECONDS)
    late += max(0.0, report.ended - ends - END_SECONDS - storage_bytes / SAVED_BYTES_PER_SECOND)
    return FitTime(ends - starts - paused + late, states, paused)


def state_seconds(told: list[float], seen: list[float]) -> list[float]:
    """Seconds of the fit at each state: as its own clock told where that is within a second and 5% of what was seen.

    Marks are passed by the fit's own clock, which a look from outside would put a little late.
    """
    if len(told) != len(seen):
        return seen
    close = all(abs(a - b) <= 1.0 + 0.05 * b for a, b in zip(told, seen))
    return told if close and all(later >= earlier >= 0 for earlier, later in pairwise([0.0, *told])) else seen


def frames_per_second(report: Report, told: float | None, frames: int) -> float | None:
    """The frame rate that was told, where the time that all `frames` took allows it; else their mean rate. None where
    nothing was told, or no time was seen."""
    starts, ends = _one(report, TIMING_STARTS), _one(report, TIMING_ENDS)
    # Marks that come at once are of no rendering: so many frames take longer than it takes to stamp a mark.
    if told is None or starts is None or ends is None or ends <= starts:
        return None
    mean = frames / (ends - starts)
    return told if told <= _FASTER * mean else mean


def _one(report: Report, name: str) -> float | None:
    times = [at for mark, at in report.marks if mark == name]
    return times[0] if len(times) == 1 else None


def _between(report: Report, first: float, last: float) -> Iterator[tuple[str, float]]:
    return ((name, at) for name, at in report.marks if first <= at <= last)
