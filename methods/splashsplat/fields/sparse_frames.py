"""Packed phi of all frames in little memory: blocks of 4x4x4 nodes, and of those that are all alike the value alone.

What is stored of phi ends three voxels from the surface, and most blocks lie beyond: a splash takes a tenth of what
its nodes would. A frame is made whole where it is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numba
import numpy as np
from numpy.typing import NDArray

_BLOCK = 4


class Frames(Protocol):
    """int8 [T, nx, ny, nz], one frame after another: an array, or `SparseFrames`. nbytes: as an array."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def nbytes(self) -> int: ...

    def __len__(self) -> int: ...

    def __getitem__(self, t: int, /) -> NDArray[np.int8]: ...


class SparseFrames:
    """int8 frames [nx, ny, nz] in turn; `append` adds one."""

    def __init__(self, shape: tuple[int, int, int], frames: Iterable[NDArray[np.int8]] = ()) -> None:
        """Raises ValueError where a frame is not int8 of `shape`."""
        self._shape = shape
        self._frames: list[_Frame] = []
        for frame in frames:
            self.append(frame)

    @property
    def shape(self) -> tuple[int, ...]:
        return len(self._frames), *self._shape

    @property
    def nbytes(self) -> int:
        """Of all nodes as an array."""
        return math.prod(self.shape)

    @property
    def held_bytes(self) -> int:
        """What is in memory."""
        return sum(array.nbytes for frame in self._frames for array in vars(frame).values())

    def append(self, frame: NDArray[np.int8]) -> None:
        """Add a frame. Raises ValueError where it is not int8 of the shape of the others."""
        if frame.dtype != np.int8 or frame.shape != self._shape:
            raise ValueError(f"a frame is {frame.dtype} {frame.shape}, not int8 {self._shape}")
        first = np.ascontiguousarray(frame[::_BLOCK, ::_BLOCK, ::_BLOCK])
        varied = np.zeros(first.shape, dtype=bool)
        _find_varied(frame, first, varied)
        places = np.flatnonzero(varied).astype(np.int32)
        held = _Frame(first, places, np.zeros((len(places), _BLOCK, _BLOCK, _BLOCK), np.int8))
        _copy_blocks(frame, held.numbers(), held.blocks)
        self._frames.append(held)

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[NDArray[np.int8]]:
        return (self[t] for t in range(len(self)))

    def __getitem__(self, t: int) -> NDArray[np.int8]:
        held = self._frames[t]
        nx, ny, nz = self._shape
        # Four nodes at once: a row of a block is one whole number.
        alike = np.repeat(held.first, _BLOCK, axis=2).view(np.int32)
        frame = np.empty((nx, ny, alike.shape[2]), np.int32)
        _fill(alike, held.places, held.blocks.view(np.int32)[..., 0], frame)
        return np.ascontiguousarray(frame.view(np.int8)[..., :nz])

    def __array__(self, dtype: np.dtype[np.int8] | None = None, copy: bool | None = None) -> NDArray[np.int8]:
        """All nodes."""
        whole = np.empty(self.shape, np.int8)
        for t, frame in enumerate(self):
            whole[t] = frame
        return whole if dtype is None else whole.astype(dtype, copy=False)


@dataclass(frozen=True)
class _Frame:
    """first: int8 [bx, by, bz], the value of each block's first node. places: int32 [n], which blocks are not all
    alike, counted along z first. blocks: int8 [n, 4, 4, 4], these, 0 beyond the frame."""

    first: NDArray[np.int8]
    places: NDArray[np.int32]
    blocks: NDArray[np.int8]

    def numbers(self) -> NDArray[np.int32]:
        """int32 [bx, by, bz], which of `blocks` each is; -1 for those that are all alike."""
        numbers = np.full(self.first.shape, -1, dtype=np.int32)
        numbers.reshape(-1)[self.places] = np.arange(len(self.places), dtype=np.int32)
        return numbers


@numba.njit(cache=True, nogil=True)
def _find_varied(frame: np.ndarray, first: np.ndarray, varied: np.ndarray) -> None:
    """Finds the blocks of `frame` in which a node differs from the first."""
    nx, ny, nz = frame.shape
    for x in range(nx):
        for y in range(ny):
            i, j = x // _BLOCK, y // _BLOCK
            for z in range(nz):
                if frame[x, y, z] != first[i, j, z // _BLOCK]:
                    varied[i, j, z // _BLOCK] = True


@numba.njit(cache=True, nogil=True)
def _copy_blocks(frame: np.ndarray, numbers: np.ndarray, blocks: np.ndarray) -> None:
    """Copies to `blocks` those of `frame` whose number is not below 0."""
    nx, ny, nz = frame.shape
    for x in range(nx):
        for y in range(ny):
            row = numbers[x // _BLOCK, y // _BLOCK]
            for z in range(nz):
                if row[z // _BLOCK] >= 0:
                    blocks[row[z // _BLOCK], x % _BLOCK, y % _BLOCK, z % _BLOCK] = frame[x, y, z]


@numba.njit(cache=True, nogil=True)
def _fill(alike: np.ndarray, places: np.ndarray, blocks: np.ndarray, frame: np.ndarray) -> None:
    """Fills `frame`, int32 [nx, ny, bz]. alike: int32 [bx, by, bz], the rows of blocks that are all alike; blocks:
    int32 [n, 4, 4], the rows of those at `places`."""
    nx, ny, nz = frame.shape
    for x in range(nx):
        for y in range(ny):
            i, j = x // _BLOCK, y // _BLOCK
            for z in range(nz):
                frame[x, y, z] = alike[i, j, z]
    for n in range(len(places)):
        z = places[n] % nz
        j = places[n] // nz % alike.shape[1]
        i = places[n] // nz // alike.shape[1]
        for x in range(_BLOCK * i, min(_BLOCK * (i + 1), nx)):
            for y in range(_BLOCK * j, min(_BLOCK * (j + 1), ny)):
                frame[x, y, z] = blocks[n, x % _BLOCK, y % _BLOCK]
