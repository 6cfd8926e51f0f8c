"""Memory for images and gradients, used again once nobody holds them.

Fresh memory of an image's size costs as much as writing the image twice over: the system hands it out page by page,
each cleared first. An array handed out is a view of a buffer kept here; a buffer without other references is free.
"""

from __future__ import annotations

import ctypes
import math
import os
import sys
import threading

import numpy as np
from numpy.typing import NDArray

# Smaller arrays come from the heap, which keeps its memory itself.
SMALLEST_BYTES = 1 << 20
MAX_BYTES = 1 << 28

_lock = threading.Lock()
_buffers: list[NDArray[np.float32]] = []  # least recently handed out first


def _after_fork() -> None:
    """The child's lock may be held by a thread that it does not have."""
    global _lock
    _lock = threading.Lock()


os.register_at_fork(after_in_child=_after_fork)

# What getrefcount says of an array that nothing but a list holds.
_probe = [np.empty(1, np.float32)]
_IDLE = sys.getrefcount(_probe[0])


def empty(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """An uninitialised C-contiguous float32 array."""
    count = math.prod(shape)
    if 4 * count < SMALLEST_BYTES:
        return np.empty(shape, np.float32)
    with _lock:
        for i in range(len(_buffers)):
            # Not one that is far too large: it would be missed where it fits.
            if count <= _buffers[i].size <= 2 * count and sys.getrefcount(_buffers[i]) <= _IDLE:
                _buffers.append(_buffers.pop(i))
                return _buffers[-1][:count].reshape(shape)
        # The fresh one does where one little smaller did.
        for i in reversed(range(len(_buffers))):
            if count < 2 * _buffers[i].size < 2 * count and sys.getrefcount(_buffers[i]) <= _IDLE:
                _buffers.pop(i)
        fresh = np.empty(count, np.float32)
        _buffers.append(fresh)
        while len(_buffers) > 1 and sum(buffer.nbytes for buffer in _buffers) > MAX_BYTES:
            _buffers.pop(0)  # lives on for as long as somebody holds a view of it
        return fresh.reshape(shape)


def forget() -> None:
    """Keep none of the buffers that nobody holds: images of the next part of a fit have other sizes."""
    with _lock:
        for i in reversed(range(len(_buffers))):
            if sys.getrefcount(_buffers[i]) <= _IDLE:
                _buffers.pop(i)


def give_back() -> None:
    """Give what the heap holds of freed memory back to the system, where the C library can (glibc).

    Once images have been freed, the heap keeps the places of later ones, and small arrays between them: after reading a
    scene's photographs, as much again as is in use.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(ctypes.c_size_t(0))
