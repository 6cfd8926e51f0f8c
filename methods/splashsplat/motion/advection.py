"""Forecast and correction of carriers (paper, Eqs. carrier_forecast and sdf_correction).

Positions are transport-grid coordinates, distances transport voxels, velocities voxels per frame.
"""

from __future__ import annotations

import numba
import numpy as np

from splashbench.parallel import over_range

from .velocity import Factor, factors, velocity_at

MIN_STRETCH, MAX_STRETCH = 1 / 3, 3.0
_SMALL_LOOP = 1024


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _forecast(
    control: np.ndarray,
    factor: tuple[float, float, float],
    positions: np.ndarray,
    deformation: np.ndarray,
    duration: float,
    moved: np.ndarray,
    deformed: np.ndarray,
    start: int,
    stop: int,
) -> None:
    for n in range(start, stop):
        x, y, z = float(positions[n, 0]), float(positions[n, 1]), float(positions[n, 2])
        u, v, w = velocity_at(control, factor, x, y, z)
        half = 0.5 * duration
        u, v, w = velocity_at(control, factor, x + half * u, y + half * v, z + half * w)
        moved[n, 0] = x + duration * u
        moved[n, 1] = y + duration * v
        moved[n, 2] = z + duration * w
        gradient = np.empty((3, 3))
        for b in range(3):
            dx, dy, dz = 1.0 * (b == 0), 1.0 * (b == 1), 1.0 * (b == 2)
            high = velocity_at(control, factor, x + dx, y + dy, z + dz)
            low = velocity_at(control, factor, x - dx, y - dy, z - dz)
            gradient[0, b] = 0.5 * (high[0] - low[0])
            gradient[1, b] = 0.5 * (high[1] - low[1])
            gradient[2, b] = 0.5 * (high[2] - low[2])
        for a in range(3):
            for b in range(3):
                value = float(deformation[n, a, b])
                for c in range(3):
                    value += duration * gradient[a, c] * deformation[n, c, b]
                deformed[n, a, b] = value


def clamp_stretch(deformation: np.ndarray) -> np.ndarray:
    """Deformation gradients [N, 3, 3] with their singular values clamped to [1/3, 3], float32."""
    clamped = deformation.astype(np.float32)
    # The largest singular value is at most |F|, the smallest at least 2 |det F| / |F|^2, as the product of the other
    # two is at most |F|^2 / 2: most carriers need no decomposition.
    square = (deformation**2).sum(axis=(1, 2))
    doubtful = ~((square <= MAX_STRETCH**2) & (2 * np.abs(np.linalg.det(deformation)) >= MIN_STRETCH * square))
    left, stretch, right = np.linalg.svd(deformation[doubtful])
    clamped[doubtful] = (left * np.clip(stretch, MIN_STRETCH, MAX_STRETCH)[:, None, :]) @ right
    return clamped


def forecast(
    control: np.ndarray, factor: Factor, positions: np.ndarray, deformation: np.ndarray, duration: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Positions [N, 3] by midpoint RK2 and F by (I + duration grad u) F, singular values clamped.

    control, factor: see velocity.py. duration: in frames; a fraction gives the state between two frames.
    """
    positions = np.ascontiguousarray(positions, np.float32)
    deformation = np.ascontiguousarray(deformation, np.float32)
    moved, deformed = np.empty_like(positions), np.empty_like(deformation)
    fixed = (np.ascontiguousarray(control, np.float32), factors(factor), positions, deformation, float(duration))
    over_range(_forecast, len(positions), *fixed, moved, deformed, smallest=_SMALL_LOOP)
    return moved, clamp_stretch(deformed)
