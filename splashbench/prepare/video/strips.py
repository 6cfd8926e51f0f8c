"""Statistics over frames, pixel by pixel, a strip of rows at a time: those of a stack of 4K frames take gigabytes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_STRIP_BYTES = 4 << 20


def strips(frames: Sequence[NDArray[np.uint8]]) -> Iterator[NDArray[np.uint8]]:
    """Yield the same rows of all frames [H, W, 3] as one stack [N, rows, W, 3], from the top to the bottom."""
    rows = max(1, _STRIP_BYTES * len(frames[0]) // (len(frames) * frames[0].nbytes))
    for start in range(0, len(frames[0]), rows):
        yield np.stack([frame[start : start + rows] for frame in frames])


def median_frame(frames: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """The median over frames [H, W, 3] or [H, W] of a scene in which nothing moves: the same picture, less noise."""
    return np.concatenate([_median(stack).round().astype(np.uint8) for stack in strips(frames)])


def median_and_deviation(frames: Sequence[NDArray[np.uint8]]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The median over frames [H, W, 3], and the median distance from it, mean over the channels, [H, W]."""
    found = []
    for stack in strips(frames):
        median = _median(stack).astype(np.float32)
        found.append((median, np.median(np.abs(stack - median), axis=0, overwrite_input=True).mean(axis=-1)))
    median, deviation = (np.concatenate(parts) for parts in zip(*found))
    return median, deviation


def _median(stack: NDArray[np.uint8]) -> NDArray[Any]:
    return np.median(stack, axis=0)
