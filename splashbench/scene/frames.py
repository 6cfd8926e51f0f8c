"""A few timesteps of a recording that stand for all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def spread_frames(n_frames: int, most: int) -> NDArray[np.int64]:
    """At most `most` of `n_frames` timesteps, evenly spread, the first and the last among them where there are two."""
    return np.unique(np.linspace(0, n_frames - 1, min(n_frames, most)).round().astype(np.int64))
