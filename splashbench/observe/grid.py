"""A regular grid of nodes in scene units (paper, "Observation fields": hull grid and transport grid).

Fields live on the nodes. Several grids may share one origin and differ in spacing only: the hull grid is fine, the
transport grid coarser, the control grid of the velocity coarser still.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Bounds:
    """Axis-aligned box in scene units: `low` and `high` are float64 [3]."""

    low: np.ndarray
    high: np.ndarray

    @property
    def longest_side(self) -> float:
        return float((self.high - self.low).max())

    def joined(self, other: Bounds) -> Bounds:
        """The smallest box that holds both."""
        return Bounds(np.minimum(self.low, other.low), np.maximum(self.high, other.high))

    def padded(self, fraction: float) -> Bounds:
        """The box grown so that each side is `1 + fraction` times as long."""
        margin = 0.5 * fraction * (self.high - self.low)
        return Bounds(self.low - margin, self.high + margin)


@dataclass(frozen=True)
class Grid:
    """Nodes at `origin + voxel * (i, j, k)`, for `i, j, k` below `shape`; `origin` [3] and `voxel` in scene units."""

    origin: np.ndarray
    voxel: float
    shape: tuple[int, int, int]

    @classmethod
    def over(cls, bounds: Bounds, cells: int) -> Grid:
        """Cubic cells over `bounds`, `cells` of them along its longest side."""
        voxel = bounds.longest_side / cells
        # The last node must not fall short of the upper face, whatever the rounding.
        counts = np.ceil((bounds.high - bounds.low) / voxel - 1e-9).astype(int) + 1
        nx, ny, nz = (max(int(n), 2) for n in counts)
        return cls(np.asarray(bounds.low, dtype=np.float64), float(voxel), (nx, ny, nz))

    def to_voxels(self, points: np.ndarray) -> np.ndarray:
        """Scene units [..., 3] to (fractional) node coordinates [..., 3], float32."""
        return ((np.asarray(points, dtype=np.float64) - self.origin) / self.voxel).astype(np.float32)

    def to_scene(self, voxels: np.ndarray) -> np.ndarray:
        """Node coordinates [..., 3] to scene units [..., 3], float64."""
        return np.asarray(voxels, dtype=np.float64) * self.voxel + self.origin

    def corners(self) -> np.ndarray:
        """Positions of the outermost nodes, float64 [8, 3], scene units."""
        return self.to_scene(np.array(list(np.ndindex(2, 2, 2))) * (np.array(self.shape) - 1))

    def nodes(self) -> np.ndarray:
        """Positions of all nodes, float64 [nx, ny, nz, 3], scene units."""
        axes = [self.origin[a] + self.voxel * np.arange(self.shape[a]) for a in range(3)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
