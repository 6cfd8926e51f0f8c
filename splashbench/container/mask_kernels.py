"""Compiled loops over one view's mask: how far points lie within it, and how a mesh's silhouette overlaps it."""

from __future__ import annotations

import numba
import numpy as np

from splashbench.observe.mesh_kernels import EDGE_SLACK


@numba.njit(cache=True, nogil=True, error_model="numpy")
def least_within(distance: np.ndarray, projection: np.ndarray, points: np.ndarray, least: np.ndarray) -> None:
    """least [N] = min(least, pixels by which `points` [N, 3] lie within the mask), in place.

    distance: float32 [H, W], pixels within the mask at pixel centres. projection: float64 [3, 4], scene to pixels.
    Points beyond the image's border are taken as on it, and -inf stands for what is behind the camera.
    """
    height, width = distance.shape
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        depth = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
        if not depth > 0:
            least[n] = -np.inf
            continue
        u = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / depth - 0.5
        v = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / depth - 0.5
        u, v = min(max(u, 0.0), width - 1.0), min(max(v, 0.0), height - 1.0)
        column, row = int(u), int(v)
        beside, below = min(column + 1, width - 1), min(row + 1, height - 1)
        a, b = u - column, v - row
        upper = distance[row, column] * (1 - a) + distance[row, beside] * a
        lower = distance[below, column] * (1 - a) + distance[below, beside] * a
        least[n] = min(least[n], upper * (1 - b) + lower * b)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def overlap(
    vertices: np.ndarray, faces: np.ndarray, projection: np.ndarray, mask: np.ndarray, near: float
) -> tuple[int, int]:
    """Pixels that both a mesh's silhouette and `mask` (bool [H, W]) cover, and that either covers.

    vertices: float64 [V, 3]; faces: [F, 3]. The pixels are those of `mesh_kernels.raster`. Both are -1 where a vertex
    is nearer to the camera than `near`: what is cut off there takes more than this.
    """
    height, width = mask.shape
    pixels = np.empty((len(vertices), 2))
    for n in range(len(vertices)):
        x, y, z = vertices[n, 0], vertices[n, 1], vertices[n, 2]
        depth = projection[2, 0] * x + projection[2, 1] * y + projection[2, 2] * z + projection[2, 3]
        if not depth >= near:
            return -1, -1
        pixels[n, 0] = (projection[0, 0] * x + projection[0, 1] * y + projection[0, 2] * z + projection[0, 3]) / depth
        pixels[n, 1] = (projection[1, 0] * x + projection[1, 1] * y + projection[1, 2] * z + projection[1, 3]) / depth
    drawn = np.zeros(mask.shape, np.bool_)
    for n in range(len(faces)):
        x0, y0 = pixels[faces[n, 0]]
        x1, y1 = pixels[faces[n, 1]]
        x2, y2 = pixels[faces[n, 2]]
        first = max(0, int(np.ceil(max(min(y0, y1, y2), -1.0) - 0.5)))
        last = min(height - 1, int(np.floor(min(max(y0, y1, y2), height + 1.0) - 0.5)))
        left = max(0, int(np.ceil(max(min(x0, x1, x2), -1.0) - 0.5)))
        right = min(width - 1, int(np.floor(min(max(x0, x1, x2), width + 1.0) - 0.5)))
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0.0:
            continue
        for row in range(first, last + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                if drawn[row, column]:
                    continue
                x = column + 0.5
                a = ((x1 - x) * (y2 - y) - (x2 - x) * (y1 - y)) / area
                b = ((x2 - x) * (y0 - y) - (x0 - x) * (y2 - y)) / area
                drawn[row, column] = a >= -EDGE_SLACK and b >= -EDGE_SLACK and 1.0 - a - b >= -EDGE_SLACK
    both, either = 0, 0
    for row in range(height):
        for column in range(width):
            both += drawn[row, column] and mask[row, column]
            either += drawn[row, column] or mask[row, column]
    return both, either
