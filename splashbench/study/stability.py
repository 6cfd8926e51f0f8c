"""Stability: what a method keeps of its quality where the recording is worse (docs/study.md).

A run's retention is its gain over the control `nothing` as a share of the gain of the same method, scene and seed on
the recording as it is, between 0 and 1. A run that failed keeps nothing, and neither does a method that gains nothing
to begin with. Failures are part of every figure here; none is left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression

from splashbench.statistics import LEAST_RUNS, SAMPLES, Estimate, estimate, interquartile_mean, resampled

#: Below this retention a run counts as broken.
BROKEN = 0.5
#: Of all runs, the worst ones that CVaR10 is the mean of.
WORST = 0.1


@dataclass(frozen=True)
class StressRun:
    """One run. level: 0 on the recording as it is, else the severity from 1 on. value: of the metric; None: it failed,
    or has none."""

    method: str
    scene: str
    seed: int
    kind: str
    level: int
    value: float | None


@dataclass(frozen=True)
class Stability:
    """score: S, the interquartile mean of retentions; worst: CVaR10, the mean of the worst tenth, since S hides
    failures. runs, failed: how many there are, and how many of them have no value. resampled: what intervals resample,
    "recordings" or "kinds"; see `stability`."""

    score: Estimate
    worst: Estimate
    runs: int
    failed: int
    resampled: str


@dataclass(frozen=True)
class Breakdown:
    """Where retention falls through BROKEN, in the unit of the perturbation; None where it does not within `amounts`.

    amounts: of the recording as it is and of each severity. retentions: the mean over scenes and seeds at each, and
    fitted: the same as a curve that never rises. interval: 95 %, by resampling scenes and seeds; an end is None where
    it lies beyond the last amount, and both where recordings are fewer than LEAST_RUNS.
    """

    amounts: tuple[float, ...]
    retentions: tuple[float, ...]
    fitted: tuple[float, ...]
    point: float | None
    interval: tuple[float | None, float | None]


def retentions(
    runs: Sequence[StressRun], nothing: Mapping[tuple[str, int], float], higher_is_better: bool
) -> dict[StressRun, float]:
    """The retention of every run of `runs` with a level above 0. nothing: the control's value by scene and seed.

    Raises KeyError where a run has no control, or none on the recording as it is.
    """
    sign = 1.0 if higher_is_better else -1.0
    unharmed = {(run.method, run.scene, run.seed): run.value for run in runs if run.level == 0}
    found = {}
    for run in runs:
        if run.level == 0:
            continue
        floor, whole = nothing[run.scene, run.seed], unharmed[run.method, run.scene, run.seed]
        gain = None if whole is None else sign * (whole - floor)
        if run.value is None or gain is None or not gain > 0:
            found[run] = 0.0
        else:
            found[run] = min(max(sign * (run.value - floor) / gain, 0.0), 1.0)
    return found


def worst_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the lowest WORST of `values` [..., n], NaN left out, one at least: [...]."""
    ordered = np.sort(values, axis=-1)  # NaN comes last
    count = np.isfinite(ordered).sum(axis=-1, keepdims=True)
    taken = np.arange(values.shape[-1]) < np.maximum(np.ceil(WORST * count - 1e-9), 1)
    return np.asarray(np.nanmean(np.where(taken, ordered, np.nan), axis=-1))


def stability(found: Mapping[StressRun, float]) -> Stability:
    """S and CVaR10 of the retentions `found`, of one method.

    A recording (a scene with a seed) is one draw, with all the harm that was done to it: intervals resample scenes,
    then seeds, from LEAST_RUNS recordings on. Fewer say nothing of other recordings. Intervals then resample kinds of
    harm, from as many kinds on, each with all of its runs: they say how much depends on which kinds were tried.
    """
    recordings: dict[str, dict[int, list[float]]] = {}
    kinds: dict[str, list[float]] = {}
    for run, value in found.items():
        recordings.setdefault(run.scene, {}).setdefault(run.seed, []).append(value)
        kinds.setdefault(run.kind, []).append(value)
    by_recording = [list(seeds.values()) for seeds in recordings.values()]
    enough = sum(map(len, by_recording)) >= LEAST_RUNS
    units = by_recording if enough else [[values] for values in kinds.values()]
    length = max(len(values) for scene in units for values in scene)
    tables = [np.array([values + [math.nan] * (length - len(values)) for values in scene]) for scene in units]
    return Stability(
        estimate(tables, interquartile_mean),
        estimate(tables, worst_mean),
        len(found),
        sum(run.value is None for run in found),
        "recordings" if enough else "kinds",
    )


def breakdown(found: Mapping[StressRun, float], kind: str, amounts: Sequence[float]) -> Breakdown:
    """Where one method breaks under `kind`. amounts: of the recording as it is, and of each severity in turn.

    The curve is the isotonic regression of mean retentions, which is 1 where nothing is wrong; it is read linearly
    between amounts. What a scene and seed keeps at a severity that was not run is read between those that were, and
    beyond the last of them it is that one's: a budget runs low severities where a method broke and high ones where it
    held, so that means of the runs alone would be over other recordings at each.
    """
    levels = len(amounts) - 1
    of_kind = {run: value for run, value in found.items() if run.kind == kind}
    # Of each scene, seeds by levels.
    tables = []
    for scene in sorted({run.scene for run in of_kind}):
        seeds = sorted({run.seed for run in of_kind if run.scene == scene})
        table = np.full((len(seeds), levels), np.nan)
        for run, value in of_kind.items():
            if run.scene == scene:
                table[seeds.index(run.seed), run.level - 1] = value
        tables.append(np.apply_along_axis(_without_gaps, 1, table))
    means = np.concatenate(tables).mean(axis=0)
    curve = _falling(means)
    point = _crossing(amounts, curve)
    # The same resampling for every level: scenes, then seeds.
    drawn = np.stack([resampled([table[:, level] for table in tables]) for level in range(levels)])
    samples = np.nanmean(drawn, axis=-1)
    ends: tuple[float | None, float | None] = (None, None)
    if sum(len(table) for table in tables) >= LEAST_RUNS:
        points = [_crossing(amounts, _falling(samples[:, n])) for n in range(SAMPLES)]
        far = math.inf if amounts[-1] > amounts[0] else -math.inf
        low, high = np.quantile([far if p is None else p for p in points], [0.025, 0.975], method="closest_observation")
        ends = tuple(None if math.isinf(end) else float(end) for end in (low, high))  # type: ignore[assignment]
    whole = (1.0, *means.tolist())
    return Breakdown(tuple(amounts), whole, (1.0, *curve.tolist()), point, ends)


def _without_gaps(kept: NDArray[np.float64]) -> NDArray[np.float64]:
    """Retentions by level with NaN read between the others, of which there is one; level 0 keeps 1."""
    known = np.flatnonzero(np.isfinite(kept))
    return np.interp(np.arange(1, len(kept) + 1), [0, *(known + 1)], [1.0, *kept[known]])


def _falling(means: NDArray[np.float64]) -> NDArray[np.float64]:
    """The curve nearest to `means` that never rises and is nowhere above 1."""
    return np.asarray(np.minimum(isotonic_regression(means, increasing=False).x, 1.0))


def _crossing(amounts: Sequence[float], curve: NDArray[np.float64]) -> float | None:
    """Where `curve`, which begins at 1 with the first of `amounts`, falls below BROKEN."""
    before, high = amounts[0], 1.0
    for amount, low in zip(amounts[1:], curve):
        if low < BROKEN:
            return float(before + (amount - before) * (high - BROKEN) / (high - low))
        before, high = amount, float(low)
    return None
