"""Particles at one and the same place: how many of them a search for neighbours has to look at.

A search among many points at one place takes the square of their number, in a list of cells as in a k-d tree. Where a
point's k nearest are asked for, k + 1 points at a place say all that any number of them do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Fewer points than this cost nothing, wherever they are.
_FEW = 1000


def limited_copies(points: NDArray[np.float64], most: int) -> tuple[NDArray[np.intp], NDArray[np.intp]] | None:
    """`points` [N, 3] with at most `most` at one place, or None where that leaves out none.

    Returns (kept, place): rows that stay [M], in order and the first of each place; and for each of the N points [N]
    the number, in kept, of one at its place, which is itself where it stays.
    """
    if len(points) <= max(most, _FEW):
        return None
    order = np.lexsort(points.T)
    ordered = points[order]
    starts = np.concatenate([[True], (ordered[1:] != ordered[:-1]).any(axis=1)])
    first = np.flatnonzero(starts)
    group = np.cumsum(starts) - 1
    copy = np.arange(len(points)) - first[group]
    if copy.max() < most:
        return None
    stays = np.zeros(len(points), dtype=bool)
    stays[order[copy < most]] = True
    kept = np.flatnonzero(stays)
    number = np.cumsum(stays) - 1
    place = np.empty(len(points), dtype=np.intp)
    place[order] = number[order[first]][group]
    place[kept] = np.arange(len(kept))
    return kept, place
