"""What moves the liquid between two frames: free fall in the jet, the fitted velocity elsewhere.

The level-set fit (velocity.py) sees the hull's surface only. In a steady jet nothing of that surface moves, but its
liquid falls (fall.py). The place of a carrier decides which of the two it follows. The coarse control grid could not:
a jet's speed would spread from there to what splashes beside its foot. The paper uses the fit everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .advection import forecast, moved
from .fall import JetFall
from .velocity import Factor, velocities_at


@dataclass(frozen=True)
class FrameStep:
    """Between two frames. control: float32 [cx, cy, cz, 3], u_t in voxels per frame on a grid that is `factor` times
    coarser than the transport grid; fall: of the jet, None without one."""

    control: np.ndarray
    factor: Factor
    fall: JetFall | None = None

    def velocity(self, positions: np.ndarray) -> np.ndarray:
        """At transport-grid `positions` [N, 3]: voxels per frame, float64 [N, 3]."""
        velocities = velocities_at(self.control, self.factor, positions)
        if self.fall is not None:
            falls = self.fall.holds(positions)
            velocities[falls] = self.fall.velocity(positions[falls])
        return velocities

    def forecast(
        self, positions: np.ndarray, deformation: np.ndarray, duration: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Where carriers [N, 3] with F [N, 3, 3] are after `duration` frames, and their F then; see advection.py.

        A carrier falls if half way it is still in the jet: one that would land before is carried by what moves there.
        """
        ends, deformed = forecast(self.control, self.factor, positions, deformation, duration)
        if self.fall is not None:
            falls = self.falling(positions, duration)
            ends[falls] = self.fall.moved(positions[falls], duration)
            deformed[falls] = self.fall.deformed(positions[falls], deformation[falls], duration)
        return ends, deformed

    def moved(self, positions: np.ndarray, duration: float = 1.0) -> np.ndarray:
        """The places that `forecast` gives, without F."""
        ends = moved(self.control, self.factor, positions, duration)
        if self.fall is not None:
            falls = self.falling(positions, duration)
            ends[falls] = self.fall.moved(positions[falls], duration)
        return ends

    def falling(self, positions: np.ndarray, duration: float) -> np.ndarray:
        """Numbers of the carriers at `positions` [N, 3] that fall in the jet for `duration` frames, int64."""
        if self.fall is None:
            return np.zeros(0, dtype=np.int64)
        falls = np.flatnonzero(self.fall.holds(positions))
        return falls[self.fall.holds(self.fall.moved(positions[falls], 0.5 * duration))]


@dataclass(frozen=True)
class Motion:
    """All steps of a sequence.

    velocities: [T - 1, cx, cy, cz, 3], voxels per frame, on a grid that is `factor` times coarser than the transport
    grid. falls: of the jet in each step, None without one.
    """

    velocities: np.ndarray
    factor: Factor
    falls: Sequence[JetFall | None]

    @classmethod
    def of(cls, steps: Sequence[FrameStep], shape: tuple[int, int, int], factor: Factor) -> Motion:
        """The motion of `steps`, on a control grid of `shape`."""
        velocities = np.stack([step.control for step in steps]) if steps else np.zeros((0, *shape, 3), np.float32)
        return cls(velocities, factor, [step.fall for step in steps])

    def step(self, t: int) -> FrameStep:
        """From frame `t` to the next."""
        return FrameStep(self.velocities[t].astype(np.float32, copy=False), self.factor, self.falls[t])
