"""Statistics over frames, pixel by pixel, a strip of rows at a time: those of a stack of 4K frames take gigabytes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]

#: Bytes of frames that are held at once; where they have more, they are read several times.
HELD_BYTES = 192 << 20
_STRIP_BYTES = 4 << 20


def median_frame(frames: Sequence[Frame]) -> Frame:
    """The median over frames [H, W, 3] or [H, W] of a scene in which nothing moves: the same picture, less noise."""
    return np.concatenate([_median(stack).round().astype(np.uint8) for stack in _strips(frames)])


def median_of(read: Callable[[], Iterable[Frame]], count: int) -> Frame:
    """`median_frame` of the `count` frames that `read` gives, as often as it is called."""
    return np.concatenate([median_frame(band) for band, _ in _bands(read, count)])


def median_and_deviation(
    read: Callable[[], Iterable[Frame]], count: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Of the `count` frames [H, W, 3] that `read` gives, as often as it is called: the median [H, W, 3], and the median
    distance from it, mean over the channels, [H, W]."""
    median, deviation = np.zeros((0, 0, 3), np.float32), np.zeros((0, 0), np.float32)
    top = 0
    for band, shape in _bands(read, count):
        if top == 0:
            median, deviation = np.empty(shape, np.float32), np.empty(shape[:2], np.float32)
        for stack in _strips(band):
            rows = slice(top, top + stack.shape[1])
            median[rows] = _median(stack)
            apart = np.abs(stack - median[rows])
            deviation[rows] = np.median(apart, axis=0, overwrite_input=True).mean(axis=-1)
            top = rows.stop
    return median, deviation


def _bands(read: Callable[[], Iterable[Frame]], count: int) -> Iterator[tuple[list[Frame], tuple[int, ...]]]:
    """Yield the same rows of all frames, from the top to the bottom, as many at a time as may be held; and the frames'
    shape."""
    top, height, rows = 0, 1, 1
    shape: tuple[int, ...] = ()
    while top < height:
        band = []
        for frame in read():
            shape, height = frame.shape, len(frame)
            rows = max(1, HELD_BYTES * height // (count * frame.nbytes))
            # A copy, where it is a part: else the whole frame stays.
            band.append(frame if rows >= height else frame[top : top + rows].copy())
        yield band, shape
        top += rows


def _strips(frames: Sequence[Frame]) -> Iterator[Frame]:
    """Yield the same rows of all frames as one stack [N, rows, W, ...], from the top to the bottom."""
    rows = max(1, _STRIP_BYTES * len(frames[0]) // (len(frames) * frames[0].nbytes))
    for start in range(0, len(frames[0]), rows):
        yield np.stack([frame[start : start + rows] for frame in frames])


def _median(stack: Frame) -> NDArray[Any]:
    return np.median(stack, axis=0)
