"""Flicker at the seams of a slowed video: whether frames at timesteps jump more than those between them.

A frame's second difference in time is |f(k-1) - 2 f(k) + f(k+1)|, averaged over colours and over the pixels that are
liquid in one of the three frames, in levels of 255; the protocol's jitter error is another quantity. Steady motion has
little of it. What is wrong at timesteps alone, such as other primitives that take over, has more of it there; the ratio
of both says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SecondDifference:
    """Mean second difference, in levels of 255, of frames at timesteps (`seams`), of others (`between`), and of all.

    values: of each frame, [N]; NaN for the first and the last one, and where there is no liquid.
    """

    seams: float
    between: float
    mean: float
    values: NDArray[np.float64]

    @property
    def ratio(self) -> float:
        """Seams over between: 1 where timesteps cannot be told; inf where nothing changes its motion in between."""
        return self.seams / self.between if self.between > 0 else float("inf")


def subdivided(timesteps: NDArray[np.float64], parts: int) -> NDArray[np.float64]:
    """`timesteps` [T] with `parts - 1` instants evenly between each two, so that every `parts`-th one is a timestep."""
    places = np.arange((len(timesteps) - 1) * parts + 1) / parts
    return np.interp(places, np.arange(len(timesteps)), timesteps)


def second_difference(rgb: NDArray[np.floating], liquid: NDArray[np.bool_], parts: int) -> SecondDifference:
    """The second difference of frames, of which every `parts`-th one is a timestep, from the first.

    Args:
        rgb: [N, H, W, 3] in [0, 1]. liquid: [N, H, W], where each frame shows liquid.

    Raises ValueError for fewer than three frames.
    """
    if len(rgb) < 3 or liquid.shape != rgb.shape[:3]:
        raise ValueError(
            f"a second difference is of three frames or more and as many masks, not of {rgb.shape} and {liquid.shape}"
        )
    values = np.full(len(rgb), np.nan)
    for k in range(1, len(rgb) - 1):
        seen = liquid[k - 1] | liquid[k] | liquid[k + 1]
        if seen.any():
            before, here, after = (rgb[j][seen].astype(np.float64) for j in (k - 1, k, k + 1))
            values[k] = 255 * np.abs(before - 2 * here + after).mean()
    at_seam = np.arange(len(values)) % parts == 0
    return SecondDifference(_mean(values[at_seam]), _mean(values[~at_seam]), _mean(values), values)


def _mean(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")
