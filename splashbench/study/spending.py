"""Which run of a stress study comes next: the one that says the most about where a method breaks.

Of each method, scene, seed and kind one looks for the first severity that breaks it. Every run halves what is left, as
in a bisection, and what is the least certain comes first. Once all is known the severities in between are filled in.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from splashbench.study.job import ERROR, Store
from splashbench.study.plan import PlannedRun
from splashbench.study.stability import BROKEN, retentions
from splashbench.study.stress import METRICS, NOTHING, StressPlan, higher_is_better, stress_runs

#: What is broken is told by the first of the metrics.
_METRIC = METRICS[0]


@dataclass(frozen=True)
class Cell:
    """What is bisected: one method on one scene with one seed, under one kind of harm."""

    method: str
    scene: str
    seed: int
    kind: str


@dataclass
class StudyBudget:
    """Runs within `seconds`. clock: seconds, from any start."""

    seconds: float
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._end = self.clock() + self.seconds

    def allows(self, expected: float) -> bool:
        """Whether a run of `expected` seconds would end in time."""
        return self.clock() + expected <= self._end


def by_uncertainty(
    stress: StressPlan, store: Store, budget: StudyBudget
) -> Callable[[Sequence[PlannedRun]], Iterator[PlannedRun]]:
    """What orders the missing runs of `stress`, and ends once another would not end within `budget`.

    The recording as it is comes first, whatever the budget: without it no other run says anything.
    """

    def order(missing: Sequence[PlannedRun]) -> Iterator[PlannedRun]:
        left = {run.digest: run for run in missing}
        first = [run for run in missing if stress.rows[run.variant.name][1] is None]
        for run in first:
            del left[run.digest]
            yield run
        started = dict.fromkeys((run.digest for run in first), 0)
        while left:
            run = _next(stress, store, left, started)
            if not budget.allows(_expected(stress, store, run)):
                return
            del left[run.digest]
            started[run.digest] = 0
            yield run

    return order


def _next(stress: StressPlan, store: Store, left: dict[str, PlannedRun], started: dict[str, int]) -> PlannedRun:
    """The run of `left` that says the most. started: those that were begun, and may not have ended."""
    known = _known(stress, store)
    waiting = {
        _cell(stress, run) for run in stress.plan.runs if run.digest in started and store.entry(run.digest) is None
    }
    made: dict[str, int] = {}
    for ended, found in known.items():
        made[ended.method] = made.get(ended.method, 0) + len(found)
    runs: dict[Cell, dict[int, PlannedRun]] = {}
    for run in left.values():
        harm = stress.rows[run.variant.name][1]
        assert harm is not None
        runs.setdefault(_cell(stress, run), {})[harm.level] = run

    def worth(cell: Cell) -> tuple[bool, int, int]:
        # A cell whose run has not ended yet says more once it has; among equals, methods take turns.
        return cell not in waiting, len(_open(known.get(cell, {}), runs[cell])), -made.get(cell.method, 0)

    cell = max(runs, key=worth)
    unknown = _open(known.get(cell, {}), runs[cell])
    levels = unknown or sorted(runs[cell])
    return runs[cell][levels[len(levels) // 2]]


def _open(known: dict[int, bool], left: dict[int, PlannedRun]) -> list[int]:
    """The levels among which the first broken one may be, that can be run. known: by level, whether it broke."""
    broken = min((level for level, broke in known.items() if broke), default=6)
    whole = max((level for level, broke in known.items() if not broke and level < broken), default=0)
    return sorted(level for level in left if whole < level < broken)


def _known(stress: StressPlan, store: Store) -> dict[Cell, dict[int, bool]]:
    """Of each cell the levels that were run, and whether they broke the method."""
    runs, nothing = stress_runs(stress, store, _METRIC)
    found: dict[Cell, dict[int, bool]] = {}
    for run, kept in retentions(runs, nothing, higher_is_better(_METRIC)).items():
        found.setdefault(Cell(run.method, run.scene, run.seed, run.kind), {})[run.level] = kept < BROKEN
    return found


def _cell(stress: StressPlan, run: PlannedRun) -> Cell:
    label, harm = stress.rows[run.variant.name]
    return Cell(label, run.scene.name, run.seed, "" if harm is None else harm.kind.named())


def _expected(stress: StressPlan, store: Store, run: PlannedRun) -> float:
    """Seconds that the run may take: the mean of its method's runs on its scene, 0 where there is none."""
    label = stress.rows[run.variant.name][0]
    seconds = []
    for other in stress.plan.runs:
        if stress.rows[other.variant.name][0] == label != NOTHING and other.scene.name == run.scene.name:
            entry = store.entry(other.digest)
            if entry is not None and entry.status != ERROR:
                seconds.append(entry.seconds)
    return sum(seconds) / len(seconds) if seconds else 0.0
