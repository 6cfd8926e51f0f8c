"""Quality in the course of time: what each method has to show after so many seconds of its fit.

A run has a value from its first checkpoint on, the last one to its end (docs/protocol.md, "Quality over time"). Before,
and for ever where it failed, it shows what the control `nothing` shows of that scene: so failures and late starts are
charged and never dropped.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splashbench.report.groups import Entry, Group
from splashbench.score.metrics import METRICS
from splashbench.score.result import Result
from splashbench.statistics import (
    Comparison,
    Estimate,
    Trajectory,
    compare,
    estimate,
    expected_running_time,
    hypervolume,
)

#: The metrics that charts of quality offer, the first one at first.
QUALITY = ("psnr", "lpips", "miou")
#: Seconds of which the page says which method is best.
BUDGETS = (10.0, 60.0, 300.0)
#: Entries of a group that have curves and are compared two by two.
MAX_DRAWN = 30
_PER_OCTAVE = 4
#: Ideal and reference of the hypervolume's dimensions: minutes of fit, LPIPS, megabytes (docs/protocol.md).
IDEAL, WORST = (1.0, 0.04, 1.0), (240.0, 0.20, 1000.0)


def trajectory(result: Result, name: str, failed_after: float) -> Trajectory | None:
    """`result` over time by metric `name`; None for a run that is fine and lacks the metric or its time."""
    if result.status != "ok":
        return Trajectory((), (), failed_after)
    end, seconds = result.value(name), result.value("fit_seconds")
    if end is None or not seconds:
        return None
    states = [(c.seconds, c.metrics[name]) for c in result.checkpoints if c.metrics.get(name) is not None]
    states = [*(state for state in states if state[0] <= seconds), (seconds, end)]
    times, values = zip(*states)
    return Trajectory(times, values)


def trajectories(group: Group, entry: Entry, name: str) -> dict[tuple[str, int], Trajectory]:
    """By (scene's digest, seed). A failed run is charged the longest fit of its group, as nobody knows its own."""
    found = {(r.digests.scene, r.seed): trajectory(r, name, group.longest_fit_seconds) for r in entry.results}
    return {key: run for key, run in found.items() if run is not None}


def before(group: Group, name: str) -> dict[str, float]:
    """What the control `nothing` has of metric `name`, by the scene's digest: the mean of its runs."""
    values: dict[str, list[float]] = {}
    for result in group.backgrounds:
        value = result.value(name)
        if value is not None:
            values.setdefault(result.digests.scene, []).append(value)
    return {scene: float(np.mean(found)) for scene, found in values.items()}


def value_at(
    runs: Mapping[tuple[str, int], Trajectory], seconds: float, nothing: Mapping[str, float]
) -> dict[tuple[str, int], float]:
    """The value of every run after `seconds`; NaN where it has none and `nothing` was not run."""
    return {key: run.at(seconds, nothing.get(key[0], float("nan"))) for key, run in runs.items()}


def by_scene(values: Mapping[tuple[str, int], float]) -> list[NDArray[np.float64]]:
    """`values` by (scene, seed), as arrays by scene."""
    ordered = sorted(values.items())
    return [
        np.array([value for _, value in part]) for _, part in itertools.groupby(ordered, key=lambda item: item[0][0])
    ]


@dataclass(frozen=True)
class Curve:
    """Inter-quartile mean over runs at `seconds`, with its interval's ends; from where every run has a value."""

    label: str
    seconds: tuple[float, ...]
    estimates: tuple[Estimate, ...]
    runs: int
    scenes: int


def grid(group: Group) -> NDArray[np.float64]:
    """Seconds at which curves are drawn: four per doubling, over all fits of the group."""
    ends = [value for e in group.entries for r in e.results if (value := r.value("fit_seconds"))]
    starts = [c.seconds for e in group.entries for r in e.results for c in r.checkpoints]
    if not ends:
        return np.zeros(0)
    low, high = max(min([*starts, *ends]), 1e-3), max(ends)
    count = int(np.ceil(np.log2(high / low) * _PER_OCTAVE)) + 1 if high > low else 1
    return np.geomspace(low, high, count)


def foremost(group: Group, name: str, most: int = MAX_DRAWN) -> list[Entry]:
    """The `most` entries with the best mean of metric `name` over their runs, in the group's order; all, where fewer.

    It bounds what grows with the square of the entries, or is drawn for each.
    """
    if len(group.entries) <= most:
        return group.entries
    sign = -1.0 if METRICS[name].better == "higher" else 1.0

    def place(entry: Entry) -> tuple[float, str]:
        values = [value for result in entry.results if (value := result.value(name)) is not None]
        return (sign * float(np.mean(values)) if values else float("inf"), entry.label)

    chosen = {id(entry) for entry in sorted(group.entries, key=place)[:most]}
    return [entry for entry in group.entries if id(entry) in chosen]


def curves(group: Group, name: str) -> list[Curve]:
    """A curve per entry that has metric `name`, of the `foremost` ones."""
    nothing, steps, found = before(group, name), grid(group), []
    for entry in foremost(group, name):
        runs = trajectories(group, entry, name)
        # Of an entry that lacks the figure in some runs the rest would be over other scenes.
        if len(runs) < len(entry.results) or not any(run.seconds for run in runs.values()):
            continue
        last = max(run.spent() for run in runs.values())
        points = []
        for seconds in [*steps[steps < last].tolist(), last]:
            values = value_at(runs, seconds, nothing)
            if np.isfinite(list(values.values())).all():
                points.append((seconds, estimate(by_scene(values))))
        if points:
            times, estimates = zip(*points)
            found.append(Curve(entry.label, times, estimates, len(runs), len({scene for scene, _ in runs})))
    return found


@dataclass(frozen=True)
class Standing:
    """Who leads after `seconds`: the best entries, each with its estimate, and the first against the second."""

    seconds: float
    ranking: tuple[tuple[str, Estimate], ...]
    lead: Comparison | None


def standings(group: Group, name: str, budgets: Sequence[float] = BUDGETS) -> list[Standing]:
    """Rankings after each of `budgets`. An entry that lacks the figure in some run is left out."""
    higher = METRICS[name].better == "higher"
    nothing = before(group, name)
    runs = {entry.label: trajectories(group, entry, name) for entry in group.entries}
    runs = {entry.label: runs[entry.label] for entry in group.entries if len(runs[entry.label]) == len(entry.results)}
    found = []
    for seconds in budgets:
        values = {label: value_at(of, seconds, nothing) for label, of in runs.items() if of}
        values = {label: of for label, of in values.items() if np.isfinite(list(of.values())).all()}
        started = {label for label in values if any(run.at(seconds) == run.at(seconds) for run in runs[label].values())}
        ranking = sorted(
            ((label, estimate(by_scene(values[label]))) for label in sorted(started)),
            key=lambda item: -item[1].value if higher else item[1].value,
        )
        lead = compare(ranking[0][0], ranking[1][0], values, higher) if len(ranking) > 1 else None
        found.append(Standing(seconds, tuple(ranking), lead))
    return found


@dataclass(frozen=True)
class Chase:
    """How long `label` takes to the final value of `target`, in shares of that one's own fit time.

    ratio: median over scenes; infinite where half of them are never reached. reached: of `runs`, over all scenes.
    """

    label: str
    target: str
    ratio: float
    reached: int
    runs: int


def chases(group: Group, name: str) -> list[Chase]:
    """Each of the `foremost` entries after every other one's final value, by scene and expected running time."""
    higher = METRICS[name].better == "higher"
    runs = {entry.label: trajectories(group, entry, name) for entry in foremost(group, name)}
    found = []
    for target, label in itertools.permutations(runs, 2):
        ratios, reached, total = [], 0, 0
        scenes = {scene for scene, _ in runs[target]} & {scene for scene, _ in runs[label]}
        for scene in sorted(scenes):
            theirs = [run for (where, _), run in runs[target].items() if where == scene and run.values]
            own = [run for (where, _), run in runs[label].items() if where == scene]
            if not theirs:
                continue
            value = float(np.mean([run.values[-1] for run in theirs]))
            seconds = float(np.mean([run.seconds[-1] for run in theirs]))
            ratios.append(expected_running_time(own, value, higher) / seconds)
            reached += sum(run.reaches(value, higher) is not None for run in own)
            total += len(own)
        if ratios:
            found.append(Chase(label, target, float(np.median(ratios)), reached, total))
    return found


def hypervolumes(group: Group) -> dict[str, Estimate]:
    """Inter-quartile mean over runs of the hypervolume by time, LPIPS and bytes of all states of a run, by entry.

    Each dimension is scaled from `IDEAL` (0) to `WORST` (1), time and bytes by their logarithms. A failed run has 0.
    Entries without LPIPS or bytes are left out.
    """
    found = {}
    for entry in group.entries:
        values: dict[tuple[str, int], float] = {}
        for result in entry.results:
            volume = _hypervolume(result)
            if volume is not None:
                values[result.digests.scene, result.seed] = volume
        if len(values) == len(entry.results):
            found[entry.label] = estimate(by_scene(values))
    return found


def _hypervolume(result: Result) -> float | None:
    if result.status != "ok":
        return 0.0
    end = (result.value("fit_seconds"), result.value("lpips"), result.value("storage_bytes"))
    if None in end:
        return None
    states = [(c.seconds, c.metrics.get("lpips"), c.storage_bytes) for c in result.checkpoints]
    points = np.array([state for state in [*states, end] if None not in state], dtype=np.float64)
    points[:, [0, 2]] = np.log2(np.maximum(points[:, [0, 2]], 1e-9) / [60.0, 1e6])
    ideal = np.array([np.log2(IDEAL[0]), IDEAL[1], np.log2(IDEAL[2])])
    worst = np.array([np.log2(WORST[0]), WORST[1], np.log2(WORST[2])])
    return hypervolume((points - ideal) / (worst - ideal))
