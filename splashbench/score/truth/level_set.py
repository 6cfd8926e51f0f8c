"""Comparing two liquids on one grid of nodes: shared volume, and distance between surfaces (docs/protocol.md).

Signed distances are float32 [nx, ny, nz], negative inside; only their sign and where they cross zero are used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from splashbench.observe.grid import Grid
from splashbench.parallel import over_range
from splashbench.scene.geometry import MAX_STEPS, STEPS_PER_VOXEL, SignedDistance

Field = NDArray[np.float32]

#: Single distances between surfaces are clipped to this many voxels, and a surface that is not there is this far away.
CHAMFER_LIMIT_VOXELS = 20.0
#: phi, voxels, of air that counts as liquid.
LEAST_DEPTH = np.float32(1e-3)
# Nodes of two grids closer than this, voxels, are one.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class Overlap:
    """Shared volume of a reconstruction and the truth, in nodes."""

    both: int
    true: int
    reconstructed: int

    @property
    def iou(self) -> float:
        """Intersection over union; there must be true liquid."""
        return self.both / (self.true + self.reconstructed - self.both)

    @property
    def recall(self) -> float:
        """Share of the true volume that is reconstructed."""
        return self.both / self.true

    @property
    def precision(self) -> float | None:
        """Share of the reconstructed volume that is true; None where nothing is reconstructed."""
        return self.both / self.reconstructed if self.reconstructed else None


def overlap(true: Field, reconstructed: Field) -> Overlap:
    """Count the nodes inside each of two liquids, and inside both."""
    first, second = true < 0, reconstructed < 0
    return Overlap(int(np.count_nonzero(first & second)), int(np.count_nonzero(first)), int(np.count_nonzero(second)))


def surface_points(phi: Field) -> NDArray[np.float64]:
    """Where edges between neighbouring nodes cross zero, the vertices of marching cubes: [N, 3] node coordinates."""
    inside = phi < 0
    if not inside.any():
        return np.zeros((0, 3))
    low, high = _box(inside)
    low, high = np.maximum(low - 1, 0), np.minimum(high + 1, phi.shape)
    box = tuple(slice(a, b) for a, b in zip(low, high))
    inside, phi = inside[box], phi[box]
    points = []
    for axis in range(3):
        lower = tuple(slice(0, -1) if i == axis else slice(None) for i in range(3))
        upper = tuple(slice(1, None) if i == axis else slice(None) for i in range(3))
        cut = inside[lower] != inside[upper]
        nodes = np.flatnonzero(cut)
        first, second = phi[lower].ravel()[nodes].astype(np.float64), phi[upper].ravel()[nodes].astype(np.float64)
        crossing = (np.stack(np.unravel_index(nodes, cut.shape), axis=1) + low).astype(np.float64)
        crossing[:, axis] += first / (first - second)
        points.append(crossing)
    return np.concatenate(points)


def _box(inside: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and one past the last index [3] of `inside`, which is not empty."""
    spans = [np.flatnonzero(inside.any(axis=axes))[[0, -1]] for axes in ((1, 2), (0, 2), (0, 1))]
    return np.array([span[0] for span in spans]), np.array([span[1] + 1 for span in spans])


def chamfer(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Symmetric mean distance of two sets of surface points [N, 3], [M, 3]: the mean of the means of both directions.

    Single distances are clipped to CHAMFER_LIMIT_VOXELS, which is also the distance to a set without points.
    """
    from scipy.spatial import cKDTree

    if len(first) == 0 or len(second) == 0:
        return CHAMFER_LIMIT_VOXELS
    means = []
    for points, others in ((first, second), (second, first)):
        distances, _ = cKDTree(others).query(points, distance_upper_bound=CHAMFER_LIMIT_VOXELS, workers=-1)
        means.append(float(np.minimum(distances, CHAMFER_LIMIT_VOXELS).mean()))
    return 0.5 * (means[0] + means[1])


def filled(phi: Field) -> Field:
    """`phi` with the air inside that liquid encloses on all sides: a method may carry a shell of particles only."""
    from scipy.ndimage import label

    air = phi >= 0
    if air.all() or not air.any():
        return phi
    box = tuple(slice(a, b) for a, b in zip(*_box(~air)))
    # One layer of air around the box joins all the air that is not enclosed.
    regions, _ = label(np.pad(air[box], 1, constant_values=True))
    enclosed = (regions != regions[0, 0, 0])[1:-1, 1:-1, 1:-1] & air[box]
    result = phi.copy()
    # Any value below 0 will do: no surface remains between what is filled and what was liquid.
    result[box][enclosed] = -LEAST_DEPTH
    return result


def resampled(geometry: SignedDistance, t: int, grid: Grid) -> Field:
    """Frame `t` of `geometry` on `grid`, in voxels of its own grid; outside that there is no liquid."""
    coordinates = []
    for axis in range(3):
        along = (grid.origin[axis] + grid.voxel * np.arange(grid.shape[axis]) - geometry.origin[axis]) / geometry.voxel
        # Nodes that fall on nodes keep their exact values.
        coordinates.append(np.where(np.abs(along - np.rint(along)) < _ROUNDING, np.rint(along), along))
    out = np.empty(grid.shape, np.float32)
    over_range(_resample, grid.shape[0], np.ascontiguousarray(geometry.phi[t]), *coordinates, out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _resample(
    steps: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray, out: np.ndarray, start: int, stop: int
) -> None:
    nx, ny, nz = steps.shape
    for i in range(start, stop):
        for j in range(len(y)):
            for k in range(len(z)):
                if not (0 <= x[i] <= nx - 1 and 0 <= y[j] <= ny - 1 and 0 <= z[k] <= nz - 1):
                    out[i, j, k] = MAX_STEPS / STEPS_PER_VOXEL
                    continue
                a = min(int(x[i]), nx - 2)
                b = min(int(y[j]), ny - 2)
                c = min(int(z[k]), nz - 2)
                u, v, w = x[i] - a, y[j] - b, z[k] - c
                low = (steps[a, b, c] * (1 - w) + steps[a, b, c + 1] * w) * (1 - v) + (
                    steps[a, b + 1, c] * (1 - w) + steps[a, b + 1, c + 1] * w
                ) * v
                high = (steps[a + 1, b, c] * (1 - w) + steps[a + 1, b, c + 1] * w) * (1 - v) + (
                    steps[a + 1, b + 1, c] * (1 - w) + steps[a + 1, b + 1, c + 1] * w
                ) * v
                out[i, j, k] = (low * (1 - u) + high * u) / STEPS_PER_VOXEL
