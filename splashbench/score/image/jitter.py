"""Jitter error (paper, "Metrics", after GaussFluids): does the render flicker as much as the footage, no more, no less?

Jitter of a view is the standard deviation of luma differences between adjacent frames, pooled over the pixels that are
liquid in either frame. Its raw value rewards a frozen picture; the difference to the ground truth's does not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splashbench.score.image.fidelity import Image, Mask

# ITU-R BT.601 luma.
_LUMA = np.array([0.299, 0.587, 0.114])


class _Pool:
    """Standard deviation of values that arrive in parts, without keeping them."""

    def __init__(self) -> None:
        self.count, self.total, self.squares = 0, 0.0, 0.0

    def add(self, values: NDArray[np.float64]) -> None:
        self.count += values.size
        self.total += float(values.sum())
        self.squares += float(np.square(values).sum())

    def deviation(self) -> float:
        mean = self.total / self.count
        return float(np.sqrt(max(0.0, self.squares / self.count - mean * mean)))


class JitterError:
    """Accumulates one view, frame by frame in order of time."""

    def __init__(self) -> None:
        self._render, self._truth = _Pool(), _Pool()
        self._previous: tuple[NDArray[np.float64], NDArray[np.float64], Mask] | None = None

    def add(self, render: Image, truth: Image, mask: Mask) -> None:
        """Take the next frame: render and truth [H, W, 3] in [0, 1], mask [H, W]."""
        luma_render, luma_truth = render @ _LUMA, truth @ _LUMA
        if self._previous is not None:
            last_render, last_truth, last_mask = self._previous
            liquid = mask | last_mask
            self._render.add(luma_render[liquid] - last_render[liquid])
            self._truth.add(luma_truth[liquid] - last_truth[liquid])
        self._previous = luma_render, luma_truth, mask

    def value(self) -> float | None:
        """|jitter of the render - jitter of the truth|; None where no two frames hold liquid."""
        if self._truth.count == 0:
            return None
        return abs(self._render.deviation() - self._truth.deviation())
