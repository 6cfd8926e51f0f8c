"""Values as colours, and the scale that says which colour is which value."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Of values that are not known, and of particles in one colour.
UNKNOWN, PLAIN = (150, 150, 150), (70, 130, 230)


@lru_cache
def _scale() -> NDArray[np.uint8]:
    from matplotlib import colormaps

    return np.rint(colormaps["viridis"](np.linspace(0, 1, 256))[:, :3] * 255).astype(np.uint8)


def colors_of(values: ArrayLike, span: tuple[float, float]) -> NDArray[np.uint8]:
    """sRGB [N, 3] of `values` [N]: dark blue at the lower end of `span`, yellow at the upper; grey for NaN."""
    array = np.asarray(values, dtype=np.float64)
    known = np.isfinite(array)
    low, high = span
    steps = np.zeros(array.shape, dtype=np.int64)
    steps[known] = np.rint(np.clip((array[known] - low) / (high - low), 0, 1) * 255).astype(np.int64)
    return np.asarray(np.where(known[:, None], _scale()[steps], np.array(UNKNOWN)), dtype=np.uint8)


def legend() -> NDArray[np.uint8]:
    """The colours from the lower to the upper end, uint8 [12, 256, 3]."""
    return np.tile(_scale(), (12, 1, 1))
