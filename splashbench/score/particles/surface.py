"""The liquid that particles stand for: the smooth surface around them, one rule for the truth and for every method.

Zhu and Bridson, "Animating sand as a fluid" (SIGGRAPH 2005), Section 5: phi(x) = |x - m(x)| - r, with m the mean of the
particles near x, weighted by (1 - (d / R)^2)^3. Between two sheets m may lie half-way, in the air; so what is farther
from every particle than a gap between neighbours can be is air. Sizes and their reasons: docs/protocol.md, "Against
the truth".
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from splashbench.parallel import over_range
from splashbench.score.particles.copies import limited_copies

#: In spacings: R, r, and the largest distance of liquid to the nearest particle.
SUPPORT = 2.0
RADIUS = 0.5
LARGEST_GAP = 1.0
#: Which neighbour's distance is the spacing: the third is one lattice constant away in a lattice (in a flat sheet as
#: well), and on average 0.86 of (volume per particle)^(1/3) among points scattered at random.
NEIGHBOUR = 3
#: Spacings beyond these are clipped: far below a voxel nothing shows, and particles far apart are drops.
MIN_SPACING_VOXELS, MAX_SPACING_VOXELS = 0.25, 6.0
#: phi is clipped to this many voxels: enough to place its zero between the nodes, which is all that is used.
LIMIT_VOXELS = 2.0


def spacing(points: NDArray[np.float64]) -> float | None:
    """Median distance of `points` [N, 3] to their third nearest neighbour; None for fewer than four points."""
    from scipy.spatial import cKDTree

    if len(points) <= NEIGHBOUR:
        return None
    copies = limited_copies(points, NEIGHBOUR + 1)
    single = points if copies is None else points[copies[0]]
    distances, _ = cKDTree(single).query(single, NEIGHBOUR + 1, workers=-1)
    third = distances[:, NEIGHBOUR]
    return float(np.median(third if copies is None else third[copies[1]]))


def particle_distance(
    points: NDArray[np.float64], spacing_voxels: float, shape: tuple[int, int, int]
) -> NDArray[np.float32]:
    """phi on a grid, float32 `shape`, voxels, negative inside the liquid, clipped to +-LIMIT_VOXELS.

    Args:
        points: [N, 3] node coordinates; those far outside the grid count for nothing.
        spacing_voxels: of the particles, clipped to what the grid can show.
        shape: nodes of the grid.
    """
    size = min(max(spacing_voxels, MIN_SPACING_VOXELS), MAX_SPACING_VOXELS)
    reach = SUPPORT * size
    phi = np.full(shape, LIMIT_VOXELS, np.float32)
    near = np.all((points > -reach) & (points < np.array(shape) - 1 + reach), axis=1)
    if not near.any():
        return phi
    # Only the box that the particles reach is looked at; in order, so that rounding does not depend on theirs.
    points = points[near]
    points = np.ascontiguousarray(points[np.lexsort(points.T)])
    low = np.maximum(np.floor(points.min(axis=0) - reach).astype(int), 0)
    high = np.minimum(np.ceil(points.max(axis=0) + reach).astype(int) + 1, shape)
    part = np.empty(high - low, np.float32)
    over_range(_smooth_surface, len(part), points - low, reach, RADIUS * size, LARGEST_GAP * size, part)
    phi[tuple(slice(a, b) for a, b in zip(low, high))] = np.clip(part, -LIMIT_VOXELS, LIMIT_VOXELS)
    return phi


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _smooth_surface(
    points: np.ndarray, reach: float, radius: float, gap: float, phi: np.ndarray, start: int, stop: int
) -> None:
    """phi = max(|x - mean of the points within `reach`| - radius, distance to the nearest point - gap)."""
    _, ny, nz = phi.shape
    # Per node: sums of w (point - x), sum of w, and the squared distance to the nearest point.
    sums = np.zeros((stop - start, ny, nz, 5))
    sums[:, :, :, 4] = np.inf
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for i in range(max(start, int(np.ceil(x - reach))), min(stop, int(np.floor(x + reach)) + 1)):
            for j in range(max(0, int(np.ceil(y - reach))), min(ny, int(np.floor(y + reach)) + 1)):
                rest = reach * reach - (i - x) ** 2 - (j - y) ** 2
                if rest < 0.0:
                    continue
                half = np.sqrt(rest)
                for k in range(max(0, int(np.ceil(z - half))), min(nz, int(np.floor(z + half)) + 1)):
                    squared = (i - x) ** 2 + (j - y) ** 2 + (k - z) ** 2
                    weight = max(0.0, 1.0 - squared / (reach * reach)) ** 3
                    node = sums[i - start, j, k]
                    node[0] += weight * (x - i)
                    node[1] += weight * (y - j)
                    node[2] += weight * (z - k)
                    node[3] += weight
                    node[4] = min(node[4], squared)
    for i in range(start, stop):
        for j in range(ny):
            for k in range(nz):
                node = sums[i - start, j, k]
                if node[3] > 0.0:
                    offset = np.sqrt(node[0] ** 2 + node[1] ** 2 + node[2] ** 2) / node[3]
                    phi[i, j, k] = max(offset - radius, np.sqrt(node[4]) - gap)
                else:
                    phi[i, j, k] = np.inf
