"""Colour scales: numbers to colours, one scale for a whole video, of maps that colour-blind people can read."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

# What is grey in a picture of numbers has none; darker than a photograph, so that colours stand out.
_CONTEXT = 0.45
_LUMA = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


@dataclass(frozen=True)
class Scale:
    """What the colours of a layer mean.

    Attributes:
        label: what is measured, in a word. unit: of it, or "".
        low, high: the values at the scale's ends; what lies beyond has the end's colour.
        map: matplotlib's name of the colour map: viridis, cividis or inferno, or one of these reversed (`_r`).
    """

    label: str
    low: float
    high: float
    unit: str
    map: str

    def colors(self, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """uint8 [..., 3] of `values` [...]; NaN has the low end's colour."""
        span = max(self.high - self.low, 1e-12)
        shares = np.clip((np.nan_to_num(values, nan=self.low) - self.low) / span, 0, 1)
        return _table(self.map)[np.rint(shares * 255).astype(np.intp)]

    def over(self, values: NDArray[np.floating], picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The colours of `values` [H, W], and where they are NaN the `picture` [H, W, 3] in dark grey."""
        grey = np.rint(_CONTEXT * (picture.astype(np.float32) @ _LUMA)).astype(np.uint8)
        return np.where(np.isnan(values)[..., None], grey[..., None], self.colors(values))


@lru_cache(maxsize=8)
def _table(name: str) -> NDArray[np.uint8]:
    """The 256 colours of a map, uint8 [256, 3]."""
    from matplotlib import colormaps

    return np.rint(colormaps[name](np.linspace(0, 1, 256))[:, :3] * 255).astype(np.uint8)


def round_range(low: float, high: float, steps: int = 10) -> tuple[float, float]:
    """A range around `low` and `high` whose ends are round numbers, at most about a `steps`-th of it farther out."""
    if not high > low:
        size = max(abs(low), 1e-3)
        low, high = low - 0.1 * size, high + 0.1 * size
    magnitude = 10.0 ** math.floor(math.log10((high - low) / steps))
    step = magnitude * min((f for f in (1, 2, 5, 10) if f * magnitude * steps >= high - low), default=10)
    # Rounded once more: 3 * 0.1 is no round number.
    return round(math.floor(low / step + 1e-9) * step, 12), round(math.ceil(high / step - 1e-9) * step, 12)
