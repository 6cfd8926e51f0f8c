"""Features that carriers share while they are fitted: what is near in space and time looks alike.

A carrier lasts a few frames, and a handful of photographs show it. Alone, it would learn its looks from these only. So
its feature is a sum: its own part, and one for each size of cell. It shares that one with every carrier that was born
in the same cell of space and time. A photograph then teaches neighbours, too. Where liquid is still, as in a pool,
cells that last for the whole sequence let every photograph of a place teach all carriers there. At the end the sum
replaces the parts: decoder and files know nothing of them. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from splashbench.gaussians.devices import CPU

from ..carriers.population import Carriers
from ..kernel.shared import SharedRows, added_by_member
from .active import chosen
from .cells import cell_numbers
from .optimizer import RowAdam

# Carriers whose features are summed up at once.
_BLOCK = 1 << 16


@dataclass(frozen=True)
class _FeatureLevel:
    """Cells of one size. cells: int32 [count] of all carriers. table: [cells, width], what each cell adds. rows,
    members: per frame the cells of its carriers, ascending, and which of these each carrier is in; int32."""

    cells: Tensor
    table: Tensor
    adam: RowAdam
    rows: list[Tensor]
    members: list[Tensor]


class SharedFeatures:
    """The features of `carriers` as sums; see above.

    own: float32 [count, width], the carriers' own parts at first; updated in place. All lies where it does. ids: int64
    [n] of each frame, its carriers' rows there. sizes: of the cells, in transport voxels and, by the same number, in
    frames; none where nothing is shared. still_size: of cells that last for all frames, in transport voxels; 0 for
    none. own_rate, shared_rate: of learning.
    """

    def __init__(
        self,
        own: Tensor,
        carriers: Carriers,
        ids: list[Tensor],
        sizes: Sequence[float],
        still_size: float,
        own_rate: float,
        shared_rate: float,
        seed: int,
    ) -> None:
        self._own, self._adam = own, RowAdam(own, own_rate)
        ids = self._ids = [of_frame.to(own.device) for of_frame in ids]
        self._levels: list[_FeatureLevel] = []
        # On the CPU, what adds the levels up.
        self._rows: SharedRows | None = None
        extents = [(size, size) for size in sizes]
        if still_size > 0:
            extents.append((still_size, np.inf))
        if not extents:
            return
        born = births(carriers)
        # Cells of different sizes have their faces at different places.
        rng = np.random.default_rng([seed, 4])
        for size, frames in extents:
            cells = torch.from_numpy(cells_of(born, size, frames, rng.random(4)).astype(np.int32)).to(own.device)
            table = own.new_zeros(int(cells.max()) + 1 if len(cells) else 0, own.shape[1])
            self._levels.append(_FeatureLevel(cells, table, RowAdam(table, shared_rate), *_by_frame(cells, ids)))
        if own.device.type == CPU and own.dtype == torch.float32:
            levels = self._levels
            self._rows = SharedRows(own, [level.table for level in levels], [level.cells for level in levels])

    def keep(self, ids: list[Tensor]) -> None:
        """Go on with the carriers `ids` of each frame alone."""
        ids = self._ids = [of_frame.to(self._own.device) for of_frame in ids]
        self._levels = [
            replace(level, rows=rows, members=members)
            for level in self._levels
            for rows, members in [_by_frame(level.cells, ids)]
        ]

    def of_frame(self, t: int, places: Tensor | None = None) -> Tensor:
        """Features of the carriers of frame `t` [n, width], or of those at `places` (int64 [n]) among them."""
        return self._sum(chosen(self._ids[t], places))

    def all(self) -> Tensor:
        """Features of all carriers, [count, width]."""
        return self._summed(torch.empty_like(self._own))

    def joined(self) -> Tensor:
        """`all`, in the place of their own parts: the end of sharing."""
        self._summed(self._own)
        self._levels, self._rows = [], None
        del self._adam  # no step comes after this
        return self._own

    def _summed(self, whole: Tensor) -> Tensor:
        row = 0
        for block in self.blocks():
            whole[row : row + len(block)] = block
            row += len(block)
        return whole

    def blocks(self) -> Iterator[Tensor]:
        """Features of all carriers, [., width] in turn: those of all at once would be what takes most memory."""
        for rows in torch.arange(len(self._own), device=self._own.device).split(_BLOCK):
            yield self._sum(rows)

    def step(self, t: int, gradient: Tensor, factor: float, places: Tensor | None = None) -> None:
        """Descend along the `gradient` [n, width] of what `of_frame` gave; `factor` scales the rates."""
        self._adam.step(chosen(self._ids[t], places), gradient, factor)
        for level in self._levels:
            level.adam.step(level.rows[t].to(torch.int64), self._summed_by_cell(level, t, gradient, places), factor)

    def _summed_by_cell(self, level: _FeatureLevel, t: int, gradient: Tensor, places: Tensor | None) -> Tensor:
        rows, members = level.rows[t], level.members[t]
        if self._rows is not None:
            return added_by_member(gradient, members, len(rows), places)
        # Sums by int32 take six times as long.
        of_rows = chosen(members, places).to(torch.int64)
        return gradient.new_zeros(len(rows), gradient.shape[1]).index_add_(0, of_rows, gradient)

    def _sum(self, ids: Tensor) -> Tensor:
        if self._rows is not None:
            return self._rows.of(ids)
        features = self._own.index_select(0, ids)
        for level in self._levels:
            features += level.table.index_select(0, level.cells.index_select(0, ids))
        return features


def _by_frame(cells: Tensor, ids: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    """Per frame, with carriers `ids`: the cells that they are in, ascending, and which of these each is in."""
    found = [_cells_and_members(cells.index_select(0, of_frame)) for of_frame in ids]
    return [rows for rows, _ in found], [members for _, members in found]


def _cells_and_members(cells: Tensor) -> tuple[Tensor, Tensor]:
    rows, members = torch.unique(cells, return_inverse=True)
    return rows.to(torch.int32), members.to(torch.int32)


def births(carriers: Carriers) -> np.ndarray:
    """Where (transport-grid coordinates) and when (frames) each carrier was born, float64 [count, 4]."""
    first, _ = carriers.births_and_ends()
    born = np.zeros((carriers.count, 4))
    born[:, 3] = first
    for t in range(carriers.n_frames):
        rows = carriers.rows(t)
        new = first[carriers.ids[rows]] == t
        born[carriers.ids[rows][new], :3] = carriers.positions[rows][new]
    return born


def cells_of(born: np.ndarray, size: float, frames: float, shift: np.ndarray) -> np.ndarray:
    """The cell of each of `born` [count, 4] (see `births`), int64 [count] numbered from 0 without gaps.

    size, frames: of a cell, in transport voxels and in frames, which may be infinite. shift: [4] where its faces are
    along x, y, z and time, in cells.
    """
    keys = np.floor(born / np.array([size, size, size, frames]) + shift).astype(np.int64)
    return cell_numbers(keys)
