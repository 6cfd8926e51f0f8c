"""Whole numbers as a string of bytes, compiled: an adaptive binary range coder, with what was coded before as context.

Numbers are taken apart into yes-or-no questions: is it zero, its sign, its digits. Each question has a probability of
its own for each context, which moves a 32nd of the way towards each answer, and a range coder turns answers into bytes
(Martin, "Range encoding", 1979; carries and adaptation as in LZMA, with probabilities of 12 bits). storage/FORMAT.md
has all of it in words.

Three kinds of numbers are coded: tables, whose rows may resemble the rows before; fields on a grid; and signed
distances, which change near the surface alone. What is read from strangers raises ValueError where no writer gave it,
where so few bytes cannot be so much, and where it is more than any file of this project may hold.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from splashbench.native.library import DONE, OUT_OF_MEMORY

from .library import KERNEL

# A sure answer costs a 92nd of a bit: so many numbers, or blocks, can a byte stand for at the most.
_PER_BYTE = 8 * 92
# Numbers of an array, at the most: 2 GiB of the longest ones, as much as an archive may unpack to. A code that is all
# zeros is next to nothing in an archive.
_MOST = 1 << 29
_BLOCK = 4
_LARGEST = np.iinfo(np.int32).max
# Each column of a table has contexts of its own, some kilobytes of them.
_MOST_COLUMNS = 8192

#: What of a table is context: none, the two rows before, or these and the two columns before.
Near = Literal[0, 1, 2]


class FramesOfNumbers(Protocol):
    """int8 [T, nx, ny, nz], one frame after another."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __len__(self) -> int: ...

    def __getitem__(self, t: int, /) -> NDArray[np.int8]: ...


class _Code:
    """What the kernel writes, or reads from `code`; to be used in a with statement."""

    def __init__(self, code: NDArray[np.uint8] | None = None) -> None:
        self._read = None if code is None else np.ascontiguousarray(code)
        if self._read is None:
            self._handle = KERNEL.library.splash_code_begin(None, 0)
        else:
            # No address of an empty array is surely other than null, which would mean that it is to be written.
            self._read = np.concatenate([self._read, np.zeros(1, np.uint8)])
            self._handle = KERNEL.library.splash_code_begin(_address(self._read), len(self._read) - 1)
        if not self._handle:
            raise MemoryError("there is no memory left for a code")

    def __enter__(self) -> _Code:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, where: TracebackType | None
    ) -> None:
        KERNEL.library.splash_code_end(self._handle)

    def table(self, table: NDArray[np.int32], near: Near) -> bool:
        """False for what no writer gave; so for the others."""
        return _done(KERNEL.library.splash_code_table(self._handle, _address(table), *table.shape, near))

    def field(self, field: NDArray[np.int16]) -> bool:
        shape = (ctypes.c_int64 * 5)(*field.shape)
        return _done(KERNEL.library.splash_code_field(self._handle, _address(field), shape))

    def frame(
        self, now: NDArray[np.int8], before: NDArray[np.int8], changed: NDArray[np.uint8], ends: tuple[int, int]
    ) -> bool:
        shape = (ctypes.c_int64 * 3)(*now.shape)
        places = (_address(array) for array in (now, before, changed))
        return _done(KERNEL.library.splash_code_frame(self._handle, *places, shape, *ends))

    def written(self) -> NDArray[np.uint8]:
        """All of it."""
        size = KERNEL.library.splash_code_finish(self._handle)
        if size < 0:
            raise MemoryError("there is no memory left for a code")
        out = np.empty(size, np.uint8)
        KERNEL.library.splash_code_copy(self._handle, _address(out))
        return out

    def all_read(self) -> bool:
        """Whether it is at its end, and not beyond."""
        return bool(KERNEL.library.splash_code_finish(self._handle) == 0)


def _address(array: NDArray[np.generic]) -> int:
    return int(array.ctypes.data)


def _done(status: int) -> bool:
    if status == OUT_OF_MEMORY:
        raise MemoryError("there is no memory left for a code")
    return status == DONE


def write_table(table: NDArray[np.integer], near: Near) -> NDArray[np.uint8]:
    """The code of a table [rows, columns] of whole numbers. Raises ValueError where one has more than 31 bits and a
    sign."""
    if table.size and not -_LARGEST <= int(table.min()) <= int(table.max()) <= _LARGEST:
        raise ValueError(f"numbers from {int(table.min())} to {int(table.max())} are too large to be coded")
    with _Code() as code:
        code.table(np.ascontiguousarray(table, dtype=np.int32), near)
        return code.written()


def read_table(code: NDArray[np.uint8], shape: tuple[int, int], near: Near) -> NDArray[np.int32]:
    """The table [rows, columns] that `write_table` was given. Raises ValueError where the code is of no such table."""
    _require_code(code, shape)
    if shape[1] > _MOST_COLUMNS:
        raise ValueError(f"a table of {shape[1]} columns; no more than {_MOST_COLUMNS} are coded")
    table = np.zeros(shape, np.int32)
    with _Code(code) as given:
        if not given.table(table, near) or not given.all_read():
            raise ValueError(f"{len(code)} bytes are not the code of {shape[0]} x {shape[1]} numbers")
    return table


def write_field(field: NDArray[np.int16]) -> NDArray[np.uint8]:
    """The code of a field [frames, nx, ny, nz, components]."""
    with _Code() as code:
        code.field(np.ascontiguousarray(field, dtype=np.int16))
        return code.written()


def read_field(code: NDArray[np.uint8], shape: tuple[int, int, int, int, int]) -> NDArray[np.int16]:
    """The field that `write_field` was given. Raises ValueError where the code is of no field of this shape."""
    _require_code(code, shape)
    field = np.zeros(shape, np.int16)
    with _Code(code) as given:
        if not given.field(field) or not given.all_read():
            raise ValueError(f"{len(code)} bytes are not the code of {'x'.join(map(str, shape))} numbers")
    return field


def write_frames(frames: FramesOfNumbers, ends: tuple[int, int]) -> NDArray[np.uint8]:
    """The code of frames [T, nx, ny, nz] of numbers from ends[0] to ends[1]."""
    before, changed = _begun(frames.shape[1:])
    with _Code() as code:
        for t in range(len(frames)):
            now = np.ascontiguousarray(frames[t])
            code.frame(now, before, changed, ends)
            before = now
        return code.written()


def read_frames(code: NDArray[np.uint8], shape: tuple[int, ...], ends: tuple[int, int]) -> Iterator[NDArray[np.int8]]:
    """The frames that `write_frames` was given, one after the other, each to be left as it is. Raises ValueError where
    the code is of no such frames."""
    _require_code(code, (shape[0], *_blocks(shape[1:])))
    before, changed = _begun(shape[1:])
    with _Code(code) as given:
        for t in range(shape[0]):
            now = before.copy()
            if not given.frame(now, before, changed, ends):
                raise ValueError(f"{len(code)} bytes are not the code of frames from number {t} on")
            yield now
            before = now
        if not given.all_read():
            raise ValueError("a code goes on after its frames")


def _blocks(shape: Sequence[int]) -> tuple[int, ...]:
    return tuple(-(-n // _BLOCK) for n in shape)


def _begun(shape: tuple[int, ...]) -> tuple[NDArray[np.int8], NDArray[np.uint8]]:
    """What there is before the first frame, and which blocks changed last."""
    return np.zeros(shape, np.int8), np.zeros(_blocks(shape), np.uint8)


def _require_code(code: NDArray[np.uint8], shape: Sequence[int]) -> None:
    """Raise ValueError where so few bytes cannot be that many numbers."""
    if code.dtype != np.uint8 or code.ndim != 1:
        raise ValueError(f"a code is {code.dtype} of {code.ndim} dimensions, not bytes")
    numbers = math.prod(int(n) for n in shape)
    if min(shape, default=0) < 0 or numbers > _PER_BYTE * (len(code) + 8):
        raise ValueError(f"{len(code)} bytes cannot be {numbers} numbers")
    if numbers > _MOST:
        raise ValueError(f"{numbers} numbers are more than {_MOST}")
