"""Carriers of all frames as whole numbers: where they are born, how long they last, and how the motion misses them.

A carrier's place in a frame is predicted from its place in the frame before by the fitted velocity; only the difference
is stored. F is not stored: it is the identity at birth, and the stored motion deforms it. Nor is phi at a carrier. The
prediction is made of single IEEE operations in double precision, so that every machine finds the same whole numbers.
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
from ..motion.steps import Motion
from ..motion.velocity import factors

#: Whole steps per transport voxel, in which positions are stored. A voxel is about a pixel (`voxel_pixels`).
POSITION_STEPS = 32
#: The same for velocities, which are at most 8 voxels a frame (`velocity_limit`), and those of 16 bits.
VELOCITY_STEPS, MAX_VELOCITY = 64, 32767
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


def whole_velocities(velocities: np.ndarray) -> NDArray[np.int16]:
    """Voxels per frame in whole steps."""
    steps = np.clip(np.rint(velocities.astype(np.float64) * VELOCITY_STEPS), -MAX_VELOCITY, MAX_VELOCITY)
    return steps.astype(np.int16)


def stored_order(carriers: Carriers, shape: tuple[int, int, int]) -> Carriers:
    """The same carriers, numbered by the frame of their birth and there by cell: neighbours in space are neighbours
    in the files."""
    births, _ = carriers.births_and_ends()
    cells = _cell_numbers(_steps_of(carriers.positions[_first_rows(carriers)], shape)[0], shape)
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


def store_rows(carriers: Carriers, control: NDArray[np.int16], motion: Motion, grid: Grid) -> StoredRows:
    """Carriers in whole numbers; control: `whole_velocities` of the motion. Raises ValueError where a carrier's life
    has a gap, or carriers are not numbered by the frame of their birth."""
    births, ends = carriers.births_and_ends()
    lives = ends.astype(np.int64) - births + 1
    if (np.diff(births) < 0).any() or (lives < 1).any() or lives.sum() != len(carriers.ids):
        raise ValueError("carriers must be numbered by the frame of their birth and last without a gap")
    cells, within = _steps_of(carriers.positions[_first_rows(carriers)], grid.shape)
    residuals = []
    steps = _whole(carriers.positions[carriers.rows(0)], grid.shape)
    for t in range(1, carriers.n_frames):
        before, now = carriers.rows(t - 1), carriers.rows(t)
        stays = births[carriers.ids[now]] < t
        places = np.searchsorted(carriers.ids[before], carriers.ids[now][stays])
        predicted = _predicted(steps[places], control[t - 1], motion)
        steps = _whole(carriers.positions[now], grid.shape)
        residuals.append((steps[stays] - predicted).astype(np.int32))
    joined = np.concatenate(residuals) if residuals else np.zeros((0, 3), np.int32)
    kind = np.min_scalar_type(-int(np.abs(joined).max(initial=0)) - 1)
    return StoredRows(
        np.bincount(births, minlength=carriers.n_frames)[: carriers.n_frames].astype(np.uint32),
        np.minimum(lives, np.iinfo(np.uint16).max).astype(np.uint16),
        np.diff(_cell_numbers(cells, grid.shape), prepend=0).astype(np.int32),
        within.astype(np.uint8),
        joined.astype(kind),
    )


def read_rows(stored: StoredRows, control: NDArray[np.int16], motion: Motion, phi: np.ndarray, grid: Grid) -> Carriers:
    """The carriers that `store_rows` was given. control, motion: as there; phi: int8 [T, nx, ny, nz], packed.

    Raises ValueError where the numbers do not fit together.
    """
    n_frames, count = len(stored.births), len(stored.lives)
    if int(stored.births.sum(dtype=np.int64)) != count or stored.cells.shape != (count,):
        raise ValueError("births, lives and cells are of different numbers of carriers")
    if stored.within.shape != (count, 3) or stored.residuals.ndim != 2 or stored.residuals.shape[1] != 3:
        raise ValueError("positions are not of three coordinates each")
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
    born = np.stack(np.unravel_index(cells, grid.shape), axis=1) * POSITION_STEPS + stored.within
    identity = np.eye(3, dtype=np.float32)
    firsts = np.concatenate([[0], np.cumsum(stored.births, dtype=np.int64)])
    ids = np.zeros(0, dtype=np.int32)
    steps, deformation = np.zeros((0, 3), np.int64), np.zeros((0, 3, 3), np.float32)
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
            _, deformed = motion.step(t - 1).forecast(_voxels(steps), deformation)
            ids, steps, deformation = ids[stays], steps[stays], deformed[stays]
            moves = stored.residuals[at : at + len(ids)]
            at += len(ids)
            steps = _clipped(_predicted(steps, control[t - 1], motion) + moves, grid.shape)
        new = slice(int(firsts[t]), int(firsts[t + 1]))
        ids = np.concatenate([ids, np.arange(new.start, new.stop, dtype=np.int32)])
        steps = np.concatenate([steps, born[new]])
        deformation = np.concatenate([deformation, np.broadcast_to(identity, (new.stop - new.start, 3, 3))])
        rows = slice(row, row + len(ids))
        positions = _voxels(steps)
        read.ids[rows], read.positions[rows], read.deformation[rows] = ids, positions, deformation
        read.phi[rows] = sample(phi[t], positions) / np.float32(STEPS_PER_VOXEL)
        row = rows.stop
        read.starts[t + 1] = row
    return read


def _voxels(steps: np.ndarray) -> np.ndarray:
    return (steps / POSITION_STEPS).astype(np.float32)


def _first_rows(carriers: Carriers) -> np.ndarray:
    """The row of every carrier's first frame, int64 [count]."""
    rows = np.zeros(carriers.count, dtype=np.int64)
    rows[carriers.ids[::-1]] = np.arange(len(carriers.ids) - 1, -1, -1)
    return rows


def _clipped(steps: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    return np.clip(steps, 0, np.array(shape) * POSITION_STEPS - 1).astype(np.int64)


def _steps_of(positions: np.ndarray, shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Cells [n, 3], and places in them in steps."""
    steps = _whole(positions, shape)
    return steps // POSITION_STEPS, steps % POSITION_STEPS


def _whole(positions: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Places in whole steps, int64 [n, 3]."""
    return _clipped(np.rint(positions.astype(np.float64) * POSITION_STEPS), shape)


def _cell_numbers(cells: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    return (cells[:, 0] * shape[1] + cells[:, 1]) * shape[2] + cells[:, 2]


def _predicted(steps: np.ndarray, control: NDArray[np.int16], motion: Motion) -> np.ndarray:
    """Where the motion leads from `steps` [n, 3] in one frame, int64 [n, 3]: by the velocity there."""
    moved = np.empty(steps.shape, np.int64)
    wide = np.array(factors(motion.factor), dtype=np.float64)
    over_range(_predict, len(steps), steps, np.ascontiguousarray(control), wide, moved, smallest=_SMALL_LOOP)
    return moved


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _predict(
    steps: np.ndarray, control: np.ndarray, wide: np.ndarray, moved: np.ndarray, start: int, stop: int
) -> None:
    # What is stored depends on the rounding of every line: the file format has them as they stand here.
    low, share = np.empty(3, np.int64), np.empty(3)
    for n in range(start, stop):
        for axis in range(3):
            place = (steps[n, axis] / POSITION_STEPS - 0.5 * (wide[axis] - 1)) / wide[axis]
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
            moved[n, axis] = steps[n, axis] + int(np.rint(total * (POSITION_STEPS / VELOCITY_STEPS)))
