"""Medians of images over time, pixel by pixel, of the frames that count there, compiled.

The median is found bit by bit: how many values lie below a bound says whether it has that bit. No value moves, and
neighbouring pixels are compared at once, which takes a fifth of the time of sorting them.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from splashbench.parallel import over_range

# Images smaller than this are done by one thread.
_FEWEST_VALUES = 1 << 16


def masked_median(images: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Lower median over the first axis of uint8 [T, H, W, 3] where bool [T, H, W] allows; 0 where it never does."""
    frames, height, width, channels = images.shape
    median = np.zeros(images.shape[1:], np.uint8)
    if median.size and frames:
        rows = max(1, _FEWEST_VALUES // (width * channels))
        flat = np.ascontiguousarray(images).reshape(frames, height, width * channels)
        over_range(_medians, height, flat, np.ascontiguousarray(valid), median.reshape(height, -1), smallest=rows)
    return median


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _medians(images: np.ndarray, valid: np.ndarray, median: np.ndarray, start: int, stop: int) -> None:
    frames, _, values = images.shape
    width = valid.shape[2]
    channels = values // width
    one = np.uint16(1)
    # Of each value of a row: which frames count, how many, how many of them are to lie below, and what is found so far.
    counts = np.empty((frames, values), np.uint16)
    below, wanted = np.empty(values, np.uint16), np.empty(values, np.uint16)
    found, bound = np.empty(values, np.uint16), np.empty(values, np.uint16)
    for row in range(start, stop):
        wanted[:] = 0
        for t in range(frames):
            for x in range(width):
                for c in range(channels):
                    counts[t, x * channels + c] = one if valid[t, row, x] else np.uint16(0)
            for i in range(values):
                wanted[i] += counts[t, i]
        for i in range(values):
            median[row, i] = np.uint8(wanted[i] > 0)
            wanted[i] = (max(wanted[i], one) - one) // np.uint16(2)
        found[:] = 0
        for bit in (128, 64, 32, 16, 8, 4, 2, 1):
            for i in range(values):
                bound[i] = found[i] | np.uint16(bit)
                below[i] = 0
            for t in range(frames):
                for i in range(values):
                    less = one if np.uint16(images[t, row, i]) < bound[i] else np.uint16(0)
                    below[i] += less & counts[t, i]
            for i in range(values):
                if below[i] <= wanted[i]:
                    found[i] = bound[i]
        for i in range(values):
            median[row, i] *= np.uint8(found[i])
