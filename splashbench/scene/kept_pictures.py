"""Photographs and masks of a small scene, and masks of any, kept once they were read: a fit asks for each some ten
times."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

#: Bytes that photographs and masks of one scene may take; of a scene that has more no photographs are kept.
MAX_KEPT_BYTES = 64 << 20
#: Bytes that the masks of such a scene may take, packed; what is beyond is read again.
MAX_PACKED_BYTES = 64 << 20

Pixels = TypeVar("Pixels", bound=np.ndarray[Any, Any])


class KeptPictures:
    """What was read of a scene whose photographs and masks take `total` bytes, for whoever asks again; nothing where
    that is more than `most` (default: MAX_KEPT_BYTES)."""

    def __init__(self, total: int, most: int | None = None) -> None:
        fits = total <= (MAX_KEPT_BYTES if most is None else most)
        self._pictures: dict[tuple[str, str, int], Any] | None = {} if fits else None
        self._packed: dict[tuple[str, int], tuple[tuple[int, ...], bytes]] = {}
        self._packed_bytes = 0

    def get(self, kind: str, camera: str, t: int, read: Callable[[str, int], Pixels]) -> Pixels:
        """What `read` gave for `camera` at timestep `t` the first time; the caller may change the array."""
        if self._pictures is None:
            return read(camera, t)
        found = self._pictures.get((kind, camera, t))
        if found is None:
            found = self._pictures[kind, camera, t] = read(camera, t)
        copy: Pixels = found.copy()
        return copy

    def mask(self, camera: str, t: int, read: Callable[[str, int], Pixels]) -> Pixels:
        """As `get`, of masks, bool [H, W]: those of large scenes are kept as well, packed."""
        if self._pictures is not None:
            return self.get("mask", camera, t, read)
        found = self._packed.get((camera, t))
        if found is None:
            mask = read(camera, t)
            packed = zlib.compress(np.packbits(mask).tobytes(), 1)
            if self._packed_bytes + len(packed) <= MAX_PACKED_BYTES:
                self._packed[camera, t] = mask.shape, packed
                self._packed_bytes += len(packed)
            return mask
        shape, packed = found
        bits = np.unpackbits(np.frombuffer(zlib.decompress(packed), np.uint8), count=int(np.prod(shape)))
        return cast(Pixels, bits.reshape(shape).view(bool))
