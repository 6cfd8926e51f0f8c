"""The arrays of a liquid's files as they are written: long ones of whole numbers as codes (kernel/entropy.py).

A code takes a tenth to a third fewer bytes than the same numbers compressed by bzip2, and a fraction of its time. Its
shape is not in it: other arrays of the same file tell it, and liquid.json.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from splashbench.files import MAX_NPZ_BYTES, compressed_bytes
from splashbench.scene.geometry import MAX_STEPS

from ..fields.sparse_frames import Frames, SparseFrames
from ..kernel.entropy import Near, read_field, read_frames, read_table, write_field, write_frames, write_table
from .rows import MAX_ROWS
from .signed_distance import COARSER, FAR, packed_frame, whole_frame
from .values import COEFFICIENTS, LEVELS

#: What of each table is context for what is coded next, by the array's name: what resembles what is before it.
NEAR: Mapping[str, Near] = {
    "lives": 1,
    "cells": 1,
    "residuals": 2,
    "coarseness": 1,
    **{f"{COEFFICIENTS}{level}": 0 for level in range(LEVELS)},
}
#: Arrays of these names are stored with a dimension for the bytes alone.
CODED = (*NEAR, "velocities", "phi")
# Of a frame of phi: the finest grid that settings allow has half of them.
_MOST_NODES = 1 << 26
#: Control nodes along each axis, beside the code of the velocities.
NODES = "nodes"


class _Steps:
    """Frames of packed phi in whole stored steps."""

    def __init__(self, packed: Frames) -> None:
        self._packed = packed

    @property
    def shape(self) -> tuple[int, ...]:
        return self._packed.shape

    def __len__(self) -> int:
        return len(self._packed)

    def __getitem__(self, t: int, /) -> NDArray[np.int8]:
        return whole_frame(self._packed[t])


def pack_distance(packed: Frames) -> dict[str, np.ndarray]:
    """The packed phi of all frames, as it is written; `ends` are the least and the largest stored step."""
    steps = _Steps(packed)
    ends = [0, 0]
    for t in range(len(steps)):
        now = steps[t]
        ends = [min(ends[0], int(now.min(initial=0))), max(ends[1], int(now.max(initial=0)))]
    return {"phi": write_frames(steps, (ends[0], ends[1])), "ends": np.array(ends, np.int8)}


def unpack_distance(arrays: Mapping[str, np.ndarray], shape: tuple[int, ...]) -> SparseFrames:
    """The packed phi of which `pack_distance` made `arrays`, of `shape` [T, nx, ny, nz]. Raises ValueError."""
    least, most = (int(end) for end in _whole_numbers(arrays["ends"], 2))
    if not -FAR - 1 <= least <= 0 <= most <= MAX_STEPS // COARSER:
        raise ValueError(f"phi is from {least} to {most} steps, beyond 7.9 voxels")
    if min(shape[1:]) < 1 or math.prod(shape[1:]) > _MOST_NODES:
        raise ValueError(f"a frame of phi has {'x'.join(map(str, shape[1:]))} nodes, none or more than {_MOST_NODES}")
    if math.prod(shape) > MAX_NPZ_BYTES:
        raise ValueError(f"{shape[0]} frames of phi are more than {MAX_NPZ_BYTES / 2**30:g} GiB")
    frames: Iterable[NDArray[np.int8]] = read_frames(arrays["phi"], shape, (least, most))
    nx, ny, nz = shape[1:]
    return SparseFrames((nx, ny, nz), (packed_frame(steps) for steps in frames))


def pack(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of carriers, motion or appearance as they are written."""
    packed: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        if name == "velocities":
            packed |= {name: write_field(array), NODES: np.array(array.shape[1:4], np.int32)}
        elif name in NEAR:
            # Coefficients are in columns: one of each, then the next carrier's.
            rows = array.T if name.startswith(COEFFICIENTS) else array
            packed[name] = write_table(rows if rows.ndim == 2 else rows[:, None], NEAR[name])
        else:
            packed[name] = array
    return packed


def packed_bytes(arrays: Mapping[str, np.ndarray]) -> int:
    """How much `arrays` take when they are written, to within some kilobytes."""
    return compressed_bytes(pack(arrays))


def unpack_carriers(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of carriers of which `pack` made these. Raises ValueError where they do not fit together."""
    births = _whole_numbers(arrays["births"]).astype(np.int64)
    count = int(births.sum()) if births.min(initial=0) >= 0 else -1
    lives = read_table(arrays["lives"], (count, 1), NEAR["lives"])[:, 0]
    if count and int(lives.min()) < 1:
        raise ValueError("a carrier lasts for no frame")
    moves = int(lives.sum(dtype=np.int64)) - count
    if count + moves > MAX_ROWS:
        raise ValueError(f"{count + moves} rows are more than {MAX_ROWS}")
    return {
        **arrays,
        "births": births.astype(np.uint32),
        "lives": lives,
        "cells": read_table(arrays["cells"], (count, 1), NEAR["cells"])[:, 0],
        "residuals": _short(read_table(arrays["residuals"], (moves, 3), NEAR["residuals"])),
    }


def unpack_motion(arrays: Mapping[str, np.ndarray], steps: int) -> dict[str, np.ndarray]:
    """The same of a motion of so many `steps`."""
    nx, ny, nz = (int(n) for n in _whole_numbers(arrays[NODES], 3))
    if min(nx, ny, nz) < 2:
        raise ValueError(f"a motion on {nx} x {ny} x {nz} nodes; there are two along each axis at least")
    others = {name: array for name, array in arrays.items() if name != NODES}
    return others | {"velocities": read_field(arrays["velocities"], (steps, nx, ny, nz, 3))}


def unpack_appearance(arrays: Mapping[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """The same of an appearance of `count` carriers."""
    coarseness = read_table(arrays["coarseness"], (count, 1), NEAR["coarseness"])[:, 0]
    if count and not 0 <= int(coarseness.min()) <= int(coarseness.max()) < LEVELS:
        raise ValueError(f"coarseness is no whole number from 0 to {LEVELS - 1}")
    shares = np.bincount(coarseness, minlength=LEVELS)
    size = len(arrays["center"])
    coefficients = {
        name: _short(read_table(arrays[name], (int(shares[level]), size), NEAR[name])).T
        for level, name in ((level, f"{COEFFICIENTS}{level}") for level in range(LEVELS))
    }
    return {**arrays, "coarseness": coarseness.astype(np.uint8), **coefficients}


def _short(numbers: NDArray[np.int32]) -> np.ndarray:
    """The same in the smallest type that holds them: they stay in memory with the model."""
    largest = max(int(numbers.max(initial=0)), -int(numbers.min(initial=0)))
    return numbers.astype(np.min_scalar_type(-largest - 1))


def _whole_numbers(array: np.ndarray, count: int | None = None) -> np.ndarray:
    """`array` itself. Raises ValueError where it is not of whole numbers, or not of `count`."""
    if array.dtype.kind not in "iu" or (count is not None and array.shape != (count,)):
        raise ValueError(f"{array.dtype} {array.shape} are not the whole numbers that a shape is made of")
    return array
