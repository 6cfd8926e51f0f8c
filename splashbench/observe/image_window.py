"""Part of an image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ImageWindow:
    """Rows [y0, y1) and columns [x0, x1) of an image."""

    y0: int
    y1: int
    x0: int
    x1: int

    @classmethod
    def around(cls, mask: np.ndarray, margin: int = 0) -> ImageWindow:
        """The bounding box of `mask` [H, W], `margin` pixels larger within the image; two pixels where it is empty."""
        height, width = mask.shape
        rows, columns = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
        if len(rows) == 0:
            return cls(0, min(2, height), 0, min(2, width))
        return cls(
            max(int(rows[0]) - margin, 0),
            min(int(rows[-1]) + 1 + margin, height),
            max(int(columns[0]) - margin, 0),
            min(int(columns[-1]) + 1 + margin, width),
        )

    def joined(self, other: ImageWindow) -> ImageWindow:
        """The smallest window that holds both."""
        return ImageWindow(
            min(self.y0, other.y0), max(self.y1, other.y1), min(self.x0, other.x0), max(self.x1, other.x1)
        )

    def holds(self, other: ImageWindow) -> bool:
        """Whether all of `other` is in it."""
        return self.joined(other) == self

    def within(self, larger: ImageWindow) -> ImageWindow:
        """It, counted from the corner of `larger`."""
        return ImageWindow(self.y0 - larger.y0, self.y1 - larger.y0, self.x0 - larger.x0, self.x1 - larger.x0)

    def margins(self, larger: ImageWindow) -> tuple[tuple[int, int], tuple[int, int]]:
        """Rows before and after it, and columns, in `larger`, which holds it."""
        return (self.y0 - larger.y0, larger.y1 - self.y1), (self.x0 - larger.x0, larger.x1 - self.x1)

    @property
    def shape(self) -> tuple[int, int]:
        return self.y1 - self.y0, self.x1 - self.x0

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    @property
    def corner(self) -> np.ndarray:
        """Its top-left pixel (x, y), float64 [2]."""
        return np.array([self.x0, self.y0], dtype=np.float64)
