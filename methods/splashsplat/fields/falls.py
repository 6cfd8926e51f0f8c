"""How fast a jet falls by its ends: its first drop and its last fall as any stone does. Not in the paper.

Where gravity is known, a jet's shape tells its speed. Where nobody told the scale of the scene, the strength of gravity
is not known either, and shape tells the ratio of both alone: a jet that bends and thins alike may be slow where gravity
is weak, or fast where it is strong. How long it takes for its ends to fall through what is seen says which.

Heights in scene units, times in seconds.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

# Of fewer slices nothing is taken for a jet.
SLICES_AT_LEAST = 8
# Standard deviation of the height of a tip or tail, voxels.
_END = 2.0
# Nothing that falls freely slows down to this share of its speed: the end is another drop's then.
_SLOWED = 0.7
# What an error costs at the most: three standard deviations.
MOST = 9.0
# Free falls through all that is seen that are tried: how many, and how long they last, from this share of the shortest
# step between frames to this one of all frames.
_LASTED, _SHORTEST, _LONGEST = 64, 0.5, 1.0
# Falls explain as much as others to within two standard deviations. Where all of these last equally long to this
# factor, it is known how long a fall lasts.
_AS_MUCH, _KNOWN = 4.0, 2.5


@dataclass(frozen=True)
class FreeFall:
    """Of liquid that passes the height `top` at `speed` downwards. gravity: scene units / s^2."""

    top: float
    speed: float
    gravity: float

    def down(self, height: np.ndarray) -> np.ndarray:
        """Speed downwards at `height` [...]; 0 where it does not rise so high."""
        return np.asarray(np.sqrt(np.maximum(self.speed**2 + 2 * self.gravity * (self.top - height), 0)))

    def lasted(self, height: np.ndarray) -> np.ndarray:
        """Seconds from the top down to `height` [...], negative above it."""
        return np.asarray((self.down(height) - self.speed) / self.gravity)

    def faster(self, factor: float) -> FreeFall:
        """The one `factor` times as fast that has the same shape."""
        return FreeFall(self.top, factor * self.speed, factor**2 * self.gravity)


@dataclass(frozen=True, eq=False)
class Ends:
    """Runs of (time, height) of a jet's first drop, and of its last, while both are in the air: each [n, 2], n >= 2."""

    runs: list[np.ndarray]
    voxel: float

    @classmethod
    def of(
        cls,
        heights: Sequence[np.ndarray],
        times: np.ndarray,
        voxel: float,
        top: float,
        bottom: float,
        lowest: Sequence[float] | None = None,
    ) -> Ends:
        """heights: of the slices of each frame, ascending, which lie between `bottom` and `top`. lowest: of all liquid
        in each frame, infinite for none, where it is seen down to the ground; without it first drops are followed down
        to `bottom`.

        Before the first drop there is no jet, and none after the last: what else goes up and down are masks."""
        ground = bottom if lowest is None else min(lowest)
        first = [_end(height, 0) for height in heights] if lowest is None else lowest
        last = [_end(height, -1) for height in heights]
        # Also before the first frame, and after the last.
        none = [True, *(len(height) < SLICES_AT_LEAST for height in heights), True]
        runs = [run for start, run in _runs(first, times, voxel, ground, top) if none[start]]
        runs += [run for start, run in _runs(last, times, voxel, bottom, top) if none[start + len(run) + 1]]
        return cls(runs, voxel)

    def misfit(self, fall: FreeFall) -> float:
        """Squared errors of the ends' fall, over _END voxels; each run starts when it likes."""
        return float(self.misfits(fall.top, np.array([fall.speed]), np.array([fall.gravity]))[0])

    def misfits(self, top: float, speed: np.ndarray, gravity: np.ndarray) -> np.ndarray:
        """`misfit` of the falls that pass `top` at each `speed` [F] where `gravity` [F] is so strong: [F]."""
        cost = np.zeros(len(speed))
        v, g = speed[:, None], gravity[:, None]
        for run in self.runs:
            fallen = (np.sqrt(np.maximum(v**2 + 2 * g * (top - run[:, 1]), 0)) - v) / g
            lasted = np.maximum(run[:, 0] - np.median(run[:, 0] - fallen, axis=1, keepdims=True), 0)
            error = (top - v * lasted - 0.5 * g * lasted**2 - run[:, 1]) / (_END * self.voxel)
            cost += np.minimum(error**2, MOST).sum(axis=1)
        return cost


def _end(heights: np.ndarray, which: int) -> float:
    return float(heights[which]) if len(heights) else np.nan


def _runs(
    ends: Sequence[float], times: np.ndarray, voxel: float, bottom: float, top: float
) -> Iterator[tuple[int, np.ndarray]]:
    """Runs of `ends`, a height a frame, that fall freely from `top` to `bottom`, and each one's first frame."""
    run: list[tuple[float, float]] = []
    speed = 0.0
    for number, (end, time) in enumerate(zip([*ends, np.nan], [*times, np.nan])):
        free = bottom + 2 * voxel < end < top - 2 * voxel
        now = (run[-1][1] - end) / (time - run[-1][0]) if run and free else 0.0
        if run and not (free and end < run[-1][1] - voxel and now > _SLOWED * speed):
            if len(run) >= 2:
                yield number - len(run), np.array(run)
            run, now = [], 0.0
        if free:
            run.append((float(time), float(end)))
            speed = now


@dataclass(frozen=True, eq=False)
class Unscaled:
    """Falls through all that is seen where gravity is not known, of S shapes and L durations each.

    top: their height. shape: [S], gravity over the square of the speed at the top, 1 / scene units. lasts: [S], seconds
    for which each would last at a speed of 1. duration: [L], seconds, ascending. cost: [S, L], how badly they explain
    shape and ends.
    """

    top: float
    shape: np.ndarray
    lasts: np.ndarray
    duration: np.ndarray
    cost: np.ndarray

    @classmethod
    def of(
        cls, shape: np.ndarray, cost: np.ndarray, ends: Ends, times: np.ndarray, top: float, bottom: float
    ) -> Unscaled:
        """cost: [S], how badly each `shape` explains what a jet looks like, which falls from `top` to `bottom`."""
        duration = np.geomspace(_SHORTEST * np.diff(times).min(), _LONGEST * (times[-1] - times[0]), _LASTED)
        lasts = np.array([float(FreeFall(top, 1.0, float(one)).lasted(np.array(bottom))) for one in shape])
        speed = lasts[:, None] / duration
        fallen = ends.misfits(top, speed.ravel(), (shape[:, None] * speed**2).ravel())
        return cls(top, shape, lasts, duration, cost[:, None] + fallen.reshape(speed.shape))

    @property
    def known(self) -> bool:
        """Whether the ends tell how long a fall lasts."""
        best = self.cost.min(axis=0)
        as_good = np.flatnonzero(best < best.min() + _AS_MUCH)
        shortest, longest = as_good[0], as_good[-1]
        within = shortest > 0 and longest < len(self.duration) - 1
        return bool(within and self.duration[longest] <= _KNOWN * self.duration[shortest])

    def best(self) -> FreeFall:
        """The fall that explains most."""
        return self._fall(int(self.cost.argmin()))

    def as_good(self) -> list[FreeFall]:
        """Those that explain as much."""
        return [self._fall(int(n)) for n in np.flatnonzero(self.cost < self.cost.min() + _AS_MUCH)]

    def _fall(self, number: int) -> FreeFall:
        shape, duration = divmod(number, len(self.duration))
        faster = float(self.lasts[shape] / self.duration[duration])
        return FreeFall(self.top, 1.0, float(self.shape[shape])).faster(faster)
