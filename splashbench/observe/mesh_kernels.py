"""Compiled loops over a triangle mesh: depth images, distances to it, and crossings of grid lines with it.

The loops run on several threads (splashbench/parallel.py); each takes the part [start, stop) of its outermost range
and walks all triangles, so that no two write one element.
"""

from __future__ import annotations

import numba
import numpy as np

from splashbench.observe.kernels import resample
from splashbench.parallel import over_range

# Pixels: neighbouring triangles must not leave a crack between them by rounding.
EDGE_SLACK = 1e-7
# Pixels of a depth image that are worth a thread.
_FEWEST_PIXELS = 1 << 16
# Voxels: grid lines are counted beside the nodes, so that they meet no vertex and no edge of a mesh that was built on
# round numbers.
_BESIDE = (3.1e-5, 2.3e-5)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _raster(corners: np.ndarray, depth: np.ndarray, start: int, stop: int) -> None:
    width = depth.shape[1]
    for n in range(corners.shape[0]):
        x0, y0, w0 = corners[n, 0]
        x1, y1, w1 = corners[n, 1]
        x2, y2, w2 = corners[n, 2]
        first = max(start, int(np.ceil(max(min(y0, y1, y2), -1.0) - 0.5)))
        last = min(stop - 1, int(np.floor(min(max(y0, y1, y2), depth.shape[0] + 1.0) - 0.5)))
        if first > last:
            continue
        left = max(0, int(np.ceil(max(min(x0, x1, x2), -1.0) - 0.5)))
        right = min(width - 1, int(np.floor(min(max(x0, x1, x2), width + 1.0) - 0.5)))
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0.0 or left > right:
            continue
        for row in range(first, last + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                a = ((x1 - x) * (y2 - y) - (x2 - x) * (y1 - y)) / area
                b = ((x2 - x) * (y0 - y) - (x0 - x) * (y2 - y)) / area
                c = 1.0 - a - b
                if a < -EDGE_SLACK or b < -EDGE_SLACK or c < -EDGE_SLACK:
                    continue
                # 1 / z is linear in the image.
                z = np.float32(1.0 / (a * w0 + b * w1 + c * w2))
                if z < depth[row, column]:
                    depth[row, column] = z


def raster(corners: np.ndarray, height: int, width: int) -> np.ndarray:
    """Depth of the nearest triangle at each pixel's centre, float32 [height, width], inf where there is none.

    corners: float64 [N, 3, 3], x, y in pixels and 1 / z > 0 of the corners of each triangle, seen from either side.
    """
    depth = np.full((height, width), np.inf, dtype=np.float32)
    # Handing out the parts of a small picture takes longer than drawing it.
    rows = max(32, _FEWEST_PIXELS // max(width, 1))
    over_range(_raster, height, np.ascontiguousarray(corners, np.float64), depth, smallest=rows)
    return depth


@numba.njit(cache=True, error_model="numpy")
def _squared_distance(t: np.ndarray, x: float, y: float, z: float) -> float:
    """Squared distance of (x, y, z) to the triangle `t` [3, 3] (Ericson, Real-Time Collision Detection, 5.1.5)."""
    abx, aby, abz = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    acx, acy, acz = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    apx, apy, apz = x - t[0, 0], y - t[0, 1], z - t[0, 2]
    d1 = abx * apx + aby * apy + abz * apz
    d2 = acx * apx + acy * apy + acz * apz
    if d1 <= 0.0 and d2 <= 0.0:
        return apx * apx + apy * apy + apz * apz
    bpx, bpy, bpz = x - t[1, 0], y - t[1, 1], z - t[1, 2]
    d3 = abx * bpx + aby * bpy + abz * bpz
    d4 = acx * bpx + acy * bpy + acz * bpz
    if d3 >= 0.0 and d4 <= d3:
        return bpx * bpx + bpy * bpy + bpz * bpz
    cpx, cpy, cpz = x - t[2, 0], y - t[2, 1], z - t[2, 2]
    d5 = abx * cpx + aby * cpy + abz * cpz
    d6 = acx * cpx + acy * cpy + acz * cpz
    if d6 >= 0.0 and d5 <= d6:
        return cpx * cpx + cpy * cpy + cpz * cpz
    vc = d1 * d4 - d3 * d2
    vb = d5 * d2 - d1 * d6
    va = d3 * d6 - d5 * d4
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w = d1 / (d1 - d3), 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    dx, dy, dz = apx - v * abx - w * acx, apy - v * aby - w * acy, apz - v * abz - w * acz
    return dx * dx + dy * dy + dz * dz


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _near(triangles: np.ndarray, reach: float, squared: np.ndarray, start: int, stop: int) -> None:
    _, ny, nz = squared.shape
    for n in range(triangles.shape[0]):
        t = triangles[n]
        i0 = max(start, int(np.ceil(max(t[:, 0].min() - reach, -1.0))))
        i1 = min(stop - 1, int(np.floor(min(t[:, 0].max() + reach, 1e9))))
        if i0 > i1:
            continue
        j0 = max(0, int(np.ceil(max(t[:, 1].min() - reach, -1.0))))
        j1 = min(ny - 1, int(np.floor(min(t[:, 1].max() + reach, 1e9))))
        k0 = max(0, int(np.ceil(max(t[:, 2].min() - reach, -1.0))))
        k1 = min(nz - 1, int(np.floor(min(t[:, 2].max() + reach, 1e9))))
        cx, cy, cz = t[:, 0].mean(), t[:, 1].mean(), t[:, 2].mean()
        radius = 0.0
        for c in range(3):
            radius = max(radius, np.sqrt((t[c, 0] - cx) ** 2 + (t[c, 1] - cy) ** 2 + (t[c, 2] - cz) ** 2))
        for i in range(i0, i1 + 1):
            for j in range(j0, j1 + 1):
                for k in range(k0, k1 + 1):
                    best = squared[i, j, k]
                    # The triangle lies within `radius` of its centre.
                    centre = (i - cx) ** 2 + (j - cy) ** 2 + (k - cz) ** 2
                    if centre < (np.sqrt(best) + radius) ** 2:
                        distance = _squared_distance(t, float(i), float(j), float(k))
                        squared[i, j, k] = min(best, np.float32(distance))


def unsigned_distance(triangles: np.ndarray, shape: tuple[int, int, int], reach: float, limit: float) -> np.ndarray:
    """Distance of every node of a grid of `shape` to the nearest of `triangles` [F, 3, 3] (in nodes): float32.

    Exact up to `reach` voxels; up to twice as far interpolated from a grid half as fine, and so on; clipped to `limit`.
    """
    triangles = np.ascontiguousarray(triangles, np.float64)
    if reach >= limit:
        reach = limit
    squared = np.full(shape, np.float32(reach) ** 2, dtype=np.float32)
    over_range(_near, shape[0], triangles, float(reach), squared, smallest=8)
    distance = np.sqrt(squared)
    if reach < limit:
        nx, ny, nz = (max(2, n // 2 + 1) for n in shape)
        coarse = unsigned_distance(triangles / 2, (nx, ny, nz), reach, limit / 2)
        far = resample(coarse, shape, 0.5) * np.float32(2)
        distance = np.where(squared < np.float32(reach) ** 2, distance, np.maximum(far, np.float32(reach)))
    return distance


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _crossings(
    triangles: np.ndarray,
    axis: int,
    signed: bool,
    beside: tuple[float, float],
    count: np.ndarray,
    start: int,
    stop: int,
) -> None:
    """count[a, b, c]: crossings of the grid line (a, b) along `axis` with the mesh between the nodes c - 1 and c."""
    _, nb, nc = count.shape
    first, second = (axis + 1) % 3, (axis + 2) % 3
    for n in range(triangles.shape[0]):
        t = triangles[n]
        x0, y0, z0 = t[0, first], t[0, second], t[0, axis]
        x1, y1, z1 = t[1, first], t[1, second], t[1, axis]
        x2, y2, z2 = t[2, first], t[2, second], t[2, axis]
        a0 = max(start, int(np.ceil(max(min(x0, x1, x2) - beside[0], -1.0))))
        a1 = min(stop - 1, int(np.floor(min(max(x0, x1, x2) - beside[0], 1e9))))
        if a0 > a1:
            continue
        b0 = max(0, int(np.ceil(max(min(y0, y1, y2) - beside[1], -1.0))))
        b1 = min(nb - 1, int(np.floor(min(max(y0, y1, y2) - beside[1], 1e9))))
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0.0:
            continue
        for a in range(a0, a1 + 1):
            x = a + beside[0]
            for b in range(b0, b1 + 1):
                y = b + beside[1]
                u = (x1 - x) * (y2 - y) - (x2 - x) * (y1 - y)
                v = (x2 - x) * (y0 - y) - (x0 - x) * (y2 - y)
                w = area - u - v
                if (u > 0.0) != (area > 0.0) or (v > 0.0) != (area > 0.0) or (w > 0.0) != (area > 0.0):
                    continue
                c = int(np.ceil(min(max((u * z0 + v * z1 + w * z2) / area, 0.0), float(nc))))
                if c < nc:
                    count[a, b, c] += (1 if area > 0.0 else -1) if signed else 1


def inside(triangles: np.ndarray, shape: tuple[int, int, int], oriented: bool) -> np.ndarray:
    """Which nodes of a grid of `shape` a closed mesh encloses: bool [nx, ny, nz]. triangles: [F, 3, 3] in nodes.

    Along each axis the crossings between the grid's border and a node are counted: their signed sum where the mesh is
    `oriented` (parts that overlap then count as one), else their parity. Two of three axes decide, so that a grid line
    that grazes an edge does no harm.
    """
    triangles = np.ascontiguousarray(triangles, np.float64)
    votes = np.zeros(shape, dtype=np.int8)
    for axis in range(3):
        order = ((axis + 1) % 3, (axis + 2) % 3, axis)
        count = np.zeros([shape[i] for i in order], dtype=np.int16)
        over_range(_crossings, count.shape[0], triangles, axis, oriented, _BESIDE, count, smallest=8)
        crossed = np.cumsum(count, axis=2, dtype=np.int16)
        votes += np.transpose((crossed != 0) if oriented else (crossed % 2 != 0), np.argsort(order))
    return votes >= 2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _behind(
    points: np.ndarray,
    projection: np.ndarray,
    depth: np.ndarray,
    tolerance: float,
    out: np.ndarray,
    start: int,
    stop: int,
) -> None:
    height, width = depth.shape
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        w = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
        out[n] = False
        if not w > 0.0:
            continue
        u = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / w
        v = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / w
        if 0.0 <= u < width and 0.0 <= v < height:
            out[n] = w > depth[int(v), int(u)] + tolerance


def behind(points: np.ndarray, projection: np.ndarray, depth: np.ndarray, tolerance: float) -> np.ndarray:
    """bool [n]: whether `points` [n, 3] lie more than `tolerance` behind `depth` [h, w]; outside the image they do not.

    projection: [3, 4], scene to pixels of the depth image.
    """
    out = np.empty(len(points), dtype=np.bool_)
    over_range(
        _behind,
        len(points),
        np.ascontiguousarray(points),
        np.ascontiguousarray(projection, np.float64),
        np.ascontiguousarray(depth, np.float32),
        float(tolerance),
        out,
        smallest=4096,
    )
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _share_behind(
    points: np.ndarray,
    projection: np.ndarray,
    depth: np.ndarray,
    tolerance: float,
    out: np.ndarray,
    start: int,
    stop: int,
) -> None:
    height, width = depth.shape
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        w = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
        out[n] = 0.0
        if not w > 0.0:
            continue
        u = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / w
        v = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / w
        if not (0.0 <= u < width and 0.0 <= v < height):
            continue
        column, row = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
        a, b = u - 0.5 - column, v - 0.5 - row
        left, right = max(column, 0), min(column + 1, width - 1)
        top, bottom = max(row, 0), min(row + 1, height - 1)
        reach = w - tolerance
        upper = (1 - a) * (reach > depth[top, left]) + a * (reach > depth[top, right])
        lower = (1 - a) * (reach > depth[bottom, left]) + a * (reach > depth[bottom, right])
        out[n] = (1 - b) * upper + b * lower


def share_behind(points: np.ndarray, projection: np.ndarray, depth: np.ndarray, tolerance: float) -> np.ndarray:
    """float32 [n] in [0, 1]: how much of a pixel about each of `points` [n, 3] lies more than `tolerance` in front of
    it, by the four pixels of `depth` [h, w] that are nearest; 0 outside the image.

    projection: as for `behind`.
    """
    out = np.empty(len(points), dtype=np.float32)
    over_range(
        _share_behind,
        len(points),
        np.ascontiguousarray(points),
        np.ascontiguousarray(projection, np.float64),
        np.ascontiguousarray(depth, np.float32),
        float(tolerance),
        out,
        smallest=4096,
    )
    return out
