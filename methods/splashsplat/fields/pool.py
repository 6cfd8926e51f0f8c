"""The pool: liquid that rests in a container is level (hydrostatics).

Silhouettes say where liquid may be, not where it is: over a pool the visual hull is a dome, as high as the cameras look
down. Two things are known of a pool beyond its silhouettes. It fills the container up to one height, and the outline
of its surface is where that surface meets the container's wall. So the level of a frame is the height that best
separates the part of the inner wall that masks cover from the part that they leave free.
- Below the level the container is full.
- Above it only that part of the hull stays which a view needs to explain its mask. What every view sees in front of
  the pool is a phantom.
Not in the paper. Needs the container's mesh and the direction of gravity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from splashbench.observe.grid import Grid
from splashbench.observe.mask_distance import signed_distance_2d
from splashbench.observe.occlusion import focal_length
from splashbench.observe.silhouettes import Silhouettes
from splashbench.parallel import over_range
from splashbench.scene.camera import Camera

from .jet import Jet
from .vessel import Vessel, lowest_heights

# Levels are tried this far apart, in vessel voxels; a pool explains the masks where they overlap by at least this.
_LEVEL_STEP = 0.25
_MIN_OVERLAP = 0.35
# Voxels about the surface within which distances matter.
_NEAR = 3.0
_SMALL_LOOP = 4096
# Levels are the medians over so many frames to either side.
_STEADY = 2
# Views of larger liquid windows are looked at every so many pixels, so that this many remain along the longest side.
_LONGEST_WINDOW = 480


@dataclass(frozen=True)
class PoolView:
    """One view's look into the vessel. stride, corner: of the pixels of `heights` (see `lowest_heights`)."""

    camera: Camera
    corner: np.ndarray
    stride: int
    heights: np.ndarray


class LiquidPool:
    """Finds the level of the pool in each frame, and lowers the hull to it."""

    def __init__(self, vessel: Vessel, silhouettes: Silhouettes, opaque: bool) -> None:
        """opaque: whether the container hides what is behind its walls."""
        self.vessel = vessel
        self._silhouettes = silhouettes
        self._room: _Room | None = None
        self.views = []
        for camera, window in zip(silhouettes.cameras, silhouettes.windows):
            stride = max(1, -(-max(window.shape) // _LONGEST_WINDOW))
            height, width = (max(-(-n // stride), 2) for n in window.shape)
            heights = lowest_heights(vessel, camera, window.corner, (height, width), stride, opaque)
            self.views.append(PoolView(camera, window.corner, stride, heights))
        grid = vessel.grid
        self._tried = grid.origin[2] + grid.voxel * np.arange(0, grid.shape[2], _LEVEL_STEP)

    def levels(self) -> np.ndarray:
        """Height of the pool in every frame, float64 [T] scene units, NaN where there is none; see `level`."""
        candidates = np.array([self.level(t) for t in range(self._silhouettes.n_frames)])
        trusted = candidates[:, 1] >= _MIN_OVERLAP
        levels = np.full(len(candidates), np.nan)
        for t in np.nonzero(trusted)[0]:
            near = slice(max(t - _STEADY, 0), t + _STEADY + 1)
            levels[t] = np.median(candidates[near, 0][trusted[near]])
        return levels

    def level(self, t: int) -> tuple[float, float]:
        """Height of the pool (scene units) that explains the masks of frame `t` best, and how well: the overlap (IoU)
        of what it covers and the masks, within what the views see of the vessel."""
        covered, spilled = np.zeros(len(self._tried) + 1), np.zeros(len(self._tried) + 1)
        for number, view in enumerate(self.views):
            mask = self._silhouettes.mask(number, t)[:: view.stride, :: view.stride]
            height, width = mask.shape
            heights = view.heights[:height, :width]
            looks = np.isfinite(heights)
            if self._silhouettes.failed_masks[t, number] or not (mask & looks).any():
                continue
            bins = np.searchsorted(self._tried, heights[looks], side="left")
            liquid = mask[looks]
            covered += np.bincount(bins[liquid], minlength=len(covered)) / liquid.sum()
            spilled += np.bincount(bins[~liquid], minlength=len(covered)) / liquid.sum()
        if covered.sum() == 0:
            return -np.inf, 0.0
        overlap = np.cumsum(covered) / (covered.sum() + np.cumsum(spilled))
        best = int(np.argmax(overlap[:-1]))
        return float(self._tried[best]), float(overlap[best])

    def lowered(
        self,
        phi: np.ndarray,
        grid: Grid,
        level: float,
        container_depths: Sequence[np.ndarray | None],
        jet: Jet | None = None,
    ) -> np.ndarray:
        """`phi` (hull distance on `grid`, voxels, float32) with a full pool up to `level` and without what every view
        explains by it: changed in place, as it is large, and returned.

        container_depths: per view the container's depth image, None where it hides nothing (observe/container.py).
        jet: what falls into the pool is no phantom.
        """
        if self._room is None or self._room.grid is not grid:
            self._room = _Room.of(self.vessel, grid)
        room = self._room
        phi = np.ascontiguousarray(phi)
        flat = phi.reshape(-1)
        doubtful = np.nonzero(flat < _NEAR)[0]
        points = grid.to_scene(np.stack(np.unravel_index(doubtful, grid.shape), axis=1))
        above = ((self.vessel.height(points) - level) / grid.voxel).astype(np.float32)
        high = above > -1
        doubtful, points, removal = doubtful[high], points[high], above[high]
        if jet is not None:
            removal = np.minimum(removal, jet.distance(points @ self.vessel.turn.T).astype(np.float32) / grid.voxel - 1)
        for view, container_depth in zip(self.views, container_depths):
            explained = signed_distance_2d(view.heights <= level) * np.float32(view.stride)
            fixed = (
                points,
                np.ascontiguousarray(view.camera.projection),
                focal_length(view.camera) * grid.voxel,
                explained,
                view.corner,
                view.stride,
                np.zeros((0, 0), np.float32) if container_depth is None else container_depth,
                grid.voxel,
            )
            over_range(_phantom_depth, len(points), *fixed, removal, smallest=_SMALL_LOOP)
        flat[doubtful] = np.maximum(flat[doubtful], removal)
        below = room.nodes[: np.searchsorted(room.heights, level + _NEAR * grid.voxel)]
        pool = np.maximum((room.heights[: len(below)] - level) / grid.voxel, room.distance[: len(below)])
        flat[below] = np.minimum(flat[below], pool.astype(np.float32))
        return phi


@dataclass(frozen=True)
class _Room:
    """The nodes of `grid` in and about a vessel, by height: flat node numbers, heights (scene units), and distances to
    the wall (voxels, negative inside)."""

    grid: Grid
    nodes: np.ndarray
    heights: np.ndarray
    distance: np.ndarray

    @classmethod
    def of(cls, vessel: Vessel, grid: Grid) -> _Room:
        distance = vessel.room(grid).reshape(-1)
        near = np.flatnonzero(distance < _NEAR)
        height = vessel.height(grid.to_scene(np.stack(np.unravel_index(near, grid.shape), axis=1)))
        order = np.argsort(height, kind="stable")
        return cls(grid, near[order], height[order], distance[near][order])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _phantom_depth(
    points: np.ndarray,
    projection: np.ndarray,
    pixels_per_voxel: float,
    explained: np.ndarray,
    corner: np.ndarray,
    stride: int,
    container_depth: np.ndarray,
    tolerance: float,
    phantom: np.ndarray,
    start: int,
    stop: int,
) -> None:
    """phantom = min(phantom, depth within what this view explains by the pool), voxels, where it sees the point."""
    height, width = explained.shape
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        depth = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
        if depth <= 0:
            continue
        u = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / depth
        v = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / depth
        rows, columns = container_depth.shape
        within = rows > 0 and 0 <= u < columns and 0 <= v < rows
        if within and depth > container_depth[int(v), int(u)] + tolerance:
            continue
        a = min(max((u - 0.5 - corner[0]) / stride, 0.0), width - 1.0)
        b = min(max((v - 0.5 - corner[1]) / stride, 0.0), height - 1.0)
        column, row = min(int(a), width - 2), min(int(b), height - 2)
        a -= column
        b -= row
        pixels = (explained[row, column] * (1 - a) + explained[row, column + 1] * a) * (1 - b) + (
            explained[row + 1, column] * (1 - a) + explained[row + 1, column + 1] * a
        ) * b
        phantom[n] = min(phantom[n], -pixels * depth / pixels_per_voxel)
