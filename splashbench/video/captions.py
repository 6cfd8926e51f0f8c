"""Captions: lines of text, and the bar of a colour scale, on a strip below a picture that they never cover."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from splashbench.video.scales import Scale

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont

_BACK, _TEXT = (20, 20, 22), (230, 230, 230)
_SMALLEST, _LARGEST = 8, 40
_BETWEEN = 2  # spaces between two texts of a line
_LINE = 1.35  # of the font's size
_MORE = "…"


@dataclass(frozen=True)
class Line:
    """A line of a caption: a text at its left end, and one at its right."""

    left: str
    right: str = ""


class Strip:
    """The strip below a picture `width` pixels wide.

    Args:
        longest: the lines with the longest texts that they will have, so that the strip never changes its height. A
            line whose texts do not fit beside each other is broken in two.
        scale: whose bar is a line of its own, or None.
    """

    def __init__(self, width: int, longest: Sequence[Line], scale: Scale | None) -> None:
        self._width, self._scale = width, scale
        size = min(max(round(7 + 0.014 * width), _SMALLEST), _LARGEST)
        self._font = _font(size)
        self._pad = max(2, size // 3)
        self._broken = [
            bool(line.left and line.right) and self._length(line.left + " " * _BETWEEN + line.right) > self._room
            for line in longest
        ]
        self._step = round(_LINE * size)
        self._bar = None if scale is None else self._draw_bar(scale)
        rows = len(longest) + sum(self._broken) + (scale is not None)
        self.height = rows * self._step + self._pad

    @property
    def _room(self) -> int:
        return self._width - 2 * self._pad

    def draw(self, lines: Sequence[Line], height: int) -> NDArray[np.uint8]:
        """The strip, uint8 [height, width, 3], with as many lines as it was made for; `height` at least its own."""
        from PIL import Image, ImageDraw

        image = Image.new("RGB", (self._width, height), _BACK)
        brush = ImageDraw.Draw(image)
        y = self._pad // 2
        for line, broken in zip(lines, self._broken):
            brush.text((self._pad, y), self._fitting(line.left), _TEXT, self._font)
            y += self._step if broken else 0
            right = self._fitting(line.right)
            x = self._pad if broken else self._width - self._pad - self._length(right)
            brush.text((x, y), right, _TEXT, self._font)
            y += self._step
        strip = np.array(image)
        if self._bar is not None:
            strip[y : y + len(self._bar)] = self._bar[: height - y]
        return strip

    def _draw_bar(self, scale: Scale) -> NDArray[np.uint8]:
        """A line: what is measured and the low end, the colours, the high end and the unit."""
        from PIL import Image, ImageDraw

        left, right = f"{scale.label} {scale.low:g}", f"{scale.high:g} {scale.unit}".rstrip()
        image = Image.new("RGB", (self._width, self._step), _BACK)
        brush = ImageDraw.Draw(image)
        brush.text((self._pad, 0), left, _TEXT, self._font)
        end = self._width - self._pad - self._length(right)
        brush.text((end, 0), right, _TEXT, self._font)
        strip = np.array(image)
        start, stop = self._pad + self._length(left) + self._pad, end - self._pad
        if stop > start:
            colors = scale.colors(np.linspace(scale.low, scale.high, stop - start))
            strip[round(0.25 * self._step) : round(0.85 * self._step), start:stop] = colors
        return strip

    def _length(self, text: str) -> int:
        return int(np.ceil(self._font.getlength(text)))

    def _fitting(self, text: str) -> str:
        """`text`, or as much of it as there is room for."""
        if self._length(text) <= self._room:
            return text
        while text and self._length(text + _MORE) > self._room:
            text = text[:-1]
        return text + _MORE


@lru_cache(maxsize=8)
def _font(size: int) -> FreeTypeFont:
    """DejaVu Sans, which matplotlib ships."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")), size)


def speed_text(speed: float) -> str:
    """How fast the liquid moves, of its real `speed`: "real time", "1/8 speed", "2x speed", "frozen"."""
    if abs(speed) < 1e-9:
        return "frozen"
    if abs(speed - 1) < 0.005:
        return "real time"
    if 0 < speed < 1 and abs(1 / speed - round(1 / speed)) < 0.005 / speed:
        return f"1/{round(1 / speed)} speed"
    return f"{speed:.3g}x speed"
