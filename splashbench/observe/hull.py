"""Visual hull carving and the box that holds the liquid over the whole sequence (paper, "Observed geometry").

phi(x) = max over views of s_v(pi_v(x)) z_v(x) / f_v, with s_v the 2-D signed distance in pixels to the view's
silhouette: positive as soon as one view contradicts x, sub-voxel sharp, and without a 3-D distance transform.
A view does not contradict what is past a side of its image at which liquid is cut off, nor what a container hides from
it; a container adds where its walls are (occlusion.py).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from splashbench.errors import SplashbenchError
from splashbench.observe.carving import BLOCK, blocks_of, carve_view
from splashbench.observe.cut_off import in_images
from splashbench.observe.grid import Bounds, Grid
from splashbench.observe.image_window import ImageWindow
from splashbench.observe.kernels import fill_blocks
from splashbench.observe.occlusion import LIMIT_VOXELS, CarvingOcclusion, ContainerOcclusion, focal_length
from splashbench.observe.silhouettes import MaskedScene, Silhouettes
from splashbench.parallel import each

SEARCH_CELLS = 64
REFINED_CELLS = 96

# Nodes along a grid's shortest side from which blocks are worth it.
_WORTH_BLOCKS = 48
# From the middle of a block to its farthest node, voxels.
_HALF = 0.5 * (BLOCK - 1) * 3**0.5
# By how much a distance read between pixels may miss what its slope of one allows, pixels.
_BETWEEN_PIXELS = 0.6
# Nodes so many voxels outside the hull, or less, may be at liquid.
_NEAR = 0.5
# Of liquid that some images cut off, this share at either end of each axis gets no grid.
_FRINGE = 0.003

#: the 2-D signed distance s_v of view number v, of a window of its image
Distance = Callable[[int, ImageWindow | None], np.ndarray]


def carve(silhouettes: Silhouettes, grid: Grid, distance: Distance, container: CarvingOcclusion | None) -> np.ndarray:
    """Hull distance on `grid`, float32 [nx, ny, nz] in voxels, negative inside; `distance` gives s_v.

    container: `CarvingOcclusion.of` them.
    """
    phi = np.full(grid.shape, -LIMIT_VOXELS, dtype=np.float32) if container is None else container.outside.copy()
    carvers = each(lambda view: _Carver(silhouettes, view, distance, container), range(len(silhouettes.cameras)))
    blocks: list[np.ndarray] | list[None] = [None] * len(carvers)
    if min(grid.shape) >= _WORTH_BLOCKS:
        far, blocks = _blocks(grid, carvers)
        fill_blocks(phi, far, LIMIT_VOXELS)
    for carver, wanted in zip(carvers, blocks):
        carver.carve(phi, grid, wanted)
    return phi


def _blocks(grid: Grid, carvers: list[_Carver]) -> tuple[np.ndarray, list[np.ndarray]]:
    """The blocks in which every node is LIMIT_VOXELS or more outside; and of each view those of the others in which it
    may say more than all other views: bool, see `blocks_of`.

    Told from their middles, on a grid that is so much coarser. Most nodes are in far blocks, and near to others one
    view often says more than the rest.
    """
    middles = Grid(grid.origin + 0.5 * (BLOCK - 1) * grid.voxel, grid.voxel * BLOCK, blocks_of(grid.shape))
    bounds = [carver.bounds(middles, grid) for carver in carvers]
    least = np.maximum.reduce([low for low, _ in bounds])
    far = least >= LIMIT_VOXELS
    np.clip(least, -LIMIT_VOXELS, None, out=least)
    return far, [~far & (high > least) for _, high in bounds]


def carve_frame(silhouettes: Silhouettes, grid: Grid, t: int, container: CarvingOcclusion | None) -> np.ndarray:
    """Hull distance of frame `t` (see `carve`); LIMIT_VOXELS everywhere in a frame without liquid."""
    if not silhouettes.has_liquid(t):
        return np.full(grid.shape, LIMIT_VOXELS, dtype=np.float32)
    return carve(silhouettes, grid, lambda view, window: silhouettes.distance(view, t, window), container)


def carve_views(silhouettes: Silhouettes, grid: Grid, t: int, container: CarvingOcclusion | None) -> np.ndarray:
    """What each view alone is certain of in frame `t`: float32 [V, nx, ny, nz] in voxels, < 0 in its silhouette."""
    views = np.full((len(silhouettes.cameras), *grid.shape), -LIMIT_VOXELS, dtype=np.float32)
    carvers = each(
        lambda view: _Carver(
            silhouettes, view, lambda v, window: silhouettes.certain_distance(v, t, window), container
        ),
        range(len(views)),
    )
    for phi, carver in zip(views, carvers):
        carver.carve(phi, grid)
    return views


class _Carver:
    """What view number `view` says; `distance` gives s_v."""

    def __init__(
        self, silhouettes: Silhouettes, view: int, distance: Distance, container: CarvingOcclusion | None
    ) -> None:
        self._camera = silhouettes.cameras[view]
        self._occlusion = container.views[view] if container is not None and container.views else None
        if self._occlusion is not None:
            self._evidence = self._occlusion.evidence(distance(view, self._occlusion.window))
        else:
            window = silhouettes.windows[view] if container is None else container.windows[view]
            self._corner, self._evidence = window.corner, distance(view, window)

    def carve(self, phi: np.ndarray, grid: Grid, blocks: np.ndarray | None = None) -> None:
        """phi = max(phi, that), in place, in voxels of `grid`, in `blocks` (see `carve_view`)."""
        if self._occlusion is None:
            self._carve_seen(phi, grid, LIMIT_VOXELS, blocks)
        else:
            self._occlusion.carve(phi, grid, self._evidence, blocks=blocks)

    def bounds(self, middles: Grid, grid: Grid) -> tuple[np.ndarray, np.ndarray]:
        """The least and the most that it says at any node of each block of `grid`, by the `middles` of blocks: float32
        in voxels of `grid`, and right as far as LIMIT_VOXELS from the outline."""
        margin = self._margin(grid)
        if margin is None:
            return np.full(middles.shape, -np.inf, np.float32), np.full(middles.shape, np.inf, np.float32)
        limit = (LIMIT_VOXELS + margin) / BLOCK + 1
        low = np.full(middles.shape, -limit, dtype=np.float32)
        occlusion, reach = self._occlusion, _HALF * grid.voxel
        if occlusion is None:
            self._carve_seen(low, middles, limit)
            low *= BLOCK
            return low - margin, low + margin
        high = low.copy()
        occlusion.carve_least(low, middles, self._evidence, limit, reach)
        occlusion.carve_most(high, middles, self._evidence, limit, reach, grid.voxel)
        # Where liquid meets what is hidden, distances jump from those to one outline to those to another.
        return low * BLOCK - margin, np.maximum(high, 0) * BLOCK + margin

    def _margin(self, grid: Grid) -> float | None:
        """By how many voxels at most a distance of up to LIMIT_VOXELS at a node of `grid` differs from that at the
        middle of its block; None where part of the grid is beside the camera or behind it."""
        camera, focal = self._camera, focal_length(self._camera)
        seen = grid.corners() @ camera.w2c[:3, :3].T + camera.w2c[:3, 3]
        nearest, farthest = float(seen[:, 2].min()), float(seen[:, 2].max())
        if nearest <= LIMIT_VOXELS * grid.voxel:
            return None
        # Distances grow by one voxel a voxel across the line of sight, by more where a camera sees at a slant, and
        # along it as pixels widen.
        slant = float((np.linalg.norm(seen, axis=1) / seen[:, 2]).max())
        uneven = max(float(camera.K[0, 0]), float(camera.K[1, 1])) / focal
        slope = uneven * slant + 1.5 * LIMIT_VOXELS * grid.voxel / nearest
        return slope * _HALF + _BETWEEN_PIXELS * farthest / (focal * grid.voxel)

    def _carve_seen(self, phi: np.ndarray, grid: Grid, limit: float, blocks: np.ndarray | None = None) -> None:
        camera = self._camera
        place = (grid.origin, grid.voxel, camera.projection, focal_length(camera))
        carve_view(phi, *place, self._evidence, self._corner, limit, blocks)


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
    for view, camera in enumerate(silhouettes.cameras):
        rows, columns = np.nonzero(silhouettes.sequence_mask(view))
        if len(rows) == 0:
            continue
        corner = silhouettes.windows[view].corner
        pixel = np.array([columns.mean() + 0.5 + corner[0], rows.mean() + 0.5 + corner[1], 1.0])
        direction = camera.w2c[:3, :3].T @ np.linalg.solve(camera.K, pixel)
        direction /= np.linalg.norm(direction)
        across = np.eye(3) - np.outer(direction, direction)
        normal += across
        right += across @ camera.center
    return np.linalg.lstsq(normal, right, rcond=None)[0]


def sequence_bounds(
    scene: MaskedScene | Silhouettes, container: ContainerOcclusion | None = None, tight: bool = True
) -> Bounds:
    """Box around the union of the hulls of all frames, scene units, without padding.

    container: where given, the box leaves out what it does not allow, and holds what it may hide. tight: look at every
    frame; else the box is that of the hull of all masks together, which is larger and found in no time.

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
        carving = CarvingOcclusion.of(container, silhouettes, grid)
        if silhouettes.all_there:
            allowed = carve(silhouettes, grid, silhouettes.sequence_distance, carving)
        else:
            # What a view ever sees says nothing of the times at which it was not there.
            allowed, _ = _over_time(silhouettes, grid, carving)
        common = _inside(allowed, grid, tolerance=1.0)
        if common is None:
            where = "" if container is None else ", and that the container is at the liquid (container_pose, gravity)"
            raise SplashbenchError(
                "the liquid masks of the training views have no common visual hull; "
                f"check the camera poses, and that masks and cameras belong together{where}"
            )
        bounds = common
    if not tight:
        return bounds
    grid = Grid.over(bounds.padded(0.02), REFINED_CELLS)
    carving = CarvingOcclusion.of(container, silhouettes, grid)
    nearest, frames = _over_time(silhouettes, grid, carving)
    # Streams thinner than a voxel may fall between the nodes, hence the tolerance.
    refined = _inside(nearest, grid, tolerance=_NEAR)
    if refined is None or not any(silhouettes.cut_off):
        return bounds if refined is None else refined
    # What not all images have is known less well. Single drops of it, and what only seems to be there, are not worth a
    # coarser grid for all.
    most = _without_fringe(frames, grid)
    in_all = _inside(
        np.maximum(nearest, -in_images(silhouettes.that_see_liquid, grid, 1.0, LIMIT_VOXELS)), grid, tolerance=_NEAR
    )
    return most if in_all is None else most.joined(in_all)


def _over_time(silhouettes: Silhouettes, grid: Grid, carving: CarvingOcclusion | None) -> tuple[np.ndarray, np.ndarray]:
    """The least hull distance of all frames at each node of `grid`, float32 voxels; and in how many frames it is at
    liquid, int32."""
    nearest = np.full(grid.shape, LIMIT_VOXELS, dtype=np.float32)
    frames = np.zeros(grid.shape, dtype=np.int32)
    for t in range(silhouettes.n_frames):
        phi = carve_frame(silhouettes, grid, t, carving)
        np.minimum(nearest, phi, out=nearest)
        frames += phi < _NEAR
    return nearest, frames


def _without_fringe(frames: np.ndarray, grid: Grid) -> Bounds:
    """Box around all but a share of `_FRINGE` of the liquid at either end of each axis, half a voxel larger on every
    side. frames: in how many it is at each node."""
    low, high = [], []
    for axes in ((1, 2), (0, 2), (0, 1)):
        summed = np.cumsum(frames.sum(axis=axes, dtype=np.int64))
        low.append(np.searchsorted(summed, _FRINGE * summed[-1], side="right") - 0.5)
        high.append(np.searchsorted(summed, (1 - _FRINGE) * summed[-1]) + 0.5)
    return Bounds(grid.to_scene(np.array(low)), grid.to_scene(np.array(high)))
