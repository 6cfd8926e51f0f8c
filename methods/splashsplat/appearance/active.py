"""Which carriers of a frame one photograph teaches: those that its view may see, and that make up some of it.

The shell below the hull's surface is deep, and much of it is phantom volume. The images make its carriers transparent
within the first part of the fit. Others lie behind opaque liquid. Decoding them on would cost as much as decoding what
is seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from splashbench.gaussians.devices import CPU

from ..carriers.subframe import CarrierState, Track
from .cells import cell_numbers
from .decoder import ColorCells
from .targets import HIDDEN, TrainingTarget


@dataclass(frozen=True)
class Active:
    """n carriers that a photograph teaches. ids: int64 [n], their rows in the tables. places: int64 [n] among the
    frame's own that are left, or None for all of these. state: of the instant. cells: for the colour penalty. in_front:
    bool [n], those that lie before the container's near wall; None for none."""

    ids: Tensor
    places: Tensor | None
    state: CarrierState
    cells: ColorCells
    in_front: Tensor | None = None

    def to(self, device: str) -> Active:
        """The same on `device`."""
        if device == CPU:
            return self
        return Active(
            self.ids.to(device),
            None if self.places is None else self.places.to(device),
            self.state.to(device),
            ColorCells(self.cells.of_carriers.to(device), self.cells.sizes.to(device)),
            None if self.in_front is None else self.in_front.to(device),
        )


class ActiveCarriers:
    """The carriers of every frame of `track` that are left; all of them at first.

    color_cell: edge of the colour penalty's cells, transport voxels. ids: int64 [n] of each frame, rows of the tables;
    another list after `drop`.
    """

    def __init__(self, track: Track, color_cell: float) -> None:
        self._track = track
        frames = range(track.carriers.n_frames)
        self.ids = [track.ids(t) for t in frames]
        self._cells = [_cells(track, t, color_cell) for t in frames]
        # Of each frame's carriers in the track those that are left; None for all.
        self._left: list[Tensor | None] = [None for _ in frames]
        # By the target's identity: its frame, and which of this one's carriers that are left make up some of it, int32.
        self._focus: dict[int, tuple[int, Tensor]] = {}
        # By frame and part of a step: see `_phi_of`.
        self._phi: dict[tuple[int, float], np.ndarray] = {}

    def of(self, target: TrainingTarget) -> Active:
        """What `target` teaches."""
        t = target.frame
        left = self._left[t]
        places, visibility, taught = self._places(target), None, left
        if places is not None:
            taught = places if left is None else left.index_select(0, places)
        if target.hidden is not None:
            visibility = 1 - chosen(target.hidden, taught).to(torch.float32) / HIDDEN
        # Made anew each time: states of all frames would hold hundreds of megabytes on large scenes.
        phi = None if target.fraction == 0 else self._phi_of(t, target.fraction)
        state = self._track.state(t, target.fraction, None if taught is None else taught.numpy(), phi)
        state = replace(state, visibility=visibility)
        numbers = chosen(self._cells[t], places)
        # Cells of which none is left count one, as nothing may be divided by zero.
        sizes = torch.bincount(numbers).clamp_min(1).to(torch.float32)
        in_front = None if target.in_front is None else chosen(target.in_front, taught)
        return Active(chosen(self.ids[t], places), places, state, ColorCells(numbers, sizes), in_front)

    def _phi_of(self, t: int, fraction: float) -> np.ndarray:
        """Of all carriers of frame `t` as they are between frames; kept, as it takes two whole frames of distances."""
        if (t, fraction) not in self._phi:
            self._phi[t, fraction] = self._track.distances(t, fraction)
        return self._phi[t, fraction]

    def _places(self, target: TrainingTarget) -> Tensor | None:
        """int64, which of the target's frame's carriers that are left it teaches; None for all."""
        if id(target) in self._focus:
            return self._focus[id(target)][1].to(torch.int64)
        if target.hidden is None:
            return None
        return chosen(target.hidden < HIDDEN, self._left[target.frame]).nonzero()[:, 0]

    def focus(self, idle: Callable[[TrainingTarget, Active], Tensor], targets: Sequence[TrainingTarget]) -> None:
        """From now on each of `targets` teaches only those of its carriers that are not `idle` (bool, of the active
        ones). Carriers that are idle in all of theirs are left out. What was idle in some is looked at again."""
        self._focus = {}
        found, taught = (np.zeros(self._track.carriers.count, dtype=bool) for _ in range(2))
        for target in targets:
            active = self.of(target)
            useful = (~idle(target, active)).nonzero()[:, 0]
            found[active.ids.numpy()] = True
            taught[chosen(active.ids, useful).numpy()] = True
            places = useful if active.places is None else chosen(active.places, useful)
            self._focus[id(target)] = target.frame, places.to(torch.int32)
        # Those of frames without any photograph are shown all the same: they look like their neighbours.
        self.drop(torch.from_numpy(found & ~taught))

    def left(self, count: int) -> np.ndarray:
        """bool [count]: the carriers that are in any frame."""
        left = np.zeros(count, dtype=bool)
        for ids in self.ids:
            left[ids.numpy()] = True
        return left

    def drop(self, idle: Tensor) -> None:
        """Leave out the carriers `idle` (bool [count]) from now on."""
        self.ids, kept = list(self.ids), [~idle.index_select(0, ids) for ids in self.ids]
        for t, ids in enumerate(self.ids):
            left = kept[t].nonzero()[:, 0]
            before = self._left[t]
            self._left[t] = left if before is None else before.index_select(0, left)
            self.ids[t] = ids.index_select(0, left)
            self._cells[t] = self._cells[t].index_select(0, left)
        for target, (t, places) in self._focus.items():
            still = places.masked_select(kept[t].index_select(0, places))
            self._focus[target] = t, (kept[t].cumsum(0, dtype=torch.int32) - 1).index_select(0, still)


def _cells(track: Track, t: int, size: float) -> Tensor:
    """The numbers of the cells, of `size` transport voxels, that frame `t`'s carriers are in: int64 [n]."""
    keys = np.floor(track.carriers.positions[track.carriers.rows(t)] / size).astype(np.int64)
    return torch.from_numpy(cell_numbers(keys))


def chosen(values: Tensor, places: Tensor | None) -> Tensor:
    """The rows of `values` at `places` (int64 [n]); all of them without."""
    return values if places is None else values.index_select(0, places)
