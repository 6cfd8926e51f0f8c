"""Photographs of training targets: kept while there is room, else read again whenever they are to teach.

A large photograph with droplets all over it takes some ten megabytes, and a scene has hundreds.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ..kernel.window_loss import WindowPhotograph

#: Bytes of photographs that are kept; those beyond are read again.
KEPT_BYTES = 512 << 20


@dataclass(frozen=True)
class Deferred:
    """A photograph that `read` reads from the scene, the same at every time."""

    read: Callable[[], WindowPhotograph]


Photograph = WindowPhotograph | Deferred


def packed(photograph: WindowPhotograph) -> Deferred:
    """`photograph` with an eighth of a byte for each pixel of its mask, in place of one."""
    image, bits = photograph.image, np.packbits(photograph.mask.numpy())
    return Deferred(partial(_unpacked, image, bits, photograph.top, photograph.left))


def _unpacked(image: Tensor, bits: np.ndarray, top: int, left: int) -> WindowPhotograph:
    pixels = image.shape[:2]
    mask = np.unpackbits(bits, count=pixels.numel()).view(bool).reshape(pixels)
    return WindowPhotograph(image, torch.from_numpy(mask), top, left)


class Shelf:
    """Room for the photographs that are kept: the first ones."""

    def __init__(self, room: int = KEPT_BYTES) -> None:
        self._room = room

    @property
    def full(self) -> bool:
        """Whether there is no room left: photographs are to be `Deferred` from now on."""
        return self._room <= 0

    def keep(self, photograph: WindowPhotograph) -> WindowPhotograph:
        """`photograph`, which takes up room."""
        self._room -= photograph.image.nbytes + photograph.mask.nbytes
        return photograph


def read_now(photograph: Photograph) -> WindowPhotograph:
    """The photograph itself."""
    return photograph.read() if isinstance(photograph, Deferred) else photograph


class ReadAhead:
    """Reads the next photograph in a thread while the fit goes on with another."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="splashsplat-photographs")
        self._ahead: tuple[Deferred, Future[WindowPhotograph]] | None = None

    def get(self, photograph: Photograph) -> WindowPhotograph:
        """The photograph itself, by now or after a wait."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None and ahead[0] is photograph:
            return ahead[1].result()
        return read_now(photograph)

    def prepare(self, photograph: Photograph) -> None:
        """Begin to read what is wanted next."""
        if isinstance(photograph, Deferred):
            self._ahead = photograph, self._pool.submit(photograph.read)

    def close(self) -> None:
        """Wait for what is being read, and end the thread."""
        self._pool.shutdown()
