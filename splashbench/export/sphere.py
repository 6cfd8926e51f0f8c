"""Directions spread evenly over a sphere, and a sphere of Gaussians around everything."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.scene import Gaussians

# Gaussians of the sphere, its radius over that of what it encloses, and their width over the space between them.
_COUNT, _FAR, _OVERLAP = 2000, 10.0, 0.8
# Their thickness over their width.
_FLAT = 1e-3


def even_directions(count: int) -> NDArray[np.float64]:
    """Unit vectors [count, 3] spread evenly over the sphere, along a spiral (Fibonacci's)."""
    steps = np.arange(count) + 0.5
    z = 1 - 2 * steps / count
    angles = np.pi * (1 + np.sqrt(5)) * steps
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), z], axis=1)


def enclosing_sphere(color: NDArray[np.float64], middle: NDArray[np.float64], reach: float) -> Gaussians:
    """Flat, opaque Gaussians of one `color` [3] (sRGB in [0, 1]), far around all within `reach` of `middle` [3]."""
    outward = even_directions(_COUNT)
    radius = _FAR * reach
    width = _OVERLAP * radius * np.sqrt(4 * np.pi / _COUNT)
    factors = width * (np.eye(3) - (1 - _FLAT) * outward[:, :, None] * outward[:, None, :])
    return Gaussians(
        (middle + radius * outward).astype(np.float32),
        factors.astype(np.float32),
        np.ones(_COUNT, np.float32),
        np.tile(color, (_COUNT, 1)).astype(np.float32),
    )
