"""Photographs and masks of a small scene, kept once they were read: a fit asks for each of them some ten times."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

#: Bytes that photographs and masks of one scene may take; of a scene that has more none are kept.
MAX_KEPT_BYTES = 64 << 20

Pixels = TypeVar("Pixels", bound=np.ndarray[Any, Any])


class KeptPictures:
    """What was read of a scene whose photographs and masks take `total` bytes, for whoever asks again; nothing where
    that is more than `most` (default: MAX_KEPT_BYTES)."""

    def __init__(self, total: int, most: int | None = None) -> None:
        fits = total <= (MAX_KEPT_BYTES if most is None else most)
        self._pictures: dict[tuple[str, str, int], Any] | None = {} if fits else None

    def get(self, kind: str, camera: str, t: int, read: Callable[[str, int], Pixels]) -> Pixels:
        """What `read` gave for `camera` at timestep `t` the first time; the caller may change the array."""
        if self._pictures is None:
            return read(camera, t)
        found = self._pictures.get((kind, camera, t))
        if found is None:
            found = self._pictures[kind, camera, t] = read(camera, t)
        copy: Pixels = found.copy()
        return copy
