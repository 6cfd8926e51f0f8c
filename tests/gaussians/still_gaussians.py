"""Gaussians that stay where they are: the smallest dynamic model."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from splashbench.gaussians.dynamic_model import DynamicModel, Splats, ellipsoids
from splashbench.scene import Camera


class StillGaussians(DynamicModel):
    """Gaussians that stay where they are; the smallest model with the tables that density control wants."""

    def __init__(self, positions: np.ndarray, scale: float = 0.05, opacity: float = 0.5) -> None:
        super().__init__()
        n = len(positions)
        self.positions = nn.Parameter(torch.tensor(positions, dtype=torch.float32))
        self.log_scales = nn.Parameter(torch.full((n, 3), float(np.log(scale))))
        self.quaternions = nn.Parameter(torch.tensor([1.0, 0, 0, 0]).repeat(n, 1))
        self.opacity_logits = nn.Parameter(torch.full((n,), float(np.log(opacity / (1 - opacity)))))

    def means(self, time: float) -> torch.Tensor:
        return self.positions

    def splats(self, state: object, camera: Camera) -> Splats:
        colors = torch.full((len(self.positions), 3), 0.5)
        factors = ellipsoids(self.log_scales, self.quaternions)
        return Splats(self.positions, factors, torch.sigmoid(self.opacity_logits), colors)
