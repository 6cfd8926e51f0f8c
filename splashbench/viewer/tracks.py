"""Particles as they are shown: those of each timestep, with what they are coloured by.

A method's particles are a row each over the whole recording, most of them absent most of the time: hundreds of
megabytes. What is kept here is a tenth of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Particles

#: What particles may be coloured by.
MEASURES = ("speed", "age", "height")


@dataclass(frozen=True)
class Tracks:
    """The particles of T timesteps.

    Attributes:
        positions: of each timestep float32 [n, 3], scene units.
        velocities: of each timestep float32 [n, 3], scene units per second; NaN where they are not known.
        ages: of each timestep float32 [n], seconds since the particle appeared.
        followed: whether any row is the same particle in two timesteps: else there is no age, and no speed but the
            method's own.
        left_out: the share of particles that are not among them, to save work.
    """

    positions: list[NDArray[np.float32]]
    velocities: list[NDArray[np.float32]]
    ages: list[NDArray[np.float32]]
    followed: bool
    left_out: float = 0.0
    _ranges: dict[str, tuple[float, float]] = field(default_factory=dict, compare=False)

    @classmethod
    def of(cls, particles: Particles, times: NDArray[np.float64], most: int) -> Tracks:
        """Those of `particles`, which has a timestep for each of `times` (seconds).

        most: particles of a timestep, at the most. Rows are left out evenly, the same ones throughout.
        """
        active = particles.active
        count = int(active.sum(axis=1).max()) if active.size else 0
        rows = slice(None, None, max(1, -(-count // most)))
        kept = Particles(
            particles.positions[:, rows],
            active[:, rows],
            None if particles.velocities is None else particles.velocities[:, rows],
        )
        total, shown = int(active.sum()), int(kept.active.sum())
        positions, velocities, ages = [], [], []
        born = np.zeros(kept.active.shape[1])
        before = np.zeros(kept.active.shape[1], bool)
        for t in range(len(times)):
            here = kept.active[t]
            born[here & ~before] = times[t]
            positions.append(kept.positions[t][here])
            ages.append((times[t] - born[here]).astype(np.float32))
            velocities.append(_velocities(kept, times, t)[here])
            before = here
        followed = bool((kept.active[1:] & kept.active[:-1]).any())
        return cls(positions, velocities, ages, followed, 1 - shown / total if total else 0.0)

    def has(self, measure: str) -> bool:
        """Whether `measure`, one of MEASURES, is known of any particle."""
        if measure == "speed":
            return any(np.isfinite(velocities).any() for velocities in self.velocities)
        return measure != "age" or self.followed

    def values(self, measure: str, t: int, up: NDArray[np.float64]) -> NDArray[np.float32]:
        """`measure` of timestep `t`, float32 [n], NaN where it is not known: scene units per second, seconds, or scene
        units along `up` [3] from the world's origin."""
        if measure == "speed":
            return np.linalg.norm(self.velocities[t], axis=1).astype(np.float32)
        if measure == "age":
            return self.ages[t] if self.followed else np.full(len(self.ages[t]), np.nan, np.float32)
        return (self.positions[t] @ np.asarray(up)).astype(np.float32)

    def span(self, measure: str, up: NDArray[np.float64]) -> tuple[float, float]:
        """What the ends of the colours stand for at every time: 2nd and 95th percentile; for speeds and ages from 0."""
        if measure not in self._ranges:
            values = np.concatenate([self.values(measure, t, up) for t in range(len(self.positions))])
            values = values[np.isfinite(values)]
            low, high = (float(v) for v in np.percentile(values, [2, 95])) if len(values) else (0.0, 1.0)
            self._ranges[measure] = (0.0 if measure != "height" else low, high if high > low else low + 1.0)
        return self._ranges[measure]


def _velocities(particles: Particles, times: NDArray[np.float64], t: int) -> NDArray[np.float32]:
    """[N, 3] at timestep `t`: the method's own, else by the same row in the timesteps before and after."""
    if particles.velocities is not None:
        return particles.velocities[t]
    velocities = np.full(particles.positions.shape[1:], np.nan, np.float32)
    last = len(times) - 1
    for first, second in ((t, min(t + 1, last)), (max(t - 1, 0), t), (max(t - 1, 0), min(t + 1, last))):
        # The last pair, over both neighbours, is the most exact: it is taken where there are both.
        if first == second:
            continue
        both = particles.active[first] & particles.active[t] & particles.active[second]
        moved = particles.positions[second][both] - particles.positions[first][both]
        velocities[both] = moved / np.float32(times[second] - times[first])
    return velocities
