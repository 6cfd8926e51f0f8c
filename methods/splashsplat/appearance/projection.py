"""Where carriers lie in a photograph, compiled: all of them in each, before the first iteration."""

from __future__ import annotations

import numba
import numpy as np

from splashbench.scene.camera import Camera


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def project(projection: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Pixel (u, v) and depth of a point; projection: float64 [3, 4]. Pixels of no positive depth mean nothing."""
    depth = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
    nearness = 1.0 / depth if depth > 0 else 0.0
    u = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) * nearness
    v = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) * nearness
    return u, v, depth


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _extent(points: np.ndarray, projection: np.ndarray, extent: np.ndarray) -> None:
    for n in range(len(points)):
        u, v, depth = project(projection, points[n, 0], points[n, 1], points[n, 2])
        if depth > 0:
            extent[0], extent[1] = min(extent[0], u), min(extent[1], v)
            extent[2], extent[3] = max(extent[2], u), max(extent[3], v)


def projected_extent(camera: Camera, points: np.ndarray) -> np.ndarray | None:
    """Least u and v and largest u and v of the pixels of `points` [N, 3] (scene units) that are before the camera:
    float64 [4]; None where none is."""
    extent = np.array([np.inf, np.inf, -np.inf, -np.inf])
    _extent(points, np.ascontiguousarray(camera.projection), extent)
    return extent if extent[0] <= extent[2] else None
