"""Compiled loops over grids: trilinear interpolation, and the distance to one view's silhouette cone.

The loops run on several threads (splashbench/parallel.py); each takes the part [start, stop) of its outermost range.
"""

from __future__ import annotations

import numba
import numpy as np

from splashbench.parallel import over_range

_SMALL_LOOP = 4096
#: Nodes along the edge of a block, see `carve_view`.
BLOCK = 4
# Depths behind the camera and in its plane, which have no pixel, count as this much: pixels stay numbers.
_NEAREST = 1e-300


@numba.njit(cache=True, error_model="numpy")
def trilinear(field: np.ndarray, x: float, y: float, z: float) -> float:
    """Value of `field` [nx, ny, nz] at node coordinates (x, y, z); clamped to the grid outside it."""
    nx, ny, nz = field.shape
    x = min(max(x, 0.0), nx - 1.0)
    y = min(max(y, 0.0), ny - 1.0)
    z = min(max(z, 0.0), nz - 1.0)
    i = min(int(x), nx - 2)
    j = min(int(y), ny - 2)
    k = min(int(z), nz - 2)
    a = x - i
    b = y - j
    c = z - k
    # Unsigned, as signed numbers might count from the end, which takes time to rule out.
    one = np.uint64(1)
    left, front, under = np.uint64(i), np.uint64(j), np.uint64(k)
    right, back, above = left + one, front + one, under + one
    low = (field[left, front, under] * (1 - c) + field[left, front, above] * c) * (1 - b) + (
        field[left, back, under] * (1 - c) + field[left, back, above] * c
    ) * b
    high = (field[right, front, under] * (1 - c) + field[right, front, above] * c) * (1 - b) + (
        field[right, back, under] * (1 - c) + field[right, back, above] * c
    ) * b
    return low * (1 - a) + high * a


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sample(field: np.ndarray, points: np.ndarray, values: np.ndarray, start: int, stop: int) -> None:
    for n in range(start, stop):
        values[n] = trilinear(field, points[n, 0], points[n, 1], points[n, 2])


def sample(field: np.ndarray, points: np.ndarray) -> np.ndarray:
    """`field` [nx, ny, nz] at node coordinates `points` [N, 3]: float32 [N]. Outside the grid: its nearest point's."""
    values = np.empty(len(points), np.float32)
    over_range(
        _sample,
        len(points),
        np.ascontiguousarray(field),
        np.ascontiguousarray(points, np.float32),
        values,
        smallest=_SMALL_LOOP,
    )
    return values


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _resample(field: np.ndarray, ratio: float, out: np.ndarray, start: int, stop: int) -> None:
    for i in range(start, stop):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                out[i, j, k] = trilinear(field, i * ratio, j * ratio, k * ratio)


def resample(field: np.ndarray, shape: tuple[int, int, int], ratio: float) -> np.ndarray:
    """`field` on another grid of the same origin whose voxel is `ratio` voxels of `field`: float32 `shape`."""
    if ratio == int(ratio):
        # Its nodes are nodes of `field`.
        step = int(ratio)
        if all((n - 1) * step < nodes for n, nodes in zip(shape, field.shape)):
            i, j, k = (slice(0, (n - 1) * step + 1, step) for n in shape)
            return np.ascontiguousarray(field[i, j, k], np.float32)
        i, j, k = (np.minimum(np.arange(n) * step, nodes - 1) for n, nodes in zip(shape, field.shape))
        return np.ascontiguousarray(field[i][:, j][:, :, k], np.float32)
    out = np.empty(shape, np.float32)
    over_range(_resample, shape[0], np.ascontiguousarray(field), float(ratio), out)
    return out


@numba.njit(cache=True, error_model="numpy")
def _projected(projection: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Homogeneous pixel coordinates of a point."""
    return (
        projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3],
        projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3],
        projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3],
    )


# Loop after loop over a whole row of nodes, so that most of them become vector instructions: 1.7 times as fast as one
# node after the other. For that, rows have arrays of their own each, and places in images are unsigned, which cannot
# count from the end.
@numba.njit(cache=True, nogil=True, error_model="numpy")
def _carve(
    phi: np.ndarray,
    second: np.ndarray,
    blocks: np.ndarray,
    origin: np.ndarray,
    voxel: float,
    projection: np.ndarray,
    focal: float,
    layers: np.ndarray,
    corner: np.ndarray,
    nearest: np.ndarray,
    starts: np.ndarray,
    tolerance: float,
    limit: float,
    start: int,
    stop: int,
) -> None:
    _, ny, nz = phi.shape
    last, height, width = layers.shape[0] - 1, layers.shape[1], layers.shape[2]
    right, bottom, per_voxel = width - 1.0, height - 1.0, 1.0 / (focal * voxel)
    du, dv, ddepth = projection[0, 2] * voxel, projection[1, 2] * voxel, projection[2, 2] * voxel
    corner_u, corner_v = corner[0], corner[1]
    last_column, last_row, columns = np.int32(width - 2), np.int32(height - 2), np.int32(width)
    line, size, one = np.uint64(width), np.uint64(height * width), np.uint64(1)
    values, surface = layers.reshape(-1), nearest.reshape(-1)
    counting = second.shape[1] > 0
    nodes, layer = np.empty(nz, np.int32), np.empty(nz, np.int32)
    place, middle = np.empty(nz, np.uint32), np.empty(nz, np.uint32)
    depths, beyond, across, down, distances = np.empty(nz), np.empty(nz), np.empty(nz), np.empty(nz), np.empty(nz)
    for i in range(start, stop):
        x = origin[0] + i * voxel
        for j in range(ny):
            y = origin[1] + j * voxel
            found = 0
            for block in range(blocks.shape[2]):
                if blocks[i // BLOCK, j // BLOCK, block]:
                    for k in range(block * BLOCK, min((block + 1) * BLOCK, nz)):
                        nodes[found] = k
                        found += 1 if counting or phi[i, j, k] < limit else 0
            if found == 0:
                continue
            first_u, first_v, first_depth = _projected(projection, x, y, origin[2])
            for n in range(found):
                depth = first_depth + nodes[n] * ddepth
                # Pixel (row, column) is centred at (column + 0.5, row + 0.5).
                nearness = 1.0 / max(depth, _NEAREST)
                u = (first_u + nodes[n] * du) * nearness - 0.5 - corner_u
                v = (first_v + nodes[n] * dv) * nearness - 0.5 - corner_v
                inside_u, inside_v = min(max(u, 0.0), right), min(max(v, 0.0), bottom)
                beyond[n] = np.sqrt((u - inside_u) * (u - inside_u) + (v - inside_v) * (v - inside_v))
                column, row = min(np.int32(inside_u), last_column), min(np.int32(inside_v), last_row)
                across[n], down[n] = inside_u - column, inside_v - row
                place[n] = row * columns + column
                middle[n] = np.int32(inside_v + 0.5) * columns + np.int32(inside_u + 0.5)
                depths[n] = depth
                layer[n] = 0
            for k in range(last):
                from_depth = starts[k]
                for n in range(found):
                    layer[n] += 1 if from_depth <= depths[n] - tolerance else 0
            for n in range(found):
                # The nearest layer that hides no more than is hidden at this depth, or no less: either keeps the sign.
                deeper = layer[n]
                if beyond[n] == 0.0 and deeper < last and surface[np.uint64(middle[n])] < depths[n] - tolerance:
                    deeper += 1
                at = np.uint64(deeper) * size + np.uint64(place[n])
                above = values[at] + (values[at + one] - values[at]) * across[n]
                under = at + line
                below = values[under] + (values[under + one] - values[under]) * across[n]
                distances[n] = above + (below - above) * down[n]
            for n in range(found):
                distances[n] = min(max((distances[n] + beyond[n]) * depths[n] * per_voxel, -limit), limit)
            for n in range(found):
                k = nodes[n]
                if not counting:
                    phi[i, j, k] = max(phi[i, j, k], distances[n] if depths[n] > 0.0 else limit)
                elif depths[n] <= 0.0:
                    continue
                elif distances[n] > phi[i, j, k]:
                    second[i, j, k] = phi[i, j, k]
                    phi[i, j, k] = distances[n]
                elif distances[n] > second[i, j, k]:
                    second[i, j, k] = distances[n]


_NOTHING_BEFORE = np.zeros(0)
_NO_SURFACE = np.zeros((0, 0), dtype=np.float32)


def carve_view(
    phi: np.ndarray,
    origin: np.ndarray,
    voxel: float,
    projection: np.ndarray,
    focal: float,
    silhouette: np.ndarray,
    corner: np.ndarray,
    limit: float,
    blocks: np.ndarray | None = None,
) -> None:
    """phi = max(phi, distance to one view's silhouette cone), in place, in voxels, clipped to +-`limit`.

    phi: float32 [nx, ny, nz]. projection: [3, 4], scene to pixels. silhouette: float32 [h, w], signed distance in
    pixels to the mask's outline, negative inside, of the image window whose top-left pixel is `corner` (x, y). One
    pixel at depth z spans z / focal scene units. Nodes already `limit` away are skipped; points behind the camera are
    outside. blocks: bool, of `BLOCK` nodes a side, see `blocks_of`: those that are looked at, by default all.
    """
    # A view from which nothing is hidden.
    carve_hidden_view(
        phi,
        origin,
        voxel,
        projection,
        focal,
        silhouette[None],
        corner,
        _NO_SURFACE,
        _NOTHING_BEFORE,
        0.0,
        limit,
        blocks=blocks,
    )


_NOT_COUNTING = np.zeros((1, 0, 1), dtype=np.float32)


def carve_hidden_view(
    phi: np.ndarray,
    origin: np.ndarray,
    voxel: float,
    projection: np.ndarray,
    focal: float,
    layers: np.ndarray,
    corner: np.ndarray,
    nearest: np.ndarray,
    starts: np.ndarray,
    tolerance: float,
    limit: float,
    second: np.ndarray | None = None,
    blocks: np.ndarray | None = None,
) -> None:
    """As `carve_view`, for a view from which an occluder hides what lies more than `tolerance` behind it.

    layers: float32 [K + 1, h, w], signed distances in pixels of the evidence at growing depths; layer k counts for
    depths from starts[k - 1] on (starts: [K], scene units, rising). nearest: float32 [h, w], depth of the occluder. A
    point that is hidden at its own depth looks one layer deeper, where its pixel is hidden too.

    second: float32 [nx, ny, nz]; where given, phi collects the largest and `second` the second largest value of all
    views that are added one after the other, instead of the maximum alone.
    """
    over_range(
        _carve,
        phi.shape[0],
        phi,
        _NOT_COUNTING if second is None else second,
        np.ones(blocks_of(phi.shape), dtype=np.bool_) if blocks is None else blocks,
        np.ascontiguousarray(origin, np.float64),
        float(voxel),
        np.ascontiguousarray(projection, np.float64),
        float(focal),
        np.ascontiguousarray(layers, np.float32),
        np.ascontiguousarray(corner, np.float64),
        np.ascontiguousarray(nearest, np.float32),
        np.ascontiguousarray(starts, np.float64),
        float(tolerance),
        float(limit),
    )


def blocks_of(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """How many blocks of `BLOCK` nodes a side a grid of `shape` has along each axis."""
    nx, ny, nz = (-(-n // BLOCK) for n in shape)
    return nx, ny, nz


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill_blocks(field: np.ndarray, blocks: np.ndarray, value: float, start: int, stop: int) -> None:
    _, ny, nz = field.shape
    for i in range(start, stop):
        for j in range(ny):
            block, count = 0, blocks.shape[2]
            while block < count:
                first = block
                while block < count and blocks[i // BLOCK, j // BLOCK, block]:
                    block += 1
                for k in range(first * BLOCK, min(block * BLOCK, nz)):
                    field[i, j, k] = value
                block += 1


def fill_blocks(field: np.ndarray, blocks: np.ndarray, value: float) -> None:
    """Set `field` [nx, ny, nz] to `value` in `blocks`, bool, see `blocks_of`; in place."""
    over_range(_fill_blocks, field.shape[0], field, np.ascontiguousarray(blocks), float(value))
