"""Scaffold-GS anchors: a feature per anchor, decoded into K Gaussians for the view at hand.

With anchor position a, log-scales l [6], offsets o [K, 3], feature f [32], view direction d (Lu et al. 2024):

    opacity  = tanh(MLP([f, d])), drawn where positive
    scale    = exp(l[3:6]) * sigmoid(MLP([f, d])),  rotation = quaternion of the same MLP
    colour   = sigmoid(MLP([f, d]) + f[:3])
    mean     = a + o * exp(l[0:3])

Two departures: the first three feature channels are also the logits of a base colour, which starts at the point's own,
so that hundreds of iterations suffice instead of tens of thousands; and the view direction goes to opacity and shape
only on request.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from splashbench_methods.scaffold_gs.anchors import AnchorSeed
from torch import nn

FEATURES = 32
HIDDEN = 32


def _head(outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(FEATURES + 3, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, outputs))


class AnchorModel(nn.Module):
    """N anchors with K children each; parameters in scene units."""

    positions: torch.Tensor

    def __init__(self, n: int, children: int, view_dependent_shape: bool) -> None:
        super().__init__()
        self.children_per_anchor = children
        self.view_dependent_shape = view_dependent_shape
        self.register_buffer("positions", torch.zeros(n, 3))
        self.features = nn.Parameter(torch.zeros(n, FEATURES))
        self.offsets = nn.Parameter(torch.zeros(n, children, 3))
        self.log_scales = nn.Parameter(torch.zeros(n, 6))
        self.opacity_head = _head(children)
        self.shape_head = _head(7 * children)
        self.color_head = _head(3 * children)

    @classmethod
    def from_seed(cls, seed: AnchorSeed, children: int, view_dependent_shape: bool) -> AnchorModel:
        """A model about to be fitted; random numbers come from torch's generator."""
        model = cls(len(seed.positions), children, view_dependent_shape)
        colors = torch.as_tensor(seed.colors).clamp(0.02, 0.98)
        spacing = torch.as_tensor(seed.spacing)
        with torch.no_grad():
            model.positions.copy_(torch.as_tensor(seed.positions))
            model.features.normal_(std=0.1)
            model.features[:, :3] = torch.logit(colors)
            model.offsets.uniform_(-0.7, 0.7)
            model.log_scales.copy_(spacing.log()[:, None].expand(-1, 6))
            last = {name: getattr(model, name)[-1] for name in ("opacity_head", "shape_head", "color_head")}
            for layer in last.values():
                layer.weight.mul_(0.3)
                layer.bias.zero_()
            last["opacity_head"].bias.fill_(math.atanh(0.6))
            # Children that tile the anchor's cell: full spacing divided among them; quaternion near the identity.
            shape = last["shape_head"].bias.view(children, 7)
            shape[:, :3] = 0.5
            shape[:, 3] = 1.0
        return model

    def _inputs(self, eye: NDArray) -> tuple[torch.Tensor, torch.Tensor]:
        """What the colour head reads, and what the opacity and shape heads read: [N, FEATURES + 3] each."""
        direction = nn.functional.normalize(self.positions - torch.as_tensor(eye, dtype=torch.float32), dim=1)
        seen = torch.cat([self.features, direction], dim=1)
        if self.view_dependent_shape:
            return seen, seen
        return seen, torch.cat([self.features, torch.zeros_like(direction)], dim=1)

    def opacities(self, eye: NDArray) -> torch.Tensor:
        """tanh opacities [N, K] of all children as seen from `eye` [3], those that are not drawn included."""
        return torch.tanh(self.opacity_head(self._inputs(eye)[1]))

    def decode(self, eye: NDArray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Gaussians as seen from `eye` [3]: means [M, 3], factors [M, 3, 3] (covariances B B^T), opacities [M], colors
        [M, 3] and scales [M, 3]. Children of non-positive opacity are left out, so M <= N K."""
        n, k = len(self.positions), self.children_per_anchor
        seen, blind = self._inputs(eye)
        opacity = torch.tanh(self.opacity_head(blind)).reshape(-1)
        kept = torch.nonzero(opacity > 0)[:, 0]
        anchor = kept // k
        shape = self.shape_head(blind).view(n * k, 7)[kept]
        scales = torch.exp(self.log_scales[:, 3:])[anchor] * torch.sigmoid(shape[:, :3])
        factor = rotation_matrices(shape[:, 3:]) * scales[:, None]
        base = self.features[:, None, :3]
        color = torch.sigmoid(self.color_head(seen).view(n, k, 3) + base).view(n * k, 3)[kept]
        means = self.positions[:, None] + self.offsets * torch.exp(self.log_scales[:, None, :3])
        return means.view(n * k, 3)[kept], factor, opacity[kept], color, scales


def rotation_matrices(quaternions: torch.Tensor) -> torch.Tensor:
    """Rotations [N, 3, 3] of quaternions [N, 4] (w x y z), normalised here."""
    w, x, y, z = nn.functional.normalize(quaternions, dim=1).unbind(1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, dim=1).view(-1, 3, 3)


def to_arrays(model: AnchorModel) -> dict[str, np.ndarray]:
    """Every parameter and buffer by name."""
    return {name: tensor.detach().numpy() for name, tensor in model.state_dict().items()}
