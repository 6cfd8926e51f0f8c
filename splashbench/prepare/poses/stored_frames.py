"""Frames kept in files, and read when they are asked for: those of a 4K sweep take most of a gigabyte."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from splashbench.files import read_png, write_png

Image = NDArray[np.uint8]


class StoredFrames(Sequence[Image]):
    """A sequence of frames [H, W, 3], each in a PNG below `folder`, which whoever gives it removes."""

    def __init__(self, frames: Iterable[Image], folder: Path) -> None:
        self._paths: list[Path] = []
        for number, frame in enumerate(frames):
            path = folder / f"{number:04d}.png"
            write_png(path, frame)
            self._paths.append(path)

    def __len__(self) -> int:
        return len(self._paths)

    @overload
    def __getitem__(self, index: int) -> Image: ...

    @overload
    def __getitem__(self, index: slice) -> list[Image]: ...

    def __getitem__(self, index: int | slice) -> Image | list[Image]:
        if isinstance(index, slice):
            return [read_png(path, "RGB") for path in self._paths[index]]
        return read_png(self._paths[index], "RGB")
