"""The fluid-centric crop of the evaluation protocol (paper Sec. S1.4, "Evaluation Protocol").

"Each camera is cropped to a window fixed in size and position: the union of its mask bounding boxes over all frames
and both splits, padded by 96 px and rounded up to a multiple of eight. Only the principal point is shifted."

What the paper leaves open is decided here:
- The padded box is cut at the image's border.
- Rounding up adds pixels at the right and the bottom. Where these lie outside the image, the window moves left or up.
- Where the image is narrower than the rounded size, the window is the largest multiple of eight that fits the image. It
  holds the whole mask, and is as centred on the padded box as the image then allows.
- Where the mask needs more than that, the window is the image's full extent: the one case in which a side is not a
  multiple of eight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PADDING = 96
MULTIPLE = 8


@dataclass(frozen=True)
class PixelBox:
    """Pixels x0 <= column < x1, y0 <= row < y1."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def width(self) -> int:
        """Columns in the box."""
        return self.x1 - self.x0

    @property
    def height(self) -> int:
        """Rows in the box."""
        return self.y1 - self.y0

    def union(self, other: PixelBox | None) -> PixelBox:
        """The smallest box that holds both; `other` may be None, the box of an empty mask."""
        if other is None:
            return self
        return PixelBox(min(self.x0, other.x0), min(self.y0, other.y0), max(self.x1, other.x1), max(self.y1, other.y1))

    def cut(self, image: NDArray) -> NDArray:
        """The part of an image [H, W, ...] inside the box."""
        return image[self.y0 : self.y1, self.x0 : self.x1]


def bounding_box(mask: NDArray[np.bool_]) -> PixelBox | None:
    """The box around a mask [H, W]; None where it is empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    return PixelBox(int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)


def crop_window(union: PixelBox, width: int, height: int, padding: int = PADDING, multiple: int = MULTIPLE) -> PixelBox:
    """The crop for the union of mask boxes in images of `width` x `height` pixels."""
    x0, x1 = _window(union.x0, union.x1, width, padding, multiple)
    y0, y1 = _window(union.y0, union.y1, height, padding, multiple)
    return PixelBox(x0, y0, x1, y1)


def _window(low: int, high: int, extent: int, padding: int, multiple: int) -> tuple[int, int]:
    """The window [start, stop) along one axis for mask pixels low <= i < high of an image of `extent` pixels."""
    start, stop = max(low - padding, 0), min(high + padding, extent)
    size = -(-(stop - start) // multiple) * multiple
    if size <= extent:
        start = min(start, extent - size)
        return start, start + size
    size = extent // multiple * multiple
    if size < high - low:
        return 0, extent
    # Here start..stop spans more than `size`: centre on it, but keep the mask, and stay inside the image.
    start = (start + stop - size) // 2
    start = min(max(start, high - size, 0), low, extent - size)
    return start, start + size
