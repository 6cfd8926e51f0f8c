"""Compiled loops over one view: what a drawn silhouette holds, and how strong edges are along its outline."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, nogil=True, error_model="numpy")
def sum_within(says: np.ndarray, drawn: np.ndarray) -> int:
    """The sum of `says` (int8 [H, W]) where `drawn` (uint8 [H, W]) is 1; it is 0 elsewhere."""
    total = 0
    for row in range(says.shape[0]):
        for column in range(says.shape[1]):
            total += says[row, column] * drawn[row, column]
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def strength_along(outline: np.ndarray, across: np.ndarray, down: np.ndarray, seen: np.ndarray, along: int) -> float:
    """How much an image changes across `outline`, 0 to 1, in the mean over those of its pixels that are `seen`; 0 where
    none is.

    outline: int32 [N, 2], columns and rows, closed. across, down: float32 [H, W, C], changes along columns and rows, by
    what counts half. seen: bool [H, W]. along: an outline's direction is that between the pixels so many before and
    after. The channel that changes most counts.
    """
    count = len(outline)
    total, pixels = 0.0, 0
    for n in range(count):
        column, row = outline[n]
        if not seen[row, column]:
            continue
        after, before = outline[(n + along) % count], outline[(n - along) % count]
        x, y = float(after[0] - before[0]), float(after[1] - before[1])
        length = max(np.sqrt(x * x + y * y), 1e-6)
        change = 0.0
        for channel in range(across.shape[2]):
            change = max(change, abs(across[row, column, channel] * y - down[row, column, channel] * x))
        change /= length
        total += change / (change + 1)
        pixels += 1
    return total / pixels if pixels else 0.0
