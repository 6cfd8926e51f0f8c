"""Restoring coverage from each observation (paper, "Resampling", and supplement, "Carriers").

The shell -depth <= phi <= outside is divided into cells of one transport voxel. A cell with fewer carriers than its
target gets new ones, uniform within its part of the shell. The target grows with nearness to the silhouettes (|phi| is
the distance to them) and with the curvature of phi. In the paper the shell ends at phi = 0; drops and sheets thinner
than a voxel then get next to none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from splashbench.observe.grid import Grid
from splashbench.observe.kernels import sample, trilinear
from splashbench.parallel import over_range

# A cell's corner is this far from its middle, in cells: beyond it, no part of the cell can be in the shell.
_HALF_DIAGONAL = 0.87
_TRIES_PER_CARRIER = 6
_SMALL_LOOP = 1024
# Below this depth, in voxels, few carriers do: the liquid's surface lies there where the hull is much larger than it.
_INTERIOR = 3.0


@dataclass(frozen=True)
class ShellSettings:
    """The shell and how full it is.

    depth, outside: how far it reaches below and above phi = 0, transport voxels. min_per_cell, max_per_cell: range of
    a cell's target population. interior_per_cell: the same for cells deeper than 3 voxels; None for no difference.
    """

    depth: float = 1.5
    outside: float = 0.0
    min_per_cell: int = 2
    max_per_cell: int = 2
    interior_per_cell: int | None = None
    curvature_weight: float = 0.1


def cell_of(positions: np.ndarray, grid: Grid) -> np.ndarray:
    """Flat cell number of positions [N, 3] (grid coordinates): int64 [N]."""
    cell = np.clip(np.floor(positions).astype(np.int64), 0, np.array(grid.shape) - 1)
    return np.ravel_multi_index(tuple(cell.T), grid.shape)


def within_capacity(cells: np.ndarray, ids: np.ndarray, capacity: int) -> np.ndarray:
    """bool [N]: whether a carrier is among the `capacity` oldest (smallest id) of its cell."""
    order = np.lexsort((ids, cells))
    ordered = cells[order]
    first = np.ones(len(cells), dtype=bool)
    first[1:] = ordered[1:] != ordered[:-1]
    group_start = np.maximum.accumulate(np.where(first, np.arange(len(cells)), 0))
    allowed = np.empty(len(cells), dtype=bool)
    allowed[order] = np.arange(len(cells)) - group_start < capacity
    return allowed


def target_population(phi: np.ndarray, centres: np.ndarray, ratio: float, shell: ShellSettings) -> np.ndarray:
    """Wanted number of carriers of the cells with these `centres` [M, 3] (transport-grid coordinates): int [M]."""
    points = centres * np.float32(ratio)
    middle = sample(phi, points)
    laplacian = -6 * middle
    for axis in range(3):
        step = np.zeros(3, dtype=np.float32)
        step[axis] = ratio
        laplacian += sample(phi, points + step) + sample(phi, points - step)
    importance = 0.5 * np.exp(-np.abs(middle)) + shell.curvature_weight * np.abs(laplacian)
    span = shell.max_per_cell - shell.min_per_cell
    population = np.floor(shell.min_per_cell + np.minimum(importance, 1) * span + 0.5).astype(np.int64)
    if shell.interior_per_cell is not None:
        population[middle < -_INTERIOR] = shell.interior_per_cell
    return population


def _at_centres(phi: np.ndarray, grid: Grid, ratio: float) -> np.ndarray:
    """`phi` in the middle of every cell of the transport `grid`, float32, a value less than nodes along each axis."""
    inner = [n - 1 for n in grid.shape]
    if ratio == 2 and all(2 * n <= m for n, m in zip(inner, phi.shape)):
        # There are nodes of `phi`.
        return phi[tuple(slice(1, 2 * n, 2) for n in inner)]
    corners = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float32) for n in inner), indexing="ij"), -1)
    centres = corners.reshape(-1, 3) + np.float32(0.5)
    return sample(phi, centres * np.float32(ratio)).reshape(inner)


def newborns(
    phi: np.ndarray,
    grid: Grid,
    ratio: float,
    positions: np.ndarray,
    shell: ShellSettings,
    rng: np.random.Generator,
) -> np.ndarray:
    """Positions of new carriers, float32 [M, 3] in transport-grid coordinates, given the present `positions` [N, 3].

    phi: hull-grid field in transport voxels; ratio: hull voxels per transport voxel.
    """
    middle = _at_centres(phi, grid, ratio)
    near = (middle > -shell.depth - _HALF_DIAGONAL) & (middle < shell.outside + _HALF_DIAGONAL)
    centres, middle = np.argwhere(near).astype(np.float32) + np.float32(0.5), middle[near]
    if len(centres) == 0:
        return np.zeros((0, 3), dtype=np.float32)
    population = np.bincount(cell_of(positions, grid), minlength=int(np.prod(grid.shape)))
    missing = target_population(phi, centres, ratio, shell) - population[cell_of(centres, grid)]
    short = missing > 0
    centres, middle, missing = centres[short], middle[short], missing[short]
    # Each cell draws candidates and keeps the first that fall into the shell: of a cell that lies in it most do.
    cut = (middle < -shell.depth + _HALF_DIAGONAL) | (middle > shell.outside - _HALF_DIAGONAL)
    tries = _TRIES_PER_CARRIER * np.where(cut, shell.max_per_cell, missing)
    starts = np.concatenate([[0], np.cumsum(tries)])
    candidates = rng.random((int(starts[-1]), 3), dtype=np.float32)
    chosen = np.zeros(len(candidates), dtype=bool)
    bounds = np.float32(-shell.depth), np.float32(shell.outside)
    over_range(
        _keep_first,
        len(centres),
        np.ascontiguousarray(phi),
        np.float32(ratio),
        centres,
        missing,
        starts,
        bounds,
        candidates,
        chosen,
        smallest=_SMALL_LOOP,
    )
    return candidates[chosen]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _keep_first(
    phi: np.ndarray,
    ratio: float,
    centres: np.ndarray,
    missing: np.ndarray,
    starts: np.ndarray,
    bounds: tuple[float, float],
    candidates: np.ndarray,
    chosen: np.ndarray,
    start: int,
    stop: int,
) -> None:
    """Chooses of each cell's candidates the first `missing` whose phi is within `bounds`; candidates: places within the
    cells, float32 [M, 3] in [0, 1), which become those in the grid as far as they were looked at."""
    half = np.float32(0.5)
    for cell in range(start, stop):
        found = 0
        for n in range(starts[cell], starts[cell + 1]):
            for axis in range(3):
                candidates[n, axis] = centres[cell, axis] + candidates[n, axis] - half
            depth = trilinear(phi, candidates[n, 0] * ratio, candidates[n, 1] * ratio, candidates[n, 2] * ratio)
            if bounds[0] <= np.float32(depth) <= bounds[1]:
                chosen[n] = True
                found += 1
                if found == missing[cell]:
                    break
