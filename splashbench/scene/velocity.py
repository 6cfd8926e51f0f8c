"""A liquid's velocity at one instant, on a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass
class VelocityField:
    """Velocities at nodes `origin + spacing * (i, j, k)`.

    Attributes:
        values: float32 [nx, ny, nz, 3], scene units per second.
        origin: [3] float64, position of node (0, 0, 0), scene units.
        spacing: [3] float64, between nodes along each axis, scene units.
        liquid: bool [nx, ny, nz]: where there is liquid; elsewhere the field is continued and means nothing.

    Raises ValueError for arrays that do not fit together.
    """

    values: NDArray[np.float32]
    origin: NDArray[np.float64]
    spacing: NDArray[np.float64]
    liquid: NDArray[np.bool_]

    def __post_init__(self) -> None:
        self.values = np.ascontiguousarray(self.values, dtype=np.float32)
        self.origin, self.spacing = (np.asarray(v, dtype=np.float64) for v in (self.origin, self.spacing))
        if self.values.ndim != 4 or self.values.shape[3] != 3 or self.liquid.shape != self.values.shape[:3]:
            raise ValueError(f"values have shape {self.values.shape} and liquid {self.liquid.shape}")
        if self.origin.shape != (3,) or self.spacing.shape != (3,) or not (self.spacing > 0).all():
            raise ValueError("origin and spacing must be three numbers each, spacing above 0")

    def at(self, points: NDArray) -> NDArray[np.float32]:
        """Velocities [N, 3] at `points` [N, 3] (scene units), interpolated; at the border's beyond it."""
        from scipy.ndimage import map_coordinates

        where = ((np.asarray(points, dtype=np.float64) - self.origin) / self.spacing).T
        parts = [map_coordinates(self.values[..., axis], where, order=1, mode="nearest") for axis in range(3)]
        return np.stack(parts, axis=-1).astype(np.float32)
