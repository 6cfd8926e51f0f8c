"""Which splats touch which tile of the image, each tile's list from front to back.

Splats are sorted by depth once, by radix on the bits of the (positive) float32 depth, stably, so that equal depths keep
the order of the input; then a counting sort deals them into tiles. Nothing depends on the number of threads.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from splashbench.render.constants import TILE_HEIGHT, TILE_WIDTH
from splashbench.render.projection import HALF_HEIGHT, HALF_WIDTH, SPLAT_COLUMNS, X, Y

_RADIX_BITS = 11
_RADIX_SIZE = 1 << _RADIX_BITS
_HALF_PIXEL = np.float32(0.5)
# Rounding must not cut a footprint short: whether a pixel takes part is decided by its own alpha, not here.
_SLACK = np.float32(2e-3)


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """(rows, columns) of tiles of a `width` x `height` image."""
    return -(-height // TILE_HEIGHT), -(-width // TILE_WIDTH)


def tile_mask(pixels: np.ndarray) -> np.ndarray:
    """The tiles that hold at least one True pixel: bool [tile rows, tile columns] from bool [H, W]."""
    pixels = np.asarray(pixels, dtype=bool)
    rows, columns = tile_grid(pixels.shape[1], pixels.shape[0])
    padded = np.zeros((rows * TILE_HEIGHT, columns * TILE_WIDTH), dtype=bool)
    padded[: pixels.shape[0], : pixels.shape[1]] = pixels
    return np.asarray(padded.reshape(rows, TILE_HEIGHT, columns, TILE_WIDTH).any(axis=(1, 3)))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _tile_range(center: float, half: float, size: int, count: int) -> tuple[int, int]:
    """First and one past the last tile along one axis whose pixel centres the interval center +- half can hold."""
    first = max(0, math.floor((center - half - _HALF_PIXEL - _SLACK) / size))
    last = min(count - 1, math.floor((center + half - _HALF_PIXEL + _SLACK) / size))
    return first, last + 1


@numba.njit(nogil=True, cache=True, error_model="numpy")
def sort_into_tiles(
    splats: np.ndarray, depths: np.ndarray, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Sort the drawn splats by depth and list them by tile.

    Args:
        splats: float32 [N, SPLAT_COLUMNS], depths: float32 [N], -1 where not drawn (see projection.project).
        mask: bool [tile rows, tile columns]; tiles that are False get empty lists.

    Returns:
        ids: int64 [M], the Gaussian behind each drawn splat, by depth.
        ordered: float32 [M, SPLAT_COLUMNS], the table by depth.
        slot_starts: int64 [M + 1]; splat k owns one gradient slot per tile it touches, from slot_starts[k].
        tile_starts: int64 [tiles + 1]; tile t's list is [tile_starts[t], tile_starts[t + 1]).
        entries: int32 [S, 2], the splat and its slot.
    """
    bits = depths.view(np.uint32)
    count = 0
    for i in range(len(depths)):
        count += depths[i] > np.float32(0.0)
    ids = np.empty(count, np.int64)
    other = np.empty(count, np.int64)
    k = 0
    for i in range(len(depths)):
        if depths[i] > np.float32(0.0):
            ids[k] = i
            k += 1
    histogram = np.empty(_RADIX_SIZE + 1, np.int64)
    for sweep in range(3):
        shift = np.uint32(sweep * _RADIX_BITS)
        histogram[:] = 0
        for k in range(count):
            histogram[((bits[ids[k]] >> shift) & np.uint32(_RADIX_SIZE - 1)) + np.uint32(1)] += 1
        for digit in range(_RADIX_SIZE):
            histogram[digit + 1] += histogram[digit]
        for k in range(count):
            digit = (bits[ids[k]] >> shift) & np.uint32(_RADIX_SIZE - 1)
            other[histogram[digit]] = ids[k]
            histogram[digit] += 1
        ids, other = other, ids

    rows, columns = mask.shape
    ordered = np.empty((count, SPLAT_COLUMNS), np.float32)
    slot_starts = np.zeros(count + 1, np.int64)
    tile_starts = np.zeros(rows * columns + 1, np.int64)
    for k in range(count):
        for column in range(SPLAT_COLUMNS):
            ordered[k, column] = splats[ids[k], column]
        s = ordered[k]
        top, bottom = _tile_range(s[Y], s[HALF_HEIGHT], TILE_HEIGHT, rows)
        left, right = _tile_range(s[X], s[HALF_WIDTH], TILE_WIDTH, columns)
        touched = 0
        for row in range(top, bottom):
            for column in range(left, right):
                if mask[row, column]:
                    tile_starts[row * columns + column + 1] += 1
                    touched += 1
        slot_starts[k + 1] = slot_starts[k] + touched
    for tile in range(rows * columns):
        tile_starts[tile + 1] += tile_starts[tile]
    entries = np.empty((tile_starts[rows * columns], 2), np.int32)
    cursor = tile_starts[:-1].copy()
    for k in range(count):
        slot = slot_starts[k]
        if slot == slot_starts[k + 1]:
            continue
        s = ordered[k]
        top, bottom = _tile_range(s[Y], s[HALF_HEIGHT], TILE_HEIGHT, rows)
        left, right = _tile_range(s[X], s[HALF_WIDTH], TILE_WIDTH, columns)
        for row in range(top, bottom):
            for column in range(left, right):
                if mask[row, column]:
                    entry = cursor[row * columns + column]
                    entries[entry, 0], entries[entry, 1] = k, slot
                    cursor[row * columns + column] += 1
                    slot += 1
    return ids, ordered, slot_starts, tile_starts, entries
