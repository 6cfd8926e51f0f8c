"""All carriers of a sequence as one table, frame by frame (paper, Eq. carrier_union)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


def undeformed(count: int) -> np.ndarray:
    """F of `count` rows that is the identity and takes no memory: float32 [count, 3, 3], read-only."""
    return np.broadcast_to(np.eye(3, dtype=np.float32), (count, 3, 3))


def taken(deformation: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Some rows (bool [R] or int64 [n]) of F; of `undeformed` ones no memory is taken either."""
    if deformation.strides[0] == 0:
        return undeformed(int(np.count_nonzero(rows)) if rows.dtype == bool else len(rows))
    return np.asarray(deformation[rows])


@dataclass
class Carriers:
    """All carriers of a sequence, frame by frame.

    starts: int64 [T + 1]; the rows of frame t are starts[t]:starts[t + 1] of the arrays below. ids: int32 [R] carrier
    of each row, ascending within a frame. positions: float32 [R, 3] transport-grid coordinates. deformation: float16
    or float32 [R, 3, 3], F: the largest of these arrays. phi: float32 [R] at the carrier, transport voxels. count:
    number of carriers in all.
    """

    starts: np.ndarray
    ids: np.ndarray
    positions: np.ndarray
    deformation: np.ndarray
    phi: np.ndarray
    count: int

    @property
    def n_frames(self) -> int:
        return len(self.starts) - 1

    def rows(self, t: int) -> slice:
        """Rows of the carriers active in frame `t`."""
        return slice(int(self.starts[t]), int(self.starts[t + 1]))

    def births_and_ends(self) -> tuple[np.ndarray, np.ndarray]:
        """First and last active frame of every carrier, int32 [count] each (b_i and e_i of Eq. carrier_union)."""
        frame = np.repeat(np.arange(self.n_frames, dtype=np.int32), np.diff(self.starts))
        births = np.full(self.count, self.n_frames, dtype=np.int32)
        ends = np.full(self.count, -1, dtype=np.int32)
        np.minimum.at(births, self.ids, frame)
        np.maximum.at(ends, self.ids, frame)
        return births, ends

    def keep(self, chosen: np.ndarray) -> tuple[Carriers, np.ndarray]:
        """Only the carriers with `chosen` (bool [count]), renumbered; and the old number of each, int64."""
        old = np.nonzero(chosen)[0]
        new = np.full(self.count, -1, dtype=np.int32)
        new[old] = np.arange(len(old), dtype=np.int32)
        rows = chosen[self.ids]
        frame = np.repeat(np.arange(self.n_frames), np.diff(self.starts))
        counts = np.bincount(frame[rows], minlength=self.n_frames)
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        fewer = Carriers(
            starts,
            new[self.ids[rows]],
            self.positions[rows],
            taken(self.deformation, rows),
            self.phi[rows],
            len(old),
        )
        return fewer, old
