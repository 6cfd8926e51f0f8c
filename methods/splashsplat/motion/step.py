"""What moves the liquid between two frames: free fall in the jet, the fitted velocity elsewhere.

The level-set fit (velocity.py) sees the hull's surface only. In a steady jet nothing of that surface moves, but its
liquid falls (ballistic.py). Which of the two a carrier follows is told where the carrier is, not on the coarse control
grid: a jet's speed would spread from there to what splashes beside its foot. The paper uses the fit everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splashbench.observe.grid import Grid

from ..carriers.transport import clamp_stretch, forecast
from .ballistic import Jet
from .velocity import velocities_at

# Liquid so near to a jet's side (voxels) is the jet's: its radius is not known any better.
_MARGIN = 1.0
# Columns of `Motion.table`.
_COLUMNS = 9


@dataclass(frozen=True)
class Fall:
    """How the jet falls during one step.

    floor: height down to which it flies freely, scene units. turn: [3, 3] scene axes to upright ones. grid: whose
    coordinates positions are given in. seconds: that the step lasts.
    """

    jet: Jet
    floor: float
    turn: np.ndarray
    grid: Grid
    seconds: float

    def holds(self, positions: np.ndarray) -> np.ndarray:
        """Which of `positions` [N, 3] are in the jet: bool [N]."""
        points = self._upright(positions)
        return (self.jet.distance(points) < _MARGIN * self.grid.voxel) & (points[:, 2] > self.floor)

    def velocity(self, positions: np.ndarray) -> np.ndarray:
        """Of the jet's liquid at `positions` [N, 3]: voxels per frame, float64 [N, 3]."""
        per_second = self.jet.velocity(self._upright(positions)[:, 2])
        return per_second @ self.turn * (self.seconds / self.grid.voxel)

    def moved(self, positions: np.ndarray, duration: float) -> np.ndarray:
        """Where carriers [N, 3] in the jet are after `duration` frames on their parabola: float32 [N, 3]."""
        seconds = duration * self.seconds
        way = self.jet.velocity(self._upright(positions)[:, 2]) * seconds
        way[:, 2] -= 0.5 * self.jet.gravity * seconds**2
        return (positions + way @ self.turn / self.grid.voxel).astype(np.float32)

    def deformed(self, positions: np.ndarray, deformation: np.ndarray, duration: float) -> np.ndarray:
        """F [N, 3, 3] then, of carriers that start at `positions` with F `deformation`."""
        # Of the velocity's gradient, only how the speed grows on the way down is not zero.
        growth = self.jet.growth(self._upright(positions)[:, 2]) * (duration * self.seconds)
        return clamp_stretch(deformation + np.einsum("n,a,b->nab", growth, self.turn[2], self.turn[2]) @ deformation)

    def _upright(self, positions: np.ndarray) -> np.ndarray:
        return self.grid.to_scene(positions) @ self.turn.T


@dataclass(frozen=True)
class Step:
    """Between two frames. control: float32 [cx, cy, cz, 3], u_t in voxels per frame on a grid that is `factor` times
    coarser than the transport grid; fall: of the jet, None without one."""

    control: np.ndarray
    factor: int
    fall: Fall | None = None

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
        """Where carriers [N, 3] with F [N, 3, 3] are after `duration` frames, and their F then; see transport.py.

        A carrier falls if half way it is still in the jet: one that would land before is carried by what moves there.
        """
        moved, deformed = forecast(self.control, self.factor, positions, deformation, duration)
        if self.fall is not None:
            falls = np.flatnonzero(self.fall.holds(positions))
            falls = falls[self.fall.holds(self.fall.moved(positions[falls], 0.5 * duration))]
            moved[falls] = self.fall.moved(positions[falls], duration)
            deformed[falls] = self.fall.deformed(positions[falls], deformation[falls], duration)
        return moved, deformed


@dataclass(frozen=True)
class Motion:
    """All steps of a sequence.

    velocities: [T - 1, cx, cy, cz, 3], voxels per frame, on a grid that is `factor` times coarser than the transport
    grid. falls: of the jet in each step, None without one.
    """

    velocities: np.ndarray
    factor: int
    falls: Sequence[Fall | None]

    def step(self, t: int) -> Step:
        """From frame `t` to the next."""
        return Step(self.velocities[t].astype(np.float32, copy=False), self.factor, self.falls[t])

    def half(self) -> Motion:
        """In the precision of the files."""
        return replace(self, velocities=self.velocities.astype(np.float16))

    def table(self) -> tuple[np.ndarray, np.ndarray]:
        """The falls as numbers: float64 [T - 1, 9], zeros without a jet, and what turns scene axes upright, [3, 3].

        A row has the jet's top, middle (2), drift (2), speed, gravity and radius, and the floor: scene units, seconds.
        """
        rows = np.zeros((len(self.falls), _COLUMNS))
        turn = np.eye(3)
        for row, fall in zip(rows, self.falls):
            if fall is not None:
                jet, turn = fall.jet, fall.turn
                row[:] = [jet.top, *jet.middle, *jet.drift, jet.speed, jet.gravity, jet.radius, fall.floor]
        return rows, turn


def falls_of(rows: np.ndarray, turn: np.ndarray, grid: Grid, times: np.ndarray) -> list[Fall | None]:
    """What `Motion.table` made its numbers of; times: [T] of the frames, seconds.

    Raises ValueError where they are no such numbers.
    """
    if rows.shape != (max(len(times) - 1, 0), _COLUMNS) or turn.shape != (3, 3):
        raise ValueError(f"jets of shape {rows.shape} do not fit {len(times)} frames")
    falls: list[Fall | None] = []
    for row, seconds in zip(rows, np.diff(times)):
        top, speed, gravity, radius, floor = (float(row[n]) for n in (0, 5, 6, 7, 8))
        if speed == 0:
            falls.append(None)
        elif min(speed, gravity, radius) <= 0:
            raise ValueError("a jet's speed, gravity and radius are not positive")
        else:
            jet = Jet(top, row[1:3], row[3:5], speed, gravity, radius)
            falls.append(Fall(jet, floor, turn, grid, float(seconds)))
    return falls
