"""Compiled loops over grids: trilinear interpolation, and filling blocks of nodes.

The loops run on several threads (splashbench/parallel.py); each takes the part [start, stop) of its outermost range.
"""

from __future__ import annotations

import numba
import numpy as np

from splashbench.observe.carving import BLOCK
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
