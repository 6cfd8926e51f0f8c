"""Carriers of all frames as whole numbers: where they are born, how long they last, and how the motion misses them.

A carrier's place in a frame is predicted from its place in the frame before by the fitted velocity; only the difference
is stored. F is not stored: it is the identity at birth, and the stored motion deforms it. Nor is phi at a carrier. The
prediction is made of single IEEE operations in double precision, so that every machine finds the same whole numbers.

How long a step is, the photographs decide: a sixteenth of a voxel where a voxel is about a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from splashbench.observe.grid import Grid
from splashbench.observe.kernels import sample
from splashbench.parallel import over_range
from splashbench.scene.geometry import STEPS_PER_VOXEL

from ..carriers.population import Carriers, taken
from ..carriers.precision import Precision
from ..fields.sparse_frames import Frames
from ..motion.steps import Motion
from ..motion.velocity import factors

#: Of velocities, in whole steps: those of 16 bits. They are at most 8 voxels a frame (`velocity_limit`).
MAX_VELOCITY = 32767
#: Carriers of all frames together: a few kilobytes of zeros could ask for more than there is memory.
MAX_ROWS = 1 << 26
_SMALL_LOOP = 1024


@dataclass(frozen=True)
class StoredRows:
    """births: uint32 [T], carriers born in each frame; they are numbered in this order. lives: uint16 [N], frames that
    each lasts. cells: int32 [N], the transport cell in which it is born (x-major), less that of the carrier before.
    within: uint8 [N, 3], where in the cell, in steps. residuals: whole numbers [R - N, 3], frame by frame in the order
    of numbers: how far each carrier that was there before is from where the motion leads, in steps."""

    births: NDArray[np.uint32]
    lives: NDArray[np.uint16]
    cells: NDArray[np.int32]
    within: NDArray[np.uint8]
    residuals: NDArray[np.signedinteger]


def whole_velocities(velocities: np.ndarray, precision: Precision) -> NDArray[np.int16]:
    """Voxels per frame in whole steps."""
    whole = np.rint(velocities.astype(np.float64) * precision.velocity_steps)
    steps = np.clip(whole, -MAX_VELOCITY, MAX_VELOCITY)
    return steps.astype(np.int16)


def stored_order(carriers: Carriers, shape: tuple[int, int, int], steps: int) -> Carriers:
    """The same carriers, numbered by the frame of their birth and there by cell: neighbours in space are neighbours
    in the files. steps: of `Precision`."""
    births, _ = carriers.births_and_ends()
    cells = _cell_numbers(_steps_of(carriers.positions[_first_rows(carriers)], shape, steps)[0], shape)
    order = np.lexsort((cells, births))
    new = np.empty(carriers.count, dtype=np.int32)
    new[order] = np.arange(carriers.count, dtype=np.int32)
    ids = new[carriers.ids]
    frame = np.repeat(np.arange(carriers.n_frames), np.diff(carriers.starts))
    rows = np.lexsort((ids, frame))
    return Carriers(
        carriers.starts,
        ids[rows],
        carriers.positions[rows],
        taken(carriers.deformation, rows),
        carriers.phi[rows],
        carriers.count,
    )


def store_rows(carriers: Carriers, control: NDArray[np.int16], motion: Motion, grid: Grid, steps: int) -> StoredRows:
    """Carriers in whole numbers; control: `whole_velocities` of the motion; steps: of `Precision`. Raises ValueError
    where a carrier's life has a gap, or carriers are not numbered by the frame of their birth."""
    births, ends = carriers.births_and_ends()
    lives = ends.astype(np.int64) - births + 1
    if (np.diff(births) < 0).any() or (lives < 1).any() or lives.sum() != len(carriers.ids):
        raise ValueError("carriers must be numbered by the frame of their birth and last without a gap")
    cells, within = _steps_of(carriers.positions[_first_rows(carriers)], grid.shape, steps)
    residuals = []
    places = _whole(carriers.positions[carriers.rows(0)], grid.shape, steps)
    for t in range(1, carriers.n_frames):
        before, now = carriers.rows(t - 1), carriers.rows(t)
        stays = births[carriers.ids[now]] < t
        rows = np.searchsorted(carriers.ids[before], carriers.ids[now][stays])
        predicted = _predicted(places[rows], control[t - 1], motion, steps)
        places = _whole(carriers.positions[now], grid.shape, steps)
        residuals.append((places[stays] - predicted).astype(np.int32))
    joined = np.concatenate(residuals) if residuals else np.zeros((0, 3), np.int32)
    kind = np.min_scalar_type(-int(np.abs(joined).max(initial=0)) - 1)
    return StoredRows(
        np.bincount(births, minlength=carriers.n_frames)[: carriers.n_frames].astype(np.uint32),
        np.minimum(lives, np.iinfo(np.uint16).max).astype(np.uint16),
        np.diff(_cell_numbers(cells, grid.shape), prepend=0).astype(np.int32),
        within.astype(np.uint8),
        joined.astype(kind),
    )


def read_rows(
    stored: StoredRows, control: NDArray[np.int16], motion: Motion, phi: Frames, grid: Grid, steps: int
) -> Carriers:
    """The carriers that `store_rows` was given, to within its precision. control, motion: as there; phi: int8
    [T, nx, ny, nz], packed; steps: of `Precision`.

    Raises ValueError where the numbers do not fit together.
    """
    n_frames, count = len(stored.births), len(stored.lives)
    if int(stored.births.sum(dtype=np.int64)) != count or stored.cells.shape != (count,):
        raise ValueError("births, lives and cells are of different numbers of carriers")
    if stored.within.shape != (count, 3) or stored.residuals.ndim != 2 or stored.residuals.shape[1] != 3:
        raise ValueError("positions are not of three coordinates each")
    if any(array.dtype.kind not in "iu" for array in (*vars(stored).values(), control)):
        raise ValueError("carriers or velocities are no whole numbers")
    if count and not 0 <= stored.within.min() <= stored.within.max() < steps:
        raise ValueError(f"a place in a cell is none of its {steps} steps")
    births = np.repeat(np.arange(n_frames), stored.births)
    lives = stored.lives.astype(np.int64)
    ends = births + lives
    if (lives < 1).any() or (ends > n_frames).any():
        raise ValueError("a carrier lasts beyond the last frame, or not at all")
    if int(lives.sum()) - count != len(stored.residuals):
        raise ValueError(f"{len(stored.residuals)} moves do not fit carriers with {int(lives.sum()) - count}")
    if int(lives.sum()) > MAX_ROWS:
        raise ValueError(f"{int(lives.sum())} rows are more than {MAX_ROWS}")
    cells = np.cumsum(stored.cells.astype(np.int64))
    if count and (cells.min() < 0 or cells.max() >= np.prod(grid.shape, dtype=np.int64)):
        raise ValueError("a carrier is born outside the grid")
    born = np.stack(np.unravel_index(cells, grid.shape), axis=1) * steps + stored.within
    identity = np.eye(3, dtype=np.float32)
    firsts = np.concatenate([[0], np.cumsum(stored.births, dtype=np.int64)])
    ids = np.zeros(0, dtype=np.int32)
    places, deformation = np.zeros((0, 3), np.int64), np.zeros((0, 3, 3), np.float32)
    # Filled frame by frame: parts that are joined would be in memory twice.
    total, row, at = int(lives.sum()), 0, 0
    read = Carriers(
        np.zeros(n_frames + 1, dtype=np.int64),
        np.empty(total, dtype=np.int32),
        np.empty((total, 3), dtype=np.float32),
        np.empty((total, 3, 3), dtype=np.float16),
        np.empty(total, dtype=np.float32),
        count,
    )
    for t in range(n_frames):
        if len(ids):
            stays = ends[ids] > t
            _, deformed = motion.step(t - 1).forecast(_voxels(places, steps), deformation)
            ids, places, deformation = ids[stays], places[stays], deformed[stays]
            moves = stored.residuals[at : at + len(ids)]
            at += len(ids)
            places = _clipped(_predicted(places, control[t - 1], motion, steps) + moves, grid.shape, steps)
        new = slice(int(firsts[t]), int(firsts[t + 1]))
        ids = np.concatenate([ids, np.arange(new.start, new.stop, dtype=np.int32)])
        places = np.concatenate([places, born[new]])
        deformation = np.concatenate([deformation, np.broadcast_to(identity, (new.stop - new.start, 3, 3))])
        rows = slice(row, row + len(ids))
        positions = _voxels(places, steps)
        read.ids[rows], read.positions[rows], read.deformation[rows] = ids, positions, deformation
        read.phi[rows] = sample(phi[t], positions) / np.float32(STEPS_PER_VOXEL)
        row = rows.stop
        read.starts[t + 1] = row
    return read


def _voxels(places: np.ndarray, steps: int) -> np.ndarray:
    return (places / steps).astype(np.float32)


def _first_rows(carriers: Carriers) -> np.ndarray:
    """The row of every carrier's first frame, int64 [count]."""
    rows = np.zeros(carriers.count, dtype=np.int64)
    rows[carriers.ids[::-1]] = np.arange(len(carriers.ids) - 1, -1, -1)
    return rows


def _clipped(places: np.ndarray, shape: tuple[int, int, int], steps: int) -> np.ndarray:
    return np.clip(places, 0, np.array(shape) * steps - 1).astype(np.int64)


def _steps_of(positions: np.ndarray, shape: tuple[int, int, int], steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Cells [n, 3], and places in them in steps."""
    places = _whole(positions, shape, steps)
    return places // steps, places % steps


def _whole(positions: np.ndarray, shape: tuple[int, int, int], steps: int) -> np.ndarray:
    """Places in whole steps, int64 [n, 3]."""
    return _clipped(np.rint(positions.astype(np.float64) * steps), shape, steps)


def _cell_numbers(cells: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    return (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]


def _predicted(places: np.ndarray, control: NDArray[np.int16], motion: Motion, steps: int) -> np.ndarray:
    """Where the motion leads from `places` [n, 3] in one frame, int64 [n, 3], in steps: by the velocity there."""
    moved = np.empty(places.shape, np.int64)
    wide = np.array(factors(motion.factor), dtype=np.float64)
    over_range(_predict, len(places), places, np.ascontiguousarray(control), wide, steps, moved, smallest=_SMALL_LOOP)
    return moved


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _predict(
    places: np.ndarray, control: np.ndarray, wide: np.ndarray, steps: int, moved: np.ndarray, start: int, stop: int
) -> None:
    # What is stored depends on the rounding of every line: the file format has them as they stand here.
    low, share = np.empty(3, np.int64), np.empty(3)
    for n in range(start, stop):
        for axis in range(3):
            place = (places[n, axis] / steps - 0.5 * (wide[axis] - 1)) / wide[axis]
            place = min(max(place, 0.0), control.shape[axis] - 1.0)
            low[axis] = min(int(np.floor(place)), control.shape[axis] - 2)
            share[axis] = place - low[axis]
        for axis in range(3):
            total = 0.0
            for a in range(2):
                x = share[0] if a else 1 - share[0]
                for b in range(2):
                    y = share[1] if b else 1 - share[1]
                    for c in range(2):
                        weight = x * y * (share[2] if c else 1 - share[2])
                        total = total + weight * control[low[0] + a, low[1] + b, low[2] + c, axis]
            moved[n, axis] = places[n, axis] + int(np.rint(total * 0.5))  # velocities in half a step
