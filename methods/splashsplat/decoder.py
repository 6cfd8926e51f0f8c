"""Decoding carriers into Gaussians (paper, "Decoding Carriers into Gaussians", Eqs. child_position and sdf_opacity).

Heads shared by all carriers and frames turn a carrier's feature f into K children in its frame A = F diag(s): offset,
scale and opacity by linear heads, colour by a two-layer perceptron that also sees the viewing direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

# Where the children start, in units of the offset bound: half a unit to either side, one unit apart as in the
# supplement.
_START_DIRECTIONS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
_START_DISTANCE = 0.5


@dataclass(frozen=True)
class DecoderSettings:
    """offset_bound is beta, scale_range eta_s, opacity_slope kappa_alpha, opacity_band tau_alpha (transport voxels)."""

    feature_size: int = 32
    children: int = 2
    colour_width: int = 64
    offset_bound: float = 1.0
    scale_range: float = 0.5
    opacity_slope: float = 2.0
    opacity_band: float = 3.0
    opacity_bias: float = 1.0


@dataclass
class CarrierState:
    """What the decoder needs of n active carriers at one instant.

    positions: [n, 3] scene units. deformation: [n, 3, 3], F. phi: [n] transport voxels.
    """

    positions: Tensor
    deformation: Tensor
    phi: Tensor


@dataclass
class Children:
    """n carriers' K children: means [n, K, 3], factors [n, K, 3, 3] of their covariances B B^T (scene units), opacities
    [n, K], colours [n, K, 3] in [0, 1], offsets [n, K, 3] in carrier units."""

    means: Tensor
    factors: Tensor
    opacities: Tensor
    colours: Tensor
    offsets: Tensor


class Decoder(nn.Module):
    """The heads g_o, g_s, g_alpha (linear) and g_c (two layers)."""

    def __init__(self, settings: DecoderSettings) -> None:
        super().__init__()
        self.settings = settings
        size, k = settings.feature_size, settings.children
        self.offset = nn.Linear(size, 3 * k)
        self.scale = nn.Linear(size, 3 * k)
        self.opacity = nn.Linear(size, k)
        self.colour_hidden = nn.Linear(size + 3, settings.colour_width)
        self.colour_out = nn.Linear(settings.colour_width, 3 * k)
        with torch.no_grad():
            for head in (self.offset, self.scale, self.opacity):
                head.weight.mul_(0.3)  # children start alike, near the values the biases give
            self.scale.bias.zero_()
            self.opacity.bias.fill_(settings.opacity_bias)
            starts = torch.tensor([_START_DIRECTIONS[i % 6] for i in range(k)], dtype=torch.float32)
            starts = starts * (_START_DISTANCE if k > 1 else 0.0) / settings.offset_bound
            self.offset.bias.copy_(torch.atanh(starts.clamp(-0.99, 0.99)).reshape(-1))

    def offsets(self, features: Tensor) -> Tensor:
        """o = beta tanh(g_o(f)), [n, K, 3]."""
        raw = self.offset(features).view(len(features), self.settings.children, 3)
        return self.settings.offset_bound * torch.tanh(raw)

    def forward(self, features: Tensor, log_scales: Tensor, state: CarrierState, eye: Tensor) -> Children:
        """Children of n carriers seen from `eye` [3].

        features: [n, feature_size]; log_scales: [n, 3], log of s in scene units.
        """
        s = self.settings
        n, k = len(features), s.children
        base = torch.exp(log_scales)
        offsets = self.offsets(features)
        local = (base[:, None] * offsets).transpose(1, 2)  # diag(s) o, [n, 3, K]
        means = state.positions[:, None] + torch.bmm(state.deformation, local).transpose(1, 2)
        # Sigma = B B^T with B = F diag(g) / sqrt(K). The residual is bounded: an unbounded exponent lets single
        # Gaussians grow over the whole image.
        residual = 2 * torch.tanh(0.5 * self.scale(features).view(n, k, 3))
        extent = base[:, None] * torch.exp(s.scale_range * residual) / math.sqrt(k)
        factors = state.deformation[:, None] * extent[:, :, None, :]
        fade = torch.sigmoid(s.opacity_slope * (s.opacity_band - state.phi.abs()))
        opacities = torch.sigmoid(self.opacity(features)) * fade[:, None]
        direction = nn.functional.normalize(state.positions - eye, dim=1)
        hidden = torch.relu(self.colour_hidden(torch.cat([features, direction], dim=1)))
        colours = torch.sigmoid(self.colour_out(hidden)).view(n, k, 3)
        return Children(means, factors, opacities, colours, offsets)

    def mean_opacity(self, features: Tensor) -> Tensor:
        """Learned opacity of each carrier, the mean over its children without the fade by phi: [n]."""
        return torch.sigmoid(self.opacity(features)).mean(dim=1)


def initial_log_scale(base_scale: float, voxel: float) -> float:
    """log of s for carriers whose extent is `base_scale` transport voxels of size `voxel` (scene units)."""
    return math.log(base_scale * voxel)
