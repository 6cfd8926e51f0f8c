"""Free fall of the jet during one step between two frames. Not in the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splashbench.observe.grid import Grid

from ..fields.jet import Jet
from .advection import clamp_stretch

# Liquid so near to a jet's side (voxels) is the jet's: its radius is not known any better.
_MARGIN = 1.0
# Columns of `table_of`.
_COLUMNS = 9


@dataclass(frozen=True)
class JetFall:
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


def table_of(falls: Sequence[JetFall | None]) -> tuple[np.ndarray, np.ndarray]:
    """The falls as numbers: float64 [T - 1, 9], zeros without a jet, and what turns scene axes upright, [3, 3].

    A row has the jet's top, middle (2), drift (2), speed, gravity and radius, and the floor: scene units, seconds.
    """
    rows = np.zeros((len(falls), _COLUMNS))
    turn = np.eye(3)
    for row, fall in zip(rows, falls):
        if fall is not None:
            jet, turn = fall.jet, fall.turn
            row[:] = [jet.top, *jet.middle, *jet.drift, jet.speed, jet.gravity, jet.radius, fall.floor]
    return rows, turn


def falls_of(rows: np.ndarray, turn: np.ndarray, grid: Grid, times: np.ndarray) -> list[JetFall | None]:
    """What `table_of` made its numbers of; times: [T] of the frames, seconds.

    Raises ValueError where they are no such numbers.
    """
    if rows.shape != (max(len(times) - 1, 0), _COLUMNS) or turn.shape != (3, 3):
        raise ValueError(f"jets of shape {rows.shape} do not fit {len(times)} frames")
    falls: list[JetFall | None] = []
    for row, seconds in zip(rows, np.diff(times)):
        top, speed, gravity, radius, floor = (float(row[n]) for n in (0, 5, 6, 7, 8))
        if speed == 0:
            falls.append(None)
        elif min(speed, gravity, radius) <= 0:
            raise ValueError("a jet's speed, gravity and radius are not positive")
        else:
            jet = Jet(top, row[1:3], row[3:5], speed, gravity, radius)
            falls.append(JetFall(jet, floor, turn, grid, float(seconds)))
    return falls
