"""Which cells become anchors (Lu et al. 2024, Sec. 3.3), in space or in space-time.

A cell becomes an anchor where a Gaussian within it is pulled at by more than a threshold and there is no anchor yet,
level by level: coarse cells first, finer ones for stronger pulls. A random share of the candidates is left out, a
smaller one at finer levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_CELL_LIMIT = 1 << 20


@dataclass(frozen=True)
class GrowthLevel:
    """Cells of `size` times the finest, for pulls of `factor` times the threshold; `kept`: share of the candidates."""

    size: float
    factor: float
    kept: float


#: As published: level m = 0, 1, 2 has cells of 16, 4, 1 times the finest and 2^m times the threshold, and keeps each
#: candidate with the probability 1 - 2^-(m + 1). The paper leaves this share open; it is the official code's.
LEVELS = (GrowthLevel(16.0, 1.0, 0.5), GrowthLevel(4.0, 2.0, 0.75), GrowthLevel(1.0, 4.0, 0.875))


@dataclass(frozen=True)
class NewCells:
    """Cells that become anchors: centers [n, D], the candidates that speak for them [n], their sizes in space [n]."""

    centers: NDArray[np.float64]
    chosen: NDArray[np.int64]
    sizes: NDArray[np.float64]


def new_cells(
    candidates: NDArray[np.float64],
    pulls: NDArray[np.floating],
    anchors: NDArray[np.float64],
    finest: NDArray[np.float64],
    levels: Sequence[GrowthLevel],
    threshold: float,
    room: int,
    rng: np.random.Generator,
) -> NewCells:
    """At most `room` cells to become anchors; no two in one cell.

    candidates: [C, D] positions of Gaussians, x y z or x y z t; pulls: [C]. anchors: [N, D], those that there are.
    finest: [D], sizes of the finest cell. A cell's size in time is the same at all levels.
    """
    # The strongest first: it stands for its cell, and gets the room that is left.
    order = np.argsort(-pulls, kind="stable")
    order = order[pulls[order] > threshold]
    dimensions = candidates.shape[1]
    centers: list[NDArray] = [np.empty((0, dimensions))]
    chosen: list[NDArray] = [np.empty(0, np.int64)]
    sizes: list[NDArray] = [np.empty(0)]
    for rule in levels:
        cell = finest.copy()
        cell[:3] *= rule.size
        level = order[pulls[order] > rule.factor * threshold]
        level = level[rng.random(len(level)) < rule.kept]
        keys, taken = _keys(candidates[level], np.concatenate([anchors, *centers]), cell)
        first = np.sort(np.unique(keys, return_index=True)[1])
        first = first[~np.isin(keys[first], taken)][:room]
        room -= len(first)
        centers.append(np.round(candidates[level[first]] / cell) * cell)
        chosen.append(level[first])
        sizes.append(np.full(len(first), cell[0]))
    return NewCells(np.concatenate(centers), np.concatenate(chosen), np.concatenate(sizes))


def _keys(
    first: NDArray[np.float64], second: NDArray[np.float64], cell: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """A number for each row of both [., D], shared within a cell (and by those a million cells away)."""
    points = np.concatenate([first, second])
    index = np.clip(np.round(points / cell), -_CELL_LIMIT, _CELL_LIMIT - 1).astype(np.int64) + _CELL_LIMIT
    keys = (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]
    if points.shape[1] == 4:  # a fourth index does not fit in: the places are numbered through first
        keys = (np.unique(keys, return_inverse=True)[1].reshape(-1) << 21) | index[:, 3]
    return keys[: len(first)], keys[len(first) :]
