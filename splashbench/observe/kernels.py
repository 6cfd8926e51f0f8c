"""Compiled loops over grids: trilinear interpolation, and the distance to one view's silhouette cone.

The loops run on several threads (splashbench/parallel.py); each takes the part [start, stop) of its outermost range.
"""

from __future__ import annotations

import numba
import numpy as np

from splashbench.parallel import over_range

_SMALL_LOOP = 4096


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
    low = (field[i, j, k] * (1 - c) + field[i, j, k + 1] * c) * (1 - b) + (
        field[i, j + 1, k] * (1 - c) + field[i, j + 1, k + 1] * c
    ) * b
    high = (field[i + 1, j, k] * (1 - c) + field[i + 1, j, k + 1] * c) * (1 - b) + (
        field[i + 1, j + 1, k] * (1 - c) + field[i + 1, j + 1, k + 1] * c
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


@numba.njit(cache=True, error_model="numpy")
def _bilinear(image: np.ndarray, u: float, v: float) -> float:
    """Value of `image` [h, w] at column `u` and row `v`, within it."""
    column = min(int(u), image.shape[1] - 2)
    row = min(int(v), image.shape[0] - 2)
    a = u - column
    above = image[row, column] + (image[row, column + 1] - image[row, column]) * a
    below = image[row + 1, column] + (image[row + 1, column + 1] - image[row + 1, column]) * a
    return above + (below - above) * (v - row)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _carve_view(
    phi: np.ndarray,
    origin: np.ndarray,
    voxel: float,
    projection: np.ndarray,
    focal: float,
    silhouette: np.ndarray,
    corner: np.ndarray,
    limit: float,
    start: int,
    stop: int,
) -> None:
    _, ny, nz = phi.shape
    height, width = silhouette.shape
    right, bottom, per_voxel = width - 1.0, height - 1.0, 1.0 / (focal * voxel)
    du, dv, ddepth = projection[0, 2] * voxel, projection[1, 2] * voxel, projection[2, 2] * voxel
    for i in range(start, stop):
        x = origin[0] + i * voxel
        for j in range(ny):
            y = origin[1] + j * voxel
            first_u, first_v, first_depth = _projected(projection, x, y, origin[2])
            for k in range(nz):
                if phi[i, j, k] >= limit:
                    continue
                depth = first_depth + k * ddepth
                if depth <= 0.0:
                    phi[i, j, k] = limit
                    continue
                # Pixel (row, column) is centred at (column + 0.5, row + 0.5).
                nearness = 1.0 / depth
                u = (first_u + k * du) * nearness - 0.5 - corner[0]
                v = (first_v + k * dv) * nearness - 0.5 - corner[1]
                inside_u = min(max(u, 0.0), right)
                inside_v = min(max(v, 0.0), bottom)
                pixels = _bilinear(silhouette, inside_u, inside_v)
                if inside_u != u or inside_v != v:
                    pixels += np.sqrt((u - inside_u) ** 2 + (v - inside_v) ** 2)
                phi[i, j, k] = max(phi[i, j, k], min(max(pixels * depth * per_voxel, -limit), limit))


def carve_view(
    phi: np.ndarray,
    origin: np.ndarray,
    voxel: float,
    projection: np.ndarray,
    focal: float,
    silhouette: np.ndarray,
    corner: np.ndarray,
    limit: float,
) -> None:
    """phi = max(phi, distance to one view's silhouette cone), in place, in voxels, clipped to +-`limit`.

    phi: float32 [nx, ny, nz]. projection: [3, 4], scene to pixels. silhouette: float32 [h, w], signed distance in
    pixels to the mask's outline, negative inside, of the image window whose top-left pixel is `corner` (x, y). One
    pixel at depth z spans z / focal scene units. Nodes already `limit` away are skipped; points behind the camera are
    outside.
    """
    over_range(
        _carve_view,
        phi.shape[0],
        phi,
        np.ascontiguousarray(origin, np.float64),
        float(voxel),
        np.ascontiguousarray(projection, np.float64),
        float(focal),
        np.ascontiguousarray(silhouette, np.float32),
        np.ascontiguousarray(corner, np.float64),
        float(limit),
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _carve_hidden_view(
    phi: np.ndarray,
    witnesses: np.ndarray,
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
    counting = witnesses.shape[1] > 0
    for i in range(start, stop):
        x = origin[0] + i * voxel
        for j in range(ny):
            y = origin[1] + j * voxel
            first_u, first_v, first_depth = _projected(projection, x, y, origin[2])
            at = 0
            for k in range(nz):
                if not counting and phi[i, j, k] >= limit:
                    continue
                depth = first_depth + k * ddepth
                if depth <= 0.0:
                    if not counting:
                        phi[i, j, k] = limit
                    continue
                nearness = 1.0 / depth
                u = (first_u + k * du) * nearness - 0.5 - corner[0]
                v = (first_v + k * dv) * nearness - 0.5 - corner[1]
                inside_u = min(max(u, 0.0), right)
                inside_v = min(max(v, 0.0), bottom)
                reach = depth - tolerance
                # Depths change little from node to node: the search for the layer goes on where it ended.
                while at < last and starts[at] <= reach:
                    at += 1
                while at > 0 and starts[at - 1] > reach:
                    at -= 1
                layer, beyond = at, 0.0
                if inside_u != u or inside_v != v:
                    beyond = np.sqrt((u - inside_u) ** 2 + (v - inside_v) ** 2)
                # The nearest layer that hides no more than is hidden at this depth, or no less: either keeps the sign.
                elif layer < last and nearest[int(inside_v + 0.5), int(inside_u + 0.5)] < reach:
                    layer += 1
                pixels = _bilinear(layers[layer], inside_u, inside_v)
                distance = min(max((pixels + beyond) * depth * per_voxel, -limit), limit)
                if not counting:
                    phi[i, j, k] = max(phi[i, j, k], distance)
                elif distance > phi[i, j, k]:
                    witnesses[i, j, k] = phi[i, j, k]
                    phi[i, j, k] = distance
                elif distance > witnesses[i, j, k]:
                    witnesses[i, j, k] = distance


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
) -> None:
    """As `carve_view`, for a view from which an occluder hides what lies more than `tolerance` behind it.

    layers: float32 [K + 1, h, w], signed distances in pixels of the evidence at growing depths; layer k counts for
    depths from starts[k - 1] on (starts: [K], scene units, rising). nearest: float32 [h, w], depth of the occluder. A
    point that is hidden at its own depth looks one layer deeper, where its pixel is hidden too.

    second: float32 [nx, ny, nz]; where given, phi collects the largest and `second` the second largest value of all
    views that are added one after the other, instead of the maximum alone.
    """
    over_range(
        _carve_hidden_view,
        phi.shape[0],
        phi,
        _NOT_COUNTING if second is None else second,
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _fill_blocks(field: np.ndarray, blocks: np.ndarray, size: int, value: float, start: int, stop: int) -> None:
    _, ny, nz = field.shape
    for i in range(start, stop):
        for j in range(ny):
            for c in range(blocks.shape[2]):
                if blocks[i // size, j // size, c]:
                    for k in range(c * size, min((c + 1) * size, nz)):
                        field[i, j, k] = value


def fill_blocks(field: np.ndarray, blocks: np.ndarray, size: int, value: float) -> None:
    """Set `field` [nx, ny, nz] to `value` in `blocks`, bool [bx, by, bz] of `size` nodes a side, in place."""
    over_range(_fill_blocks, field.shape[0], field, np.ascontiguousarray(blocks), size, float(value))
