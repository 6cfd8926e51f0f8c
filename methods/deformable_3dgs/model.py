"""Canonical Gaussians with view-dependent colours, and the network that deforms them.

At time t, with (dx, dr, ds) = F(x, t) and x cut off from F's gradient (Yang et al. 2024, Eq. 5):

    mean = x + dx,  scale = exp(s) + ds,  rotation = normalise(normalise(q) + dr)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from splashbench.gaussians import spherical_harmonics as harmonics
from splashbench.gaussians.dynamic_model import DynamicModel, Splats, rotation_matrices
from splashbench.gaussians.initialization import StartingPoints
from splashbench.scene import Camera

from .deformation import Deformation

# Half the side of the box that the network's octaves suit, in its units.
_BOX = 1.3
#: Tables with a row per Gaussian.
ROWS = ("positions", "log_scales", "quaternions", "opacity_logits", "constant", "rest")


class DeformedGaussians(NamedTuple):
    """The Gaussians at an instant: means [N, 3], factors [N, 3, 3], opacities [N]."""

    means: Tensor
    factors: Tensor
    opacities: Tensor


class DeformableModel(DynamicModel):
    """N Gaussians; `sh_degree` is of the colours, `active_degree` what is used of it now."""

    positions: nn.Parameter

    def __init__(self, n: int, sh_degree: int, depth: int = 8, width: int = 256) -> None:
        super().__init__()
        self.sh_degree = self.active_degree = sh_degree
        self.deforms = True
        self.positions = nn.Parameter(torch.zeros(n, 3))
        self.log_scales = nn.Parameter(torch.zeros(n, 3))
        self.quaternions = nn.Parameter(torch.tensor([1.0, 0, 0, 0]).repeat(n, 1))
        self.opacity_logits = nn.Parameter(torch.zeros(n))
        self.constant = nn.Parameter(torch.zeros(n, 3))
        self.rest = nn.Parameter(torch.zeros(n, (sh_degree + 1) ** 2 - 1, 3))
        self.deformation = Deformation(depth, width)

    @classmethod
    def from_start(
        cls, start: StartingPoints, opacity: float, sh_degree: int, depth: int, width: int
    ) -> DeformableModel:
        """A model about to be fitted; the network's weights come from torch's generator."""
        model = cls(len(start), sh_degree, depth, width)
        model.backdrop = start.backdrop_tensor()
        with torch.no_grad():
            model.positions.copy_(torch.from_numpy(start.positions))
            model.log_scales.copy_(torch.from_numpy(start.spacing).log()[:, None].expand(-1, 3))
            model.opacity_logits.fill_(float(torch.logit(torch.tensor(opacity))))
            low, high = (torch.from_numpy(np.quantile(start.positions, q, axis=0)) for q in (0.02, 0.98))
            model.deformation.silence()
            model.deformation.center.copy_((low + high) / 2)
            model.deformation.unit.copy_((high - low).max() / (2 * _BOX))
            model.constant.copy_(harmonics.constant_of(torch.from_numpy(start.colors)))
        return model

    def turned(self, quaternions: Tensor) -> Tensor:
        """Axes [N, 3, 3] of Gaussians with these quaternions [N, 4], after the network's turn."""
        return rotation_matrices(quaternions)

    def at(self, time: float) -> DeformedGaussians:
        quaternions = nn.functional.normalize(self.quaternions, dim=1)
        scales, means = torch.exp(self.log_scales), self.positions
        if self.deforms:
            shift, turn, growth = self.deformation(self.positions.detach(), time)
            means, quaternions, scales = means + shift, quaternions + turn, scales + growth
        factors = self.turned(quaternions) * scales[:, None]
        return DeformedGaussians(means, factors, torch.sigmoid(self.opacity_logits))

    def splats(self, state: DeformedGaussians, camera: Camera) -> Splats:
        eye = torch.tensor(camera.center, dtype=torch.float32, device=state.means.device)
        directions = nn.functional.normalize(state.means.detach() - eye, dim=1)
        colors = harmonics.colors(self.constant, self.rest, directions, self.active_degree)
        return Splats(state.means, state.factors, state.opacities, colors)
