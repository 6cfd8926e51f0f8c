"""Pixels that a mask calls liquid and that no liquid covers: where carriers explain them best.

Masks contradict each other where one view's liquid is hidden from another, or where a mask is off by a pixel. phi_t is
then above 0 all along the pixel's ray, no carrier is born there, and the render shows the background. A carrier at the
least contradicted point of the ray lets the photographs decide. The paper leaves such pixels empty.
"""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np

from splashbench.observe.grid import Grid
from splashbench.observe.image_window import ImageWindow
from splashbench.observe.kernels import trilinear
from splashbench.observe.silhouettes import Silhouettes
from splashbench.parallel import over_range
from splashbench.scene.camera import Camera

# A ray whose lowest phi is below this counts as covered: Gaussians of the shell reach as far. In transport voxels.
COVERED = 0.4
# Shortest step along a ray, in nodes of the grid.
_STEP = 0.5
_SMALL_LOOP = 256


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lowest(
    phi: np.ndarray,
    eye: np.ndarray,
    directions: np.ndarray,
    ends: np.ndarray,
    scale: float,
    points: np.ndarray,
    values: np.ndarray,
    start: int,
    stop: int,
) -> None:
    top = (phi.shape[0] - 1.0, phi.shape[1] - 1.0, phi.shape[2] - 1.0)
    for n in range(start, stop):
        near, far = 0.0, ends[n]
        for axis in range(3):
            way, d = eye[axis], directions[n, axis]
            if abs(d) < 1e-12:
                if way < 0 or way > top[axis]:
                    far = -1.0
                continue
            first, second = -way / d, (top[axis] - way) / d
            near, far = max(near, min(first, second)), min(far, max(first, second))
        best, at = np.inf, near
        way = near
        # Most rays are covered. To find that, steps may be as long as the way to where a ray would be at the earliest.
        while way <= far and best > COVERED * scale:
            x, y = eye[0] + way * directions[n, 0], eye[1] + way * directions[n, 1]
            value = scale * trilinear(phi, x, y, eye[2] + way * directions[n, 2])
            best = min(best, value)
            way += max(_STEP, value - COVERED * scale)
        # Of the others, the lowest place is wanted.
        if best > COVERED * scale:
            best, way = np.inf, near
        while way <= far and best > COVERED * scale:
            x, y = eye[0] + way * directions[n, 0], eye[1] + way * directions[n, 1]
            value = scale * trilinear(phi, x, y, eye[2] + way * directions[n, 2])
            if value < best:
                best, at = value, way
            # phi falls by at most one voxel a voxel: nothing lower than the lowest is nearer than this.
            way += max(_STEP, value - best)
        values[n] = best / scale
        for axis in range(3):
            points[n, axis] = eye[axis] + at * directions[n, axis]


def uncovered(
    phi: np.ndarray,
    grid: Grid,
    camera: Camera,
    mask: np.ndarray,
    window: ImageWindow,
    depth: np.ndarray | None,
    reach: float,
    scale: float,
) -> np.ndarray:
    """The least contradicted points of the mask's rays that no liquid covers: float32 [M, 3], node coordinates of
    `grid`.

    phi: signed distance on `grid`, float32, of which `scale` makes voxels of the grid. mask: bool, of the `window` of
    the camera's image. depth: the container's depth image [H, W], inf where there is none, or None; rays end there.
    reach: rays whose lowest phi is above this, in the unit of phi, are left empty.
    """
    rows, columns = np.nonzero(mask)
    rows, columns = rows + window.y0, columns + window.x0
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    # Directions with a depth of 1 in front of the camera, so that the way along them is the depth.
    local = np.linalg.solve(camera.K, pixels.T)
    unit = (camera.w2c[:3, :3].T @ local).T
    lengths = np.linalg.norm(unit, axis=1)
    ends = np.full(len(rows), np.inf) if depth is None else depth[rows, columns] * lengths / grid.voxel
    points = np.empty((len(rows), 3), np.float32)
    values = np.empty(len(rows), np.float32)
    over_range(
        _lowest,
        len(rows),
        np.ascontiguousarray(phi, np.float32),
        (camera.center - grid.origin) / grid.voxel,
        np.ascontiguousarray(unit / lengths[:, None]),
        ends,
        float(scale),
        points,
        values,
        smallest=_SMALL_LOOP,
    )
    return points[(values > COVERED) & (values <= reach)]


def uncovered_by_any(
    phi: np.ndarray,
    grid: Grid,
    silhouettes: Silhouettes,
    t: int,
    container_depths: Sequence[np.ndarray | None],
    reach: float,
    scale: float,
) -> np.ndarray:
    """`uncovered` of all views whose mask of frame `t` is trusted, float32 [M, 3]."""
    points = [np.zeros((0, 3), np.float32)]
    for view, (camera, depth) in enumerate(zip(silhouettes.cameras, container_depths)):
        if silhouettes.trusted(view, t):
            mask = silhouettes.inside(view, t)
            points.append(uncovered(phi, grid, camera, mask, silhouettes.windows[view], depth, reach, scale))
    return np.concatenate(points)
