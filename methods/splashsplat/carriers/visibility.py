"""Which carriers a camera can see at all: those near the surface on its side of the liquid.

The shell below the surface goes all around the liquid, its far side and its bottom included, where no view looks.
Carriers there cost time and storage and nothing holds their colour. A point is seen by a camera when the way to it
leads through little liquid and not through the container.
"""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np

from splashbench.observe.grid import Grid
from splashbench.observe.kernels import trilinear
from splashbench.parallel import over_range
from splashbench.scene.camera import Camera

_STEP = 0.5
_SMALL_LOOP = 256


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _seen(
    phi: np.ndarray,
    points: np.ndarray,
    eye: np.ndarray,
    projection: np.ndarray,
    container_depth: np.ndarray,
    tolerance: float,
    limit: float,
    scale: float,
    seen: np.ndarray,
    start: int,
    stop: int,
) -> None:
    top_x, top_y, top_z = phi.shape[0] - 1.0, phi.shape[1] - 1.0, phi.shape[2] - 1.0
    for n in range(start, stop):
        if seen[n]:
            continue
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        depth = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
        if depth <= 0:
            continue
        if container_depth.shape[0] > 0:
            u = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / depth
            v = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / depth
            inside = 0 <= u < container_depth.shape[1] and 0 <= v < container_depth.shape[0]
            if inside and depth > container_depth[int(v), int(u)] + tolerance:
                continue
        dx, dy, dz = eye[0] - x, eye[1] - y, eye[2] - z
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx / length, dy / length, dz / length
        way, crossed = 0.0, 0.0
        while way < length:
            way += _STEP
            a, b, c = x + way * dx, y + way * dy, z + way * dz
            if a < 0 or b < 0 or c < 0 or a > top_x or b > top_y or c > top_z:
                break
            value = scale * trilinear(phi, a, b, c)
            # The surface is no nearer than the distance says.
            free = max(_STEP, abs(value))
            way += free - _STEP
            if value < 0:
                crossed += free
                if crossed > limit:
                    break
        seen[n] = crossed <= limit


def seen_by_any(
    phi: np.ndarray,
    grid: Grid,
    points: np.ndarray,
    cameras: Sequence[Camera],
    container_depths: Sequence[np.ndarray | None],
    limit: float,
    scale: float = 1.0,
) -> np.ndarray:
    """bool [N]: whether a camera sees `points` [N, 3] (node coordinates of `grid`) through at most `limit` voxels of
    liquid.

    phi: signed distance on `grid`, float32; `scale` makes voxels of it. container_depths: per camera the depth image
    of the container, or None.
    """
    seen = np.zeros(len(points), dtype=bool)
    points = np.ascontiguousarray(points, dtype=np.float32)
    for camera, container_depth in zip(cameras, container_depths):
        # The projection of node coordinates.
        to_scene = np.diag([grid.voxel, grid.voxel, grid.voxel, 1.0])
        to_scene[:3, 3] = grid.origin
        fixed = (
            np.ascontiguousarray(phi, np.float32),
            points,
            (camera.center - grid.origin) / grid.voxel,
            np.ascontiguousarray(camera.projection @ to_scene),
            np.zeros((0, 0), np.float32) if container_depth is None else container_depth,
            grid.voxel,
            float(limit),
            float(scale),
        )
        over_range(_seen, len(points), *fixed, seen, smallest=_SMALL_LOOP)
    return seen
