"""Adam over a model whose anchors come and go: the learning rates, published ones or for short fits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from splashbench.gaussians.optimizer import LearningRate, RowOptimizer

from .model import PER_ANCHOR, Anchors

# "published" are those of Scaffold-GS.
RATES: dict[str, dict[str, LearningRate]] = {
    "published": {
        "offsets": LearningRate(0.01, 0.0001),
        "features": LearningRate.constant(0.0075),
        "log_scales": LearningRate.constant(0.007),
        "opacity_head": LearningRate(0.002, 0.00002),
        "shape_head": LearningRate.constant(0.004),
        "color_head": LearningRate(0.008, 0.00005),
    },
    "short": {
        "offsets": LearningRate(0.01, 0.001),
        "features": LearningRate(0.02, 0.002),
        "log_scales": LearningRate(0.01, 0.001),
        "opacity_head": LearningRate(0.002, 0.0002),
        "shape_head": LearningRate(0.004, 0.0004),
        "color_head": LearningRate(0.008, 0.0008),
    },
}


class AnchorOptimizer(RowOptimizer):
    """Updates `model`; learning rates fall to their last value over `iterations` steps, times `until` where given."""

    model: Anchors

    def __init__(
        self,
        model: Anchors,
        rates: Literal["short", "published"] | Mapping[str, LearningRate],
        iterations: int,
        until: float | None = None,
    ) -> None:
        chosen = RATES[rates] if isinstance(rates, str) else rates
        if until is not None:
            chosen = {name: replace(rate, until=until) for name, rate in chosen.items()}
        super().__init__(model, chosen, PER_ANCHOR, iterations)

    def replace_anchors(self, kept: NDArray[np.int64], positions: torch.Tensor, new: dict[str, torch.Tensor]) -> None:
        """Keep the anchors `kept` and append new ones, at `positions` [n, D] and with rows of each of PER_ANCHOR.

        Kept rows keep their moments; new ones start without any.
        """
        device = self.model.positions.device
        kept_positions = self.model.positions[torch.from_numpy(kept).to(device)]
        self.model.positions = torch.cat([kept_positions, positions.to(device)])
        self.replace_rows(kept, new)
