"""Masks that miss large parts of the liquid, found by what the other views see.

The hull of the other views is projected into a view, without what the container hides there. Where it covers pixels
that the mask leaves dry, either the hull is wrong or the mask is. (The hull always is somewhere, behind the liquid and
in front.) How far to believe the hull is decided per patch of the image: by the share of frames, among those in which
the hull covers it, in which the mask agrees.
"""

from __future__ import annotations

import numba
import numpy as np

from splashbench.observe.grid import Bounds, Grid
from splashbench.observe.hull import carve_views, sequence_bounds
from splashbench.observe.occlusion import CarvingOcclusion, ContainerOcclusion, focal_length
from splashbench.observe.silhouettes import Silhouettes
from splashbench.scene.camera import Camera

_CELLS = 64
# Voxels of that grid: nodes as deep in the hull, and pixels as far off the mask, are no matter of rounding.
_DEPTH = 0.25
_MARGIN = 1.0
# Other frames in which the hull must cover a patch before its word counts there.
_FRAMES = 3
# A mask has failed when it seems to miss this share of the liquid beyond twice what is usual for the view (the hull of
# the others bulges where the outermost views look, and more so as the liquid moves), and far beyond the usual spread.
_MISSING_SHARE = 0.08
_DEVIATIONS = 6.0
# What is found in one round is known better in the next.
_ROUNDS = 2


def distrust_failed_masks(silhouettes: Silhouettes, container: ContainerOcclusion | None = None) -> np.ndarray:
    """Find the masks of `silhouettes` that show liquid but miss large parts of it, and replace them there.

    Returns those masks, bool [T, V]. Raises SplashbenchError when the masks have no common hull.
    """
    before = silhouettes.failed_masks.copy()
    trusted_bounds(silhouettes, container)
    return silhouettes.failed_masks & ~before


def trusted_bounds(silhouettes: Silhouettes, container: ContainerOcclusion | None = None) -> Bounds:
    """Do what `distrust_failed_masks` does; returns the `sequence_bounds` by what is trusted then."""
    for _ in range(_ROUNDS):
        bounds = sequence_bounds(silhouettes, container)
        missing = missing_shares(silhouettes, container, bounds)
        usual = np.median(missing, axis=0)
        spread = 1.4826 * np.median(np.abs(missing - usual), axis=0)
        failed = missing > usual + np.maximum(_MISSING_SHARE + usual, _DEVIATIONS * spread)
        failed &= silhouettes.sees_liquid & ~silhouettes.failed_masks
        if not failed.any():
            return bounds
        silhouettes.distrust(failed)
    return sequence_bounds(silhouettes, container)


def missing_shares(silhouettes: Silhouettes, container: ContainerOcclusion | None, bounds: Bounds) -> np.ndarray:
    """Estimated share of the liquid that each mask misses: float64 [T, V], 0 in frames without a hull.

    Of a mask that is replaced only what is certain counts (`Silhouettes.certain_mask`): a hull that is too large would
    accuse the other masks. bounds: `sequence_bounds` of both.
    """
    grid = Grid.over(bounds, _CELLS)
    # What one view alone sees is as long as its rays: it would accuse the masks of all others.
    carving = CarvingOcclusion.of(container, silhouettes, grid, witnesses=2)
    patches = [_Patches(camera, grid, carving, view) for view, camera in enumerate(silhouettes.cameras)]
    shape = (silhouettes.n_frames, len(silhouettes.views))
    covered = [np.zeros((silhouettes.n_frames, patch.count), dtype=bool) for patch in patches]
    dry = [np.zeros((silhouettes.n_frames, patch.count), dtype=bool) for patch in patches]
    area = np.zeros(shape)
    for t in range(silhouettes.n_frames):
        if not silhouettes.has_liquid(t):
            continue
        each = carve_views(silhouettes, grid, t, carving)
        for view, patch in enumerate(patches):
            others = np.max(np.delete(each, view, axis=0), axis=0)
            if carving is not None:
                np.maximum(others, carving.outside, out=others)
            mask_distance = silhouettes.certain_distance(view, t)
            area[t, view] = (mask_distance < 0).sum() / patch.size**2
            _cover(
                others.ravel(),
                patch.of_node,
                patch.pixels,
                mask_distance,
                silhouettes.windows[view].corner,
                _DEPTH,
                _MARGIN * patch.size,
                covered[view][t],
                dry[view][t],
            )
    missing = np.zeros(shape)
    for view in range(len(patches)):
        frames = covered[view].sum(axis=0) - covered[view]
        agree = (covered[view] & ~dry[view]).sum(axis=0) - (covered[view] & ~dry[view])
        belief = np.where(frames >= _FRAMES, agree / np.maximum(frames, 1), 0.0)
        missed = (dry[view] * belief).sum(axis=1)
        missing[:, view] = missed / np.maximum(missed + area[:, view], 1e-9)
    return missing


class _Patches:
    """The image of a view in square patches as large as a voxel, and the patch of each node of a grid."""

    def __init__(self, camera: Camera, grid: Grid, carving: CarvingOcclusion | None, view: int) -> None:
        nodes = grid.to_scene(np.moveaxis(np.indices(grid.shape), 0, -1).reshape(-1, 3))
        pixels, depth = camera.project(nodes)
        seen = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
        if carving is not None and carving.views:
            seen &= ~carving.views[view].hides(nodes, grid)
        self.pixels = pixels.astype(np.float32)
        middle = float(np.median(depth[seen])) if seen.any() else 1.0
        #: side in pixels
        self.size = max(1, round(focal_length(camera) * grid.voxel / middle))
        across, down = (-(-length // self.size) for length in (camera.width, camera.height))
        self.count = across * down
        number = (pixels[seen] // self.size).astype(np.int32)
        #: int32 [nodes], -1 where the view does not see the node
        self.of_node = np.full(len(nodes), -1, dtype=np.int32)
        self.of_node[seen] = number[:, 1] * across + number[:, 0]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cover(
    others: np.ndarray,
    patch_of: np.ndarray,
    pixels: np.ndarray,
    mask_distance: np.ndarray,
    corner: np.ndarray,
    depth: float,
    margin: float,
    covered: np.ndarray,
    dry: np.ndarray,
) -> None:
    height, width = mask_distance.shape
    for n in range(len(others)):
        if others[n] > -depth or patch_of[n] < 0:
            continue
        covered[patch_of[n]] = True
        column = int(np.floor(pixels[n, 0] - corner[0]))
        row = int(np.floor(pixels[n, 1] - corner[1]))
        inside_column = min(max(column, 0), width - 1)
        inside_row = min(max(row, 0), height - 1)
        beyond = np.sqrt(float((column - inside_column) ** 2 + (row - inside_row) ** 2))
        if mask_distance[inside_row, inside_column] + beyond > margin:
            dry[patch_of[n]] = True
