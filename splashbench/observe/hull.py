"""Visual hull carving and the box that holds the liquid over the whole sequence (paper, "Observed geometry").

phi(x) = max over views of s_v(pi_v(x)) z_v(x) / f_v, with s_v the 2-D signed distance in pixels to the view's
silhouette: positive as soon as one view contradicts x, sub-voxel sharp, and without a 3-D distance transform.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.observe.grid import Bounds, Grid
from splashbench.observe.kernels import carve_view
from splashbench.observe.silhouettes import MaskedScene, Silhouettes

#: phi is clipped to this many voxels: nothing farther from the interface matters to transport, carriers or opacity
LIMIT_VOXELS = 20.0
SEARCH_CELLS = 64
REFINED_CELLS = 96


def carve(silhouettes: Silhouettes, grid: Grid, distance: Callable[[int], np.ndarray]) -> np.ndarray:
    """Hull distance on `grid`, float32 [nx, ny, nz] in voxels, negative inside; `distance(view)` gives s_v."""
    phi = np.full(grid.shape, -LIMIT_VOXELS, dtype=np.float32)
    for view, camera in enumerate(silhouettes.cameras):
        focal = 0.5 * float(camera.K[0, 0] + camera.K[1, 1])
        carve_view(
            phi,
            grid.origin,
            grid.voxel,
            np.ascontiguousarray(camera.projection),
            focal,
            distance(view),
            silhouettes.corners[view],
            LIMIT_VOXELS,
        )
    return phi


def carve_frame(silhouettes: Silhouettes, grid: Grid, t: int) -> np.ndarray:
    """Hull distance of frame `t` (see `carve`); LIMIT_VOXELS everywhere in a frame without liquid."""
    if not silhouettes.has_liquid(t):
        return np.full(grid.shape, LIMIT_VOXELS, dtype=np.float32)
    return carve(silhouettes, grid, lambda view: silhouettes.distance(view, t))


def _inside(phi: np.ndarray, grid: Grid, tolerance: float) -> Bounds | None:
    """Box around the nodes with phi < `tolerance` voxels, half a voxel larger on every side."""
    inside = phi < tolerance
    if not inside.any():
        return None
    spans = [np.nonzero(inside.any(axis=axes))[0][[0, -1]] for axes in ((1, 2), (0, 2), (0, 1))]
    low, high = np.array([s[0] for s in spans]) - 0.5, np.array([s[1] for s in spans]) + 0.5
    return Bounds(grid.to_scene(low), grid.to_scene(high))


def _meeting_point(silhouettes: Silhouettes) -> np.ndarray:
    """Point closest to all rays through the middles of what each view ever sees as liquid, [3] scene units."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for camera, mask, corner in zip(silhouettes.cameras, silhouettes.sequence_masks, silhouettes.corners):
        if not mask.any():
            continue
        rows, columns = np.nonzero(mask)
        pixel = np.array([columns.mean() + 0.5 + corner[0], rows.mean() + 0.5 + corner[1], 1.0])
        direction = camera.w2c[:3, :3].T @ np.linalg.solve(camera.K, pixel)
        direction /= np.linalg.norm(direction)
        across = np.eye(3) - np.outer(direction, direction)
        normal += across
        right += across @ camera.center
    return np.linalg.lstsq(normal, right, rcond=None)[0]


def sequence_bounds(scene: MaskedScene | Silhouettes) -> Bounds:
    """Box around the union of the hulls of all frames, scene units, without padding.

    Raises SplashbenchError when the masks of the views have no common hull (wrong cameras, or masks of another scene).
    """
    silhouettes = scene if isinstance(scene, Silhouettes) else Silhouettes(scene)
    centre = _meeting_point(silhouettes)
    reach = max(float(np.linalg.norm(camera.center - centre)) for camera in silhouettes.cameras)
    # Linear algebra differs in the last bit with the alignment of its arrays; on a raster, the same masks give the same
    # grid to the last bit, and with it everything that follows.
    step = 2.0 ** np.floor(np.log2(reach) - 8)
    centre, reach = np.round(centre / step) * step, float(np.ceil(reach / step) * step)
    bounds = Bounds(centre - reach, centre + reach)
    # First what all frames together allow: no frame's liquid can lie outside it, and it costs one carving only.
    for _ in range(3):
        grid = Grid.over(bounds, SEARCH_CELLS)
        common = _inside(carve(silhouettes, grid, silhouettes.sequence_distance), grid, tolerance=1.0)
        if common is None:
            raise SplashbenchError(
                "the liquid masks of the training views have no common visual hull; "
                "check the camera poses, and that masks and cameras belong together"
            )
        bounds = common
    grid = Grid.over(bounds.padded(0.02), REFINED_CELLS)
    nearest = np.full(grid.shape, LIMIT_VOXELS, dtype=np.float32)
    for t in range(silhouettes.n_frames):
        np.minimum(nearest, carve_frame(silhouettes, grid, t), out=nearest)
    # Streams thinner than a voxel may fall between the nodes, hence the tolerance.
    refined = _inside(nearest, grid, tolerance=0.5)
    return bounds if refined is None else refined
