"""Statistics of runs: inter-quartile means with bootstrap intervals, paired comparisons, hypervolume, time to target.

docs/protocol.md, "Quality over time", defines each. Scenes are what a finding is to hold for, so they are resampled
first, then the seeds within each.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

#: Resamplings of an interval; fixed, as its bytes are to depend on the results alone.
SAMPLES = 2000
#: Fewer runs have no interval, and a comparison needs as many scenes: a bootstrap of less is far too narrow.
LEAST_RUNS = 5
_LEVEL = 95.0


#: Of values [..., n], among them NaN for none, to figures [...].
Statistic = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def interquartile_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the middle half of `values` [..., n], NaN left out: [...]. NaN where there are none.

    A quarter, rounded down, is left out at either end.
    """
    ordered = np.sort(values, axis=-1)  # NaN comes last
    count = np.isfinite(ordered).sum(axis=-1)
    cut = (0.25 * count).astype(int)
    place = np.arange(values.shape[-1])
    middle = (place >= cut[..., None]) & (place < (count - cut)[..., None])
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(middle, ordered, 0.0).sum(axis=-1) / np.where(count > 0, count - 2 * cut, np.nan))


def mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of `values` [..., n], NaN left out: [...]."""
    return np.asarray(np.nanmean(values, axis=-1))


@dataclass(frozen=True)
class Estimate:
    """A statistic of runs, and its 95% interval where there are runs enough."""

    value: float
    interval: tuple[float, float] | None = None

    def on(self, scale: Callable[[float], float]) -> Estimate:
        """The same on another, rising scale."""
        ends = self.interval and (scale(self.interval[0]), scale(self.interval[1]))
        return Estimate(scale(self.value), ends)


def resampled(by_scene: Sequence[NDArray[np.float64]], samples: int = SAMPLES) -> NDArray[np.float64]:
    """[samples, n]: stratified resamplings of runs, scenes with replacement, then seeds within each; NaN fills up.

    by_scene: per scene the values of its runs, [runs], or several of each that stay together, [runs, values].
    """
    runs = np.concatenate(list(by_scene))
    runs = np.concatenate([runs, np.full_like(runs[:1], np.nan)])
    drawn = runs[_draws(tuple(len(scene) for scene in by_scene), samples)]
    return np.asarray(drawn.reshape(samples, -1))


@lru_cache(maxsize=8)
def _draws(sizes: tuple[int, ...], samples: int) -> NDArray[np.int32]:
    """Indices of `resampled` into the runs of all scenes one after the other; -1 for none.

    Kept, as figures of one group have the same runs; few, as those of a thousand runs take 8 MB.
    """
    rng = np.random.default_rng(0)
    counts, starts = np.array(sizes), np.concatenate([[0], np.cumsum(sizes)[:-1]])
    scenes = rng.integers(len(sizes), size=(samples, len(sizes)))
    seeds = rng.random((samples, len(sizes), max(sizes)))
    count = counts[scenes][..., None]
    found = np.where(np.arange(max(sizes)) < count, starts[scenes][..., None] + (seeds * count).astype(int), -1)
    return np.asarray(found.reshape(samples, -1), dtype=np.int32)


def estimate(
    by_scene: Sequence[NDArray[np.float64]], statistic: Statistic = interquartile_mean, samples: int = SAMPLES
) -> Estimate:
    """`statistic` of all runs together, and its 95% percentile interval over stratified resamplings.

    by_scene: as for `resampled`. Of runs with several values NaN is one that a run does not have.
    """
    runs = np.concatenate(list(by_scene))
    value = float(statistic(runs.ravel()))
    known = np.isfinite(runs) if runs.ndim == 1 else np.isfinite(runs).any(axis=1)
    if len(runs) < LEAST_RUNS or not known.all():
        return Estimate(value)
    low, high = np.percentile(statistic(resampled(by_scene, samples)), [50 - _LEVEL / 2, 50 + _LEVEL / 2])
    return Estimate(value, (float(low), float(high)))


def hypervolume(costs: NDArray[np.float64]) -> float:
    """Volume of the part of the unit cube that some point of `costs` [n, d] dominates, less being better, in [0, 1].

    0 is ideal and 1 the reference in each dimension; what is beyond the reference dominates nothing. Computed by
    slices along the last dimension.
    """
    points = np.unique(np.maximum(costs, 0.0), axis=0)
    points = points[(points < 1).all(axis=1)]
    if not len(points):
        return 0.0
    if points.shape[1] == 1:
        return float(1 - points.min())
    heights = np.unique(points[:, -1])
    total = 0.0
    for low, high in itertools.zip_longest(heights, heights[1:], fillvalue=1.0):
        total += (high - low) * hypervolume(points[points[:, -1] <= low][:, :-1])
    return float(total)


@dataclass(frozen=True)
class Trajectory:
    """One run in the course of time: `seconds` [k] rising, and the `values` [k] that its states had then.

    The last one is the end of the fit. A run that failed has none and costs `failed_after` seconds.
    """

    seconds: tuple[float, ...]
    values: tuple[float, ...]
    failed_after: float | None = None

    def at(self, seconds: float, before: float = float("nan")) -> float:
        """The value of the last state of no more than `seconds`; `before` where there is none yet."""
        k = int(np.searchsorted(self.seconds, seconds, side="right"))
        return self.values[k - 1] if k else before

    def reaches(self, target: float, higher_is_better: bool) -> float | None:
        """Seconds of the first state that is at least as good as `target`, None where none is."""
        sign = 1.0 if higher_is_better else -1.0
        for seconds, value in zip(self.seconds, self.values):
            if sign * value >= sign * target:
                return seconds
        return None

    def spent(self) -> float:
        """Seconds that the run took, however it ended."""
        return self.seconds[-1] if self.seconds else (self.failed_after or 0.0)


def expected_running_time(runs: Sequence[Trajectory], target: float, higher_is_better: bool) -> float:
    """Seconds that reaching `target` takes on the average, if a run that misses it is started again.

    The time of all runs, until the target or their end, over the number of those that reach it; infinite where none
    does (Hansen et al. 2021, "COCO", Sec. 5.2). So failures are charged and not dropped.
    """
    hits = [run.reaches(target, higher_is_better) for run in runs]
    reached = [hit for hit in hits if hit is not None]
    if not reached:
        return float("inf")
    return (sum(reached) + sum(run.spent() for run, hit in zip(runs, hits) if hit is None)) / len(reached)


@dataclass(frozen=True)
class Comparison:
    """`first` against `second` on the scenes both have: mean difference (positive: first is better), and its interval.

    probability: share of resamplings of the scenes in which the first one is better; NaN where there are too few.
    """

    first: str
    second: str
    difference: Estimate
    probability: float
    scenes: int


def compare(
    first: str,
    second: str,
    values: Mapping[str, Mapping[tuple[str, int], float]],
    higher_is_better: bool,
    samples: int = SAMPLES,
) -> Comparison | None:
    """Paired by scene, of means over seeds. values: method to (scene, seed) to value. None without a common scene."""
    means = {name: _by_scene(values[name]) for name in (first, second)}
    common = sorted(means[first].keys() & means[second].keys())
    if not common:
        return None
    sign = 1.0 if higher_is_better else -1.0
    differences = [np.array([sign * (means[first][scene] - means[second][scene])]) for scene in common]
    found = estimate(differences, mean, samples)
    if found.interval is None:
        return Comparison(first, second, found, float("nan"), len(common))
    wins = mean(resampled(differences, samples)) > 0
    return Comparison(first, second, found, float(wins.mean()), len(common))


def _by_scene(values: Mapping[tuple[str, int], float]) -> dict[str, float]:
    """The mean over seeds of every scene."""
    found: dict[str, list[float]] = {}
    for (scene, _), value in values.items():
        found.setdefault(scene, []).append(value)
    return {scene: float(np.mean(of)) for scene, of in found.items()}
