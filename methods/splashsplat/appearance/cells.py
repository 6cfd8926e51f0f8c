"""Cells of space, or of space and time, numbered from 0 without gaps."""

from __future__ import annotations

import numpy as np

# Numbers of cells, those without anything in them included, that still go into an int64.
_MOST = 2.0**62


def cell_numbers(cells: np.ndarray) -> np.ndarray:
    """Which of the distinct rows of `cells` (int64 [n, dimensions]) each row is, in their order: int64 [n]."""
    if len(cells) == 0:
        return np.zeros(0, dtype=np.int64)
    low = cells.min(axis=0)
    sides = cells.max(axis=0) - low + 1
    if np.prod(sides.astype(np.float64)) >= _MOST:
        return np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    # One number for each cell sorts many times faster than rows do.
    keys = np.ravel_multi_index(tuple((cells - low).T), tuple(sides))
    return np.unique(keys, return_inverse=True)[1].reshape(-1)
